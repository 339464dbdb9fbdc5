"""The replay service: keeps the top-k episodes, assigns commands, paces the run; has the store."""
