"""The board: a page in the browser that shows a run and commands its agent."""
