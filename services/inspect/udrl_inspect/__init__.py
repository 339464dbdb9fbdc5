"""Looking at runs and their agents from outside."""
