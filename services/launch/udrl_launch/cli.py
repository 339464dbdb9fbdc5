"""The command ``udrl``."""

import inspect
import os
import sys
from importlib import import_module
from importlib.metadata import entry_points
from typing import NoReturn

import click

from udrl.errors import UdrlError
from udrl.version import __version__
from udrl_launch import output
from udrl_launch.paths import find_modules_of_the_user

#: The commands of this package and the modules that hold them, in the order of the help.
_COMMANDS = {
    "train": "udrl_launch.commands.training",
    "check": "udrl_launch.commands.checking",
    "replay": "udrl_launch.commands.services",
    "learner": "udrl_launch.commands.services",
    "actor": "udrl_launch.commands.services",
    "evaluate": "udrl_launch.commands.looking",
    "obedience": "udrl_launch.commands.obedience",
    "play": "udrl_launch.commands.playing",
    "export": "udrl_launch.commands.exporting",
    "reproduce": "udrl_launch.commands.looking",
    "status": "udrl_launch.commands.looking",
    "metrics": "udrl_launch.commands.metrics",
    "runs": "udrl_launch.commands.runs",
    "plot": "udrl_launch.commands.runs",
    "health": "udrl_launch.commands.health",
    "keys": "udrl_launch.commands.keys",
    "completion": "udrl_launch.commands.completion",
}

#: Entry points of other packages' commands.
_GROUP = "udrl.commands"


def main() -> NoReturn:
    """Run the command line. A :class:`UdrlError` is shown as one line, without a traceback."""
    # Before NumPy is imported: its threads wait for each other by spinning, on cores that other
    # processes of the run need.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    find_modules_of_the_user()
    if "--json" in sys.argv and not {"--help", "-h"} & set(sys.argv):
        output.keep_for_json()
    try:
        code = cli(standalone_mode=False)
    except BrokenPipeError:  # e.g. `| head`
        code = 0
    except UdrlError as error:
        click.echo(f"udrl: error: {error}", err=True)
        code = error.exit_code
    except click.ClickException as error:
        error.show()
        code = error.exit_code
    except click.Abort:
        code = 130
    # Not sys.exit: Zenoh's threads may still be in a callback, and if the interpreter shuts down
    # under them, the process occasionally aborts after all its work is done. No command relies on
    # exit handlers.
    output.flush()
    os._exit(code or 0)


class _Commands(click.Group):
    """Imports a command when it is used. Other packages add theirs as entry points."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [*_COMMANDS, *sorted(entry_points(group=_GROUP).names - _COMMANDS.keys())]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        command: click.Command
        if cmd_name in _COMMANDS:
            command = getattr(import_module(_COMMANDS[cmd_name]), cmd_name)
            return _with_example(command)
        for added in entry_points(group=_GROUP, name=cmd_name):
            command = added.load()
            return _with_example(command)
        return super().get_command(ctx, cmd_name)


def _with_example(command: click.Command) -> click.Command:
    """Put the example in a command's help on a line of its own, which click does not wrap."""
    if command.help is not None:
        about, found, example = inspect.cleandoc(command.help).partition("Example: ")
        if found:
            command.help = f"{about}\b\nExample:\n  {' '.join(example.split())}"
    if isinstance(command, click.Group):
        for subcommand in command.commands.values():
            _with_example(subcommand)
    return command


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="udrl")
def cli() -> None:
    """Upside-Down Reinforcement Learning, exact and distributed."""
