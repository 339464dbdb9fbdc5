"""The learner: trains the behavior function on the replay's episodes, broadcasts the weights."""
