"""The board: a web page that shows runs and gives commands to their agents."""
