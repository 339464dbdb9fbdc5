"""``python -m udrl_launch``: the same as the command ``udrl``."""

from udrl_launch.cli import main

if __name__ == "__main__":
    main()
