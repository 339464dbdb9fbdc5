"""Views of runs and agents: figures, videos, a progress panel, metrics for other programs."""
