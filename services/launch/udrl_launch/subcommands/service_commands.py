"""``udrl replay``, ``udrl learner`` and ``udrl actor``: one service each."""

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
from udrl_launch import completions, roles
from udrl_launch.paths import new_run_dir, shown
from udrl_launch.process import (
    die_with_parent,
    keep_freed_memory,
    log_to_stderr,
    run_service,
    switch_threads_soon,
)
from udrl_launch.subcommands.options import (
    ALLOW_INEXACT,
    AUDIT,
    CONNECT_REQUIRED,
    INSECURE,
    KEYS,
    PARENT,
    PATIENCE,
    RESUME,
    RUN,
    RUN_DIR_OPTION,
    FiniteRange,
)
from udrl_launch.subcommands.settings_options import gather_settings, settings_options
from udrl_proto.access import REPLAY
from udrl_proto.credentials import load_credentials
from udrl_proto.session import check_endpoint
from udrl_replay.creation import directory_name

log = logging.getLogger("udrl")


def _as_service(parent: int | None, service: Callable[[threading.Event], None]) -> int:
    if parent is not None:
        die_with_parent(parent)
    log_to_stderr()
    return run_service(service)


@click.command()
@click.argument("env", shell_complete=completions.environments)
@settings_options
@click.option(
    "--listen", metavar="ENDPOINT", help="Endpoint to listen on, e.g. tcp/127.0.0.1:7447."
)
@click.option("--connect", metavar="ENDPOINT",
              help="Endpoint of an existing Zenoh router, instead of --listen.")  # fmt: skip
@RUN_DIR_OPTION
@RESUME
@INSECURE
@KEYS
@ALLOW_INEXACT
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
    """Start the replay service of a run.

    It stores the run, and is what learner and actors connect to.

    Example: udrl replay LunarLander-v3 --listen tcp/127.0.0.1:7447 --run-dir runs/mine
    """
    if (listen is None) == (connect is None):
        raise ConfigError("give either --listen ENDPOINT or --connect ENDPOINT")
    check_endpoint(listen or connect or "", secure=keys is not None)
    credentials = load_credentials(keys, REPLAY) if keys else None
    settings = gather_settings(env, given, run_dir, resume=resume)
    run_dir = run_dir or new_run_dir(directory_name(settings.config))

    def service(stop: threading.Event) -> None:
        log.info("run directory: %s", shown(run_dir))
        store = roles.open_run(
            run_dir, settings, resume=resume, allow_inexact=allow_inexact, listen=listen,
            insecure=insecure, secure=keys is not None, check_environment=parent is None,
        )  # fmt: skip
        roles.replay(
            run_dir, store, settings.budget, stop, listen=listen, connect=connect,
            insecure=insecure, credentials=credentials, audit=audit,
        )  # fmt: skip

    return _as_service(parent, service)


@click.command()
@CONNECT_REQUIRED
@KEYS
@PATIENCE
@RUN
@PARENT
def learner(
    connect: str, keys: Path | None, patience: float, run_id: str | None, parent: int | None
) -> int:
    """Start the learner of a run.

    It trains the agent, and gets all settings from the run.

    Example: udrl learner --connect tcp/127.0.0.1:7447
    """
    address = Address(check_endpoint(connect, secure=keys is not None), run_id, patience, keys)
    keep_freed_memory()
    return _as_service(parent, partial(roles.learner, address))


@click.command()
@CONNECT_REQUIRED
@click.option("--envs", type=click.IntRange(1, 4096), default=16, show_default=True, metavar="N",
              help="Environments to step at once.")  # fmt: skip
@click.option("--nice", type=click.IntRange(0, 19), default=0, show_default=True, metavar="N",
              help="Niceness of the process, to yield to others.")  # fmt: skip
@click.option("--hang-timeout", type=FiniteRange(1, 86_400), default=60.0, show_default=True,
              metavar="SECONDS",
              help="Exit if one round of environment steps takes longer than this.")  # fmt: skip
@click.option("--first-index", type=click.IntRange(0), default=0, show_default=True, metavar="N",
              help="Index of its first environment, for simulators that need a port.")  # fmt: skip
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
    """Start an actor for a run.

    It runs episodes, and gets all settings from the run.

    Example: udrl actor --connect tcp/127.0.0.1:7447 --envs 16
    """
    os.nice(nice)
    switch_threads_soon()
    address = Address(check_endpoint(connect, secure=keys is not None), run_id, patience, keys)
    return _as_service(
        parent, partial(roles.actor, address, envs, hang_s=hang_timeout, first_index=first_index)
    )
