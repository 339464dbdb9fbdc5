"""Views of runs and agents: figures, films, a progress panel, metrics for other programs."""
