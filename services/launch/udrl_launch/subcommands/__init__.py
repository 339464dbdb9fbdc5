"""The subcommands of ``udrl``, by what they are for."""
