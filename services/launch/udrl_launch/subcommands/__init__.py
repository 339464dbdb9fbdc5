"""The subcommands of ``udrl``."""
