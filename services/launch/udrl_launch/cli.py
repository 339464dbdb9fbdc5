"""The command ``udrl``."""

import os
import sys
from typing import NoReturn

import click

import udrl
from udrl.errors import UdrlError
from udrl_launch.commands.keys import keys
from udrl_launch.commands.looking import evaluate, reproduce, status
from udrl_launch.commands.services import actor, learner, replay
from udrl_launch.commands.training import train


def main() -> NoReturn:
    """Run the command line; errors of ours are one line, without a traceback."""
    try:
        code = cli(standalone_mode=False)
    except UdrlError as error:
        click.echo(f"udrl: error: {error}", err=True)
        code = error.exit_code
    except click.ClickException as error:
        error.show()
        code = error.exit_code
    except click.Abort:
        code = 130
    # Not sys.exit: Zenoh's threads may still be in a callback, and when the interpreter ends under
    # them the process now and then aborts, after all its work. No command leaves work to exit
    # handlers, and what is left of it is memory.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code or 0)


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(udrl.__version__, prog_name="udrl")
def cli() -> None:
    """Upside-Down Reinforcement Learning, exact and distributed."""


for command in (train, replay, learner, actor, evaluate, reproduce, status, keys):
    cli.add_command(command)
