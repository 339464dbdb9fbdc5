"""The command line, the supervisor of processes, and all services in one process."""
