"""Status and settings of a run, read from its service or its files."""

import logging
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec

from udrl.config import Budget, build, flat, read_toml
from udrl.errors import ConfigError, UdrlError
from udrl_inspect.address import REPLY_S, Address, connected, served_at
from udrl_proto import verbs
from udrl_proto.messages import Hello
from udrl_proto.replay_client import ReplayClient
from udrl_proto.reports import Status, StatusRequest
from udrl_replay.database import exists
from udrl_replay.progress import RunProgress
from udrl_replay.reporting import Throughput, status
from udrl_replay.run_state import RunState
from udrl_replay.store import Store

log = logging.getLogger("udrl")


def status_at(address: Address) -> Status:
    """Return the status of a run from its replay service.

    Raises:
        Unreachable: no service replied.
        ConfigError: the endpoint or the keys cannot be used, or a run id is needed.
    """
    with connected("observer", address) as (transport, hello):
        client = ReplayClient(transport, hello.run_id, "udrl status", patience_s=REPLY_S)
        return client.request(verbs.STATUS, StatusRequest())


def status_from(
    where: Path | Address,
    keys_dir: Path | None = None,
    warn: Callable[[str], object] = log.debug,
) -> Status:
    """Return the status of a run by its directory or its address.

    Raises:
        UdrlError: see :func:`status_of` and :func:`status_at`.
    """
    return status_of(where, keys_dir, warn) if isinstance(where, Path) else status_at(where)


def status_of(
    run_dir: Path, keys_dir: Path | None = None, warn: Callable[[str], object] = log.debug
) -> Status:
    """Return the status of a run by its directory: from its service, or else from its store.

    Args:
        run_dir: the run's directory.
        keys_dir: folder with the keys of an observer.
        warn: called with the reason if there is a service that cannot be queried.

    Raises:
        StoreError: the directory holds no run, or it is damaged.
    """
    endpoint = served_at(run_dir)
    if endpoint is None:
        return read_status(run_dir)
    try:
        with closing(Store(run_dir, read_only=True)) as store:
            run_id = store.fact("hello", Hello).run_id
        return status_at(Address(endpoint, run_id, REPLY_S, keys_dir))
    except UdrlError as error:
        warn(f"the replay service cannot be queried, so this is the status in the store: {error}")
        return read_status(run_dir)


def read_status(run_dir: Path) -> Status:
    """Return the status of a run from its store; ``stopped`` if no service is running.

    Raises:
        StoreError: the directory holds no run, or it is damaged.
    """
    with closing(Store(run_dir, read_only=True)) as store:
        run = read_run(run_dir, store)
        found = status(run, Throughput(), 0.0, 0.0)
    if found.state in ("running", "finishing") and served_at(run_dir) is None:
        return msgspec.structs.replace(
            found, state="stopped", time_left_s=None, ended_because=run.progress.why_stopped()
        )
    return found


def read_run(run_dir: Path, store: Store) -> RunState:
    """Return a read-only view of a run."""
    return RunState(store, budget_of(run_dir))


def last_iteration(run_dir: Path) -> int:
    """Return the last completed iteration of a run; -1 if its warm-up is not complete."""
    with closing(Store(run_dir, read_only=True)) as store:
        return store.fact("progress", RunProgress).iteration


def budget_of(run_dir: Path) -> Budget:
    """Return the current budget of a run.

    Raises:
        ConfigError: its configuration file is invalid.
    """
    path = run_dir / "config.toml"
    values = read_toml(path) if path.exists() else {}
    try:
        return build(Budget, {n: v for n, v in values.items() if n in Budget.__struct_fields__})
    except ConfigError as error:
        raise ConfigError(f"configuration file {path}: {error}; correct that line") from error


def settings_of(run_dir: Path) -> dict[str, Any]:
    """Return the settings and the current budget of a run."""
    with closing(Store(run_dir, read_only=True)) as store:
        config = store.fact("hello", Hello).config
    return flat(config) | flat(budget_of(run_dir))


def settings_to_resume(run_dir: Path | None) -> dict[str, Any] | None:
    """Return the settings of a run to resume; None: there is none in ``run_dir`` yet."""
    return settings_of(run_dir) if run_dir is not None and exists(run_dir) else None
