"""The learner: trains the behavior function on the replay buffer and publishes the weights."""
