"""``udrl keys``: making the keys that services prove their roles with."""

from datetime import timedelta
from pathlib import Path

import click

from udrl.errors import ConfigError
from udrl_proto.access import ROLES


@click.group()
def keys() -> None:
    """Make the keys that services prove their roles with.

    Example: udrl keys create keys --host replay.example.org
    """


@keys.command()
@click.argument("directory", type=click.Path(path_type=Path), metavar="DIR")
@click.option("--host", "hosts", multiple=True, metavar="NAME",
              help="Name or IP address by which others reach the replay service; may be repeated. "
              "localhost, 127.0.0.1 and ::1 are always among them.")  # fmt: skip
@click.option("--days", type=click.IntRange(1, 3650), default=365, show_default=True,
              help="How long the keys are valid.")  # fmt: skip
@click.option(
    "--if-missing",
    is_flag=True,
    help="Do nothing if the keys are there, valid, and good for every --host.",
)
def create(directory: Path, hosts: tuple[str, ...], days: int, if_missing: bool) -> int:
    """Make an authority of your own, and a folder with key and certificate for each role.

    Example: udrl keys create keys --host replay.example.org
    """
    try:
        from udrl_launch import authority
    except ModuleNotFoundError as error:
        raise ConfigError(
            'making keys needs cryptography; install it with: pip install "udrl[secure]"'
        ) from error
    if if_missing and authority.are_there(directory, hosts):
        click.echo(f"{directory} holds keys for every role already")
        return 0
    authority.create(directory, hosts, timedelta(days))
    for role in ROLES:
        click.echo(f"{directory / role}: for the machines of {role}")
    click.echo(f"{directory / authority.AUTHORITY}: stays here; who has it can make keys for all")
    return 0
