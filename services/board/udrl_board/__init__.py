"""The board: a page in the browser that shows a run, and lets its agent be told what to do."""
