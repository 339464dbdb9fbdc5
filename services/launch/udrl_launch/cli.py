"""The command ``udrl``."""

import faulthandler
import inspect
import os
import re
import sys
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import entry_points
from typing import NoReturn

import click

from udrl.errors import UdrlError
from udrl.version import __version__
from udrl_launch import output
from udrl_launch.paths import extend_module_path
from udrl_launch.signals import Terminated

#: The commands of this package and the modules that hold them, in the order of the help.
_COMMANDS = {
    "train": "udrl_launch.subcommands.train_command",
    "check": "udrl_launch.subcommands.check_command",
    "replay": "udrl_launch.subcommands.service_commands",
    "learner": "udrl_launch.subcommands.service_commands",
    "actor": "udrl_launch.subcommands.service_commands",
    "evaluate": "udrl_launch.subcommands.inspection_commands",
    "obedience": "udrl_launch.subcommands.obedience_command",
    "play": "udrl_launch.subcommands.play_command",
    "export": "udrl_launch.subcommands.export_command",
    "reproduce": "udrl_launch.subcommands.inspection_commands",
    "status": "udrl_launch.subcommands.inspection_commands",
    "metrics": "udrl_launch.subcommands.metrics_command",
    "runs": "udrl_launch.subcommands.runs_commands",
    "plot": "udrl_launch.subcommands.runs_commands",
    "health": "udrl_launch.subcommands.health_command",
    "keys": "udrl_launch.subcommands.keys_command",
    "completion": "udrl_launch.subcommands.completion_command",
}

#: Minimum width of a terminal for descriptions beside long options, in characters.
_MIN_WIDTH = 70
#: Width of the column of options and commands in a narrower terminal, in characters.
_NARROW_COLUMN = 12

#: Entry points of other packages' commands.
_GROUP = "udrl.commands"


def main() -> NoReturn:
    """Run the command line of this process, and exit."""
    # Before NumPy is imported: its threads wait for each other by spinning, on cores that other
    # processes of the run need.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    extend_module_path()
    output.escape_unprintable()
    if sys.stderr is not None:
        faulthandler.enable()  # a crash in native code leaves the traceback of every thread
    if "--json" in sys.argv and not {"--help", "-h"} & set(sys.argv):
        output.keep_for_json()
    code = run(sys.argv[1:])
    # Not sys.exit: Zenoh's threads may still be in a callback, and if the interpreter shuts down
    # under them, the process occasionally aborts after all its work is done. No command relies on
    # exit handlers.
    output.flush()
    os._exit(code)


def run(arguments: Sequence[str]) -> int:
    """Run a command, and return its exit code. Errors are shown without a traceback."""
    try:
        return cli(args=list(arguments), prog_name="udrl", standalone_mode=False) or 0
    except BrokenPipeError:  # e.g. `| head`
        return 0
    except UdrlError as error:
        output.print_error(error)
        return error.exit_code
    except click.ClickException as error:
        message = error.format_message()
        if message.startswith("Usage: "):  # the help of a group without a command
            click.echo(message, err=True)
        else:
            output.print_error(_one_line(error))
        return error.exit_code
    except click.Abort as abort:
        return 143 if isinstance(abort.__cause__, Terminated) else 130


def _one_line(error: click.ClickException) -> str:
    """Return click's message in the form of the other errors."""
    message = error.format_message().removesuffix(".")
    message = re.sub(r"\.? \(?Did you mean (.*\?)\)?$", r"; did you mean \1", message)
    message = re.sub(r"is not in the range (\S+?)<=x<=(\S+)$", r"is not from \1 to \2", message)
    message = re.sub(r"is not in the range x>=(\S+)$", r"is not \1 or more", message)
    if isinstance(error, click.UsageError) and error.ctx and type(error) is not click.BadParameter:
        message += f" (see {error.ctx.command_path} --help)"
    return message[:1].lower() + message[1:]


class _HelpFormatter(click.HelpFormatter):
    """Formats help. In a narrow terminal, a long option is on a line above its description.

    Beside it, the column of descriptions would be too narrow for words such as names of presets.
    """

    def write_dl(
        self, rows: Iterable[tuple[str, str]], col_max: int = 30, col_spacing: int = 2
    ) -> None:
        width = col_max if self.width >= _MIN_WIDTH else _NARROW_COLUMN
        super().write_dl(list(rows), width, col_spacing)


class _Context(click.Context):
    formatter_class = _HelpFormatter


class _Commands(click.Group):
    """Imports a command when it is used. Other packages add theirs as entry points."""

    context_class = _Context

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [*_COMMANDS, *sorted(entry_points(group=_GROUP).names - _COMMANDS.keys())]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        command: click.Command
        if cmd_name in _COMMANDS:
            command = getattr(import_module(_COMMANDS[cmd_name]), cmd_name)
            return _formatted(command)
        for added in entry_points(group=_GROUP, name=cmd_name):
            command = added.load()
            return _formatted(command)
        return super().get_command(ctx, cmd_name)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0]
        near = get_close_matches(name, self.list_commands(ctx), n=1)
        if near and self.get_command(ctx, name) is None:
            raise click.UsageError(f"no command {name!r}; did you mean {near[0]!r}?", ctx)
        return super().resolve_command(ctx, args)


def _formatted(command: click.Command) -> click.Command:
    """Put the example in a command's help on a line of its own, which click does not wrap."""
    command.context_class = _Context
    if command.help is not None:
        about, found, example = inspect.cleandoc(command.help).partition("Example: ")
        if found:
            command.help = f"{about}\b\nExample:\n  {' '.join(example.split())}"
    if isinstance(command, click.Group):
        for subcommand in command.commands.values():
            _formatted(subcommand)
    return command


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="udrl")
def cli() -> None:
    """Upside-Down Reinforcement Learning, exact and distributed."""
