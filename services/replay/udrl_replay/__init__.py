"""The replay service: keeps the top-k episodes, deals commands, paces the run; has the store."""
