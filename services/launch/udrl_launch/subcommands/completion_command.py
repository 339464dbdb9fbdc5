"""``udrl completion``."""

import click
from click.shell_completion import get_completion_class


@click.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> int:
    """Print a shell completion script.

    Evaluate the script in your shell's startup file, e.g. ~/.bashrc, as in the example.

    Example: eval "$(udrl completion bash)"
    """
    from udrl_launch.cli import cli

    kind = get_completion_class(shell)
    assert kind is not None
    click.echo(kind(cli, {}, "udrl", "_UDRL_COMPLETE").source())
    return 0
