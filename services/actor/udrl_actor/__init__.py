"""The actor: runs Algorithm 2 with the commands it is given; has no persistent state."""
