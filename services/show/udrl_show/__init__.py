"""Runs and agents made visible: pictures, films, a panel, metrics for other programs."""
