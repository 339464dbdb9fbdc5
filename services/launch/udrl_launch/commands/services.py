"""``udrl replay``, ``udrl learner``, ``udrl actor``: one service each."""

import logging
import os
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import click

from udrl.errors import ConfigError
from udrl_inspect.address import Address
from udrl_launch import roles
from udrl_launch.commands.options import AUDIT, KEYS, PARENT, PATIENCE, RUN, RUN_DIR
from udrl_launch.commands.settings import gather_settings, settings_options
from udrl_launch.paths import new_run_dir, shown
from udrl_launch.process import (
    die_with_parent,
    keep_freed_memory,
    log_to_stderr,
    run_service,
    switch_threads_soon,
)
from udrl_proto.access import REPLAY
from udrl_proto.credentials import load
from udrl_proto.session import check_endpoint
from udrl_replay.creation import directory_name

log = logging.getLogger("udrl")


def _as_service(parent: int | None, service: Callable[[threading.Event], None]) -> int:
    if parent is not None:
        die_with_parent(parent)
    log_to_stderr()
    return run_service(service)


@click.command()
@click.argument("env")
@settings_options
@click.option(
    "--listen", metavar="ENDPOINT", help="Host the run's Zenoh endpoint, e.g. tcp/127.0.0.1:7447."
)
@click.option("--connect", metavar="ENDPOINT", help="Use the router at this endpoint instead.")
@click.option("--run-dir", type=RUN_DIR, help="The run's directory. Default: a new one in ./runs.")
@click.option("--resume", is_flag=True, help="Go on with the run in --run-dir, if there is one.")
@click.option("--insecure", is_flag=True, help="Listen beyond loopback without authentication.")
@KEYS
@click.option("--allow-inexact", is_flag=True, help="Accept actors that round differently.")
@AUDIT
@PARENT
def replay(
    env: str,
    listen: str | None,
    connect: str | None,
    run_dir: Path | None,
    resume: bool,
    insecure: bool,
    keys: Path | None,
    allow_inexact: bool,
    audit: float,
    parent: int | None,
    **given: Any,
) -> int:
    """Start the replay service of a run: the only store, and its Zenoh endpoint.

    Example: udrl replay LunarLander-v3 --listen tcp/127.0.0.1:7447 --run-dir runs/mine
    """
    if (listen is None) == (connect is None):
        raise ConfigError("give either --listen ENDPOINT or --connect ENDPOINT")
    check_endpoint(listen or connect or "", secure=keys is not None)
    credentials = load(keys, REPLAY) if keys else None
    settings = gather_settings(env, given, run_dir, go_on=resume)
    run_dir = run_dir or new_run_dir(directory_name(settings.config))

    def service(stop: threading.Event) -> None:
        log.info("the run's directory is %s", shown(run_dir))
        store = roles.open_run(
            run_dir, settings, go_on=resume, allow_inexact=allow_inexact, listen=listen,
            insecure=insecure, secure=keys is not None, check_environment=parent is None,
        )  # fmt: skip
        roles.replay(
            run_dir, store, settings.budget, stop, listen=listen, connect=connect,
            insecure=insecure, credentials=credentials, audit=audit,
        )  # fmt: skip

    return _as_service(parent, service)


@click.command()
@click.option(
    "--connect",
    metavar="ENDPOINT",
    required=True,
    help="Where the run is, e.g. tcp/127.0.0.1:7447.",
)
@KEYS
@PATIENCE
@RUN
@PARENT
def learner(
    connect: str, keys: Path | None, patience: float, run_id: str | None, parent: int | None
) -> int:
    """Start the learner of a run.

    Example: udrl learner --connect tcp/127.0.0.1:7447
    """
    address = Address(check_endpoint(connect, secure=keys is not None), run_id, patience, keys)
    keep_freed_memory()
    return _as_service(parent, partial(roles.learner, address))


@click.command()
@click.option(
    "--connect",
    metavar="ENDPOINT",
    required=True,
    help="Where the run is, e.g. tcp/127.0.0.1:7447.",
)
@click.option("--envs", type=click.IntRange(1, 4096), default=16, show_default=True,
              help="Environments to step at once.")  # fmt: skip
@click.option("--nice", type=click.IntRange(0, 19), default=0, help="Yield to other processes.")
@click.option("--hang-timeout", type=click.FloatRange(1), default=60.0, show_default=True,
              help="Seconds of one round of steps after which the process ends.")  # fmt: skip
@click.option("--first-index", type=click.IntRange(0), default=0, show_default=True,
              help="Of its first environment, for simulators that need a port.")  # fmt: skip
@KEYS
@PATIENCE
@RUN
@PARENT
def actor(
    connect: str,
    envs: int,
    nice: int,
    hang_timeout: float,
    first_index: int,
    keys: Path | None,
    patience: float,
    run_id: str | None,
    parent: int | None,
) -> int:
    """Start an actor; the run tells it everything else.

    Example: udrl actor --connect tcp/127.0.0.1:7447 --envs 16
    """
    os.nice(nice)
    switch_threads_soon()
    address = Address(check_endpoint(connect, secure=keys is not None), run_id, patience, keys)
    return _as_service(
        parent, partial(roles.actor, address, envs, hang_s=hang_timeout, first_index=first_index)
    )
