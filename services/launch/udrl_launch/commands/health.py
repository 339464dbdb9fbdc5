"""``udrl health``: whether a service does its work, for those who start and restart services."""

from pathlib import Path

import click

from udrl.errors import Unreachable
from udrl_inspect.address import Address, connected, host_name, is_of_this_machine
from udrl_launch.commands.options import KEYS, PATIENCE, RUN
from udrl_proto import keys as expressions
from udrl_proto.access import REPLAY
from udrl_proto.session import check_endpoint

_ANSWER_S = 3.0


@click.command()
@click.argument("role", type=click.Choice([REPLAY, "learner", "actor"]))
@click.option("--connect", metavar="ENDPOINT", required=True,
              help="Where the run is, e.g. tcp/127.0.0.1:7447.")  # fmt: skip
@KEYS
@PATIENCE
@RUN
def health(role: str, connect: str, keys: Path | None, patience: float, run_id: str | None) -> int:
    """Ask whether the replay service answers, or whether a learner or actor of this machine is in.

    Exit code 0: it is. 6: it is not.

    Example: udrl health actor --connect tcp/127.0.0.1:7447
    """
    address = Address(check_endpoint(connect, secure=keys is not None), run_id, patience, keys)
    # A replay service has no key to ask itself with; it is asked whether the endpoint answers.
    with connected("observer" if role == REPLAY else role, address) as (transport, hello):
        if role == REPLAY:
            click.echo(f"run {hello.run_id} answers at {connect}")
            return 0
        wanted = expressions.alive(hello.run_id, role, f"{host_name(role)}-$*")
        found = [key.rpartition("/")[2] for key in transport.present(wanted, _ANSWER_S)]
    there = [name for name in found if is_of_this_machine(name, role)]
    if not there:
        raise Unreachable(
            f"no {role} of this machine ({host_name(role)}) takes part in run {hello.run_id}; "
            f"see its log"
        )
    click.echo(f"{there[0]} takes part in run {hello.run_id}")
    return 0
