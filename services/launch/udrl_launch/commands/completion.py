"""``udrl completion``."""

import click
from click.shell_completion import get_completion_class


@click.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> int:
    """Print what makes a shell complete udrl's commands, options and run directories.

    Evaluate it where your shell starts, e.g. in ~/.bashrc: eval "$(udrl completion bash)"

    Example: udrl completion bash
    """
    from udrl_launch.cli import cli

    kind = get_completion_class(shell)
    assert kind is not None
    click.echo(kind(cli, {}, "udrl", "_UDRL_COMPLETE").source())
    return 0
