"""The replay service: keeps the top-k episodes, deals commands, paces the run; the only store."""
