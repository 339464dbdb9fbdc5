"""``udrl metrics``."""

import threading
from contextlib import closing
from functools import partial
from pathlib import Path

import click

from udrl.errors import UdrlError
from udrl_inspect.address import Address
from udrl_inspect.inspection import status_from
from udrl_launch.process import log_to_stderr, run_service
from udrl_launch.subcommands.options import CONNECT, KEYS, RUN, RUN_DIR, place
from udrl_proto.reports import Status
from udrl_show.prometheus import Exporter


@click.command()
@click.argument("run_dir", type=RUN_DIR, required=False)
@CONNECT
@click.option("--port", type=click.IntRange(0, 65_535), default=9464, show_default=True,
              metavar="PORT", help="Port to serve metrics on; 0 = any free port.")  # fmt: skip
@click.option("--host", default="127.0.0.1", show_default=True, metavar="ADDRESS",
              help="Address to serve metrics on, without authentication.")  # fmt: skip
@KEYS
@RUN
def metrics(
    run_dir: Path | None,
    connect: str | None,
    port: int,
    host: str,
    keys: Path | None,
    run_id: str | None,
) -> int:
    """Export metrics of a run to Prometheus.

    Serves them over HTTP until stopped. Pass either RUN_DIR or --connect ENDPOINT.

    Example: udrl metrics --connect tcp/127.0.0.1:7447 --port 9464
    """
    where = place(run_dir, connect, run_id, keys)
    log_to_stderr()
    if isinstance(where, Path):
        status_from(where, keys)  # else a run that cannot be read would always be reported as down

    def service(stop: threading.Event) -> None:
        with closing(Exporter(partial(_known_status, where, keys), host, port)) as exporter:
            click.echo(f"metrics: {exporter.address}")
            stop.wait()

    return run_service(service)


def _known_status(where: Path | Address, keys: Path | None) -> Status | None:
    """Return the status of a run; None if it cannot be read."""
    try:
        return status_from(where, keys)
    except UdrlError:
        return None  # reported as udrl_up 0
