"""Inspecting runs and running their agents."""
