"""``udrl health``: health checks for process managers and containers."""

from pathlib import Path

import click

from udrl.errors import Unreachable
from udrl_inspect.address import (
    REPLY_S,
    Address,
    connected,
    host_name,
    is_of_this_machine,
)
from udrl_launch.subcommands.options import CONNECT_REQUIRED, KEYS, PATIENCE, RUN
from udrl_proto import key_expressions
from udrl_proto.access import REPLAY
from udrl_proto.session import check_endpoint


@click.command()
@click.argument("role", type=click.Choice([REPLAY, "learner", "actor"]))
@CONNECT_REQUIRED
@KEYS
@PATIENCE
@RUN
def health(role: str, connect: str, keys: Path | None, patience: float, run_id: str | None) -> int:
    """Check whether a service is alive.

    The replay service must reply; a learner or actor of this machine must have joined the run. The
    exit code is 0 if so, else 6.

    Example: udrl health actor --connect tcp/127.0.0.1:7447
    """
    address = Address(check_endpoint(connect, secure=keys is not None), run_id, patience, keys)
    # The role of the replay service has no permissions as a client, so connect as an observer.
    with connected("observer" if role == REPLAY else role, address) as (transport, hello):
        if role == REPLAY:
            click.echo(f"run {hello.run_id} is served at {connect}")
            return 0
        wanted = key_expressions.alive(hello.run_id, role, f"{host_name(role)}-$*")
        found = [key.rpartition("/")[2] for key in transport.present(wanted, REPLY_S)]
    there = [name for name in found if is_of_this_machine(name, role)]
    if not there:
        raise Unreachable(
            f"no {role} of this machine ({host_name(role)}) has joined run {hello.run_id}; see the "
            f"log of the {role}"
        )
    click.echo(f"{there[0]} has joined run {hello.run_id}")
    return 0
