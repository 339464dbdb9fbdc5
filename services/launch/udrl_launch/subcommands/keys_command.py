"""``udrl keys``: TLS keys for the services of a run."""

from datetime import timedelta
from pathlib import Path

import click

from udrl.errors import ConfigError
from udrl_proto.access import ROLES


@click.group()
def keys() -> None:
    """Create TLS keys for the services of a run.

    Example: udrl keys create keys --host replay.example.org
    """


@keys.command()
@click.argument("directory", type=click.Path(path_type=Path), metavar="DIR")
@click.option("--host", "hosts", multiple=True, metavar="NAME",
              help="Host name or IP address of the replay service. May be repeated. localhost, "
              "127.0.0.1 and ::1 are always included.")  # fmt: skip
@click.option("--days", type=click.IntRange(1, 3650), default=365, show_default=True, metavar="N",
              help="Validity in days.")  # fmt: skip
@click.option(
    "--if-missing",
    is_flag=True,
    help="Do nothing if DIR has valid keys for every --host.",
)
def create(directory: Path, hosts: tuple[str, ...], days: int, if_missing: bool) -> int:
    """Create a certificate authority, and a key and certificate for each role.

    Example: udrl keys create keys --host replay.example.org
    """
    try:
        from udrl_launch import authority
    except ModuleNotFoundError as error:
        raise ConfigError(
            'creating keys needs cryptography; install it with: pip install "udrl[secure]"'
        ) from error
    if if_missing and authority.has_keys(directory, hosts):
        click.echo(f"{directory} already has keys for every role")
        return 0
    authority.create_keys(directory, hosts, timedelta(days))
    for role in ROLES:
        click.echo(f"{directory / role}: copy to machines with the role {role}")
    click.echo(f"{directory / authority.AUTHORITY}: stays here; it can issue keys for every role")
    return 0
