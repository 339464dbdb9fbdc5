"""The three services as functions, each for its own process or thread."""

import logging
import threading
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from udrl.config import Budget, Config
from udrl.errors import ConfigError, Deceived, RunFailed
from udrl.numerics import has_cuda
from udrl_actor.actor_service import ActorService
from udrl_inspect.address import Address, announced, connected, unique_name
from udrl_launch.settings import Settings
from udrl_proto import session as sessions
from udrl_proto.credentials import Credentials
from udrl_proto.zenoh_transport import ZenohTransport
from udrl_replay.creation import (
    config_of,
    create_run,
    no_empty_folder_left,
    write_config,
)
from udrl_replay.database import exists
from udrl_replay.replay_service import ReplayService
from udrl_replay.resuming import closed_on_error
from udrl_replay.resuming import resume as resume_run
from udrl_replay.store import Store

if TYPE_CHECKING:
    from udrl_learner.learner_service import LearnerService

log = logging.getLogger("udrl")


def open_run(
    run_dir: Path,
    settings: Settings,
    *,
    resume: bool,
    allow_inexact: bool,
    listen: str | None,
    insecure: bool,
    secure: bool,
    check_environment: bool = True,
) -> Store:
    """Resume a run or create a new one, and write its configuration to the run directory.

    No run is created if it could not be served.

    Args:
        run_dir: its directory.
        settings: its settings and its budget.
        resume: resume the run in ``run_dir`` if there is one.
        allow_inexact: accept services of other numerics classes, and a changed environment.
        listen: the endpoint to listen on. None: a router's endpoint is used.
        insecure: allow it to be beyond loopback without keys.
        secure: whether keys were given.
        check_environment: when resuming, repeat some stored episodes to check the environment.

    Raises:
        UdrlError: the settings or the endpoint cannot be used, or the run exists already.
    """
    if resume and exists(run_dir):
        store = resume_run(
            run_dir, settings.config, allow_inexact=allow_inexact,
            check_environment=check_environment,
        )  # fmt: skip
    else:
        with no_empty_folder_left(run_dir):
            if listen is not None:
                sessions.check_listening(listen, insecure=insecure, secure=secure)
            store = create_run(
                run_dir, settings.config, automatic=settings.automatic, allow_inexact=allow_inexact
            )
    with closed_on_error(store):
        write_config(run_dir, config_of(store), settings.budget)
    return store


def replay(
    run_dir: Path,
    store: Store,
    budget: Budget,
    stop: threading.Event,
    *,
    listen: str | None = None,
    connect: str | None = None,
    insecure: bool = False,
    credentials: Credentials | None = None,
    audit: float = 0.0,
) -> None:
    """Serve a run until it has ended, at its own endpoint or through a router.

    Raises:
        ConfigError: the endpoint cannot be used.
        StoreError: the run's file cannot be written.
        RunFailed: the run cannot continue, or an actor delivered false episodes (Deceived).
    """
    run_dir = run_dir.absolute()  # environments may change the working directory
    with closing(store):
        endpoint = listen or connect
        assert endpoint is not None
        session = (
            sessions.listen(endpoint, insecure=insecure, credentials=credentials)
            if listen
            else sessions.connect(endpoint, Address(endpoint).patience_s, stop, credentials)
        )
        with (
            sessions.closed_at_the_end(session),
            closing(
                ReplayService(ZenohTransport(session), store, budget, run_dir, audit)
            ) as service,
            announced(run_dir, endpoint),
        ):
            service.serve(stop)
        progress = service.run.progress
        if progress.state == "failed":
            raise (Deceived if progress.deceived else RunFailed)(progress.problem)


def require_torch() -> None:
    """Check that torch is installed, which only a learner needs.

    Raises:
        ConfigError: it is not installed.
    """
    if find_spec("torch") is None:
        raise ConfigError('training needs torch; install it with: pip install "udrl[train]"')


def require_device(config: Config) -> None:
    """Check that this machine has the device on which the run trains.

    Raises:
        ConfigError: this machine does not have it.
    """
    if config.arithmetic.device == "cuda" and not has_cuda():
        raise ConfigError(
            "device = 'cuda': the CUDA driver finds no GPU; train on a machine that has one, or "
            "set device = 'cpu'"
        )


def learner(address: Address, stop: threading.Event) -> None:
    """Train the run at an address until it has ended.

    Raises:
        ConfigError: torch or the run's device is missing.
    """
    service = load_learner_service()
    with connected("learner", address, stop) as (transport, hello):
        require_device(hello.config)
        service(transport, hello, unique_name("learner"), stop).run()


def load_learner_service() -> "type[LearnerService]":
    """Import the learner service, the only one that needs torch.

    Raises:
        ConfigError: torch is missing.
    """
    require_torch()
    from udrl_learner.learner_service import LearnerService

    return LearnerService


def actor(
    address: Address,
    environments: int,
    stop: threading.Event,
    hang_s: float | None = None,
    first_index: int = 0,
) -> None:
    """Act for the run at an address until it has ended.

    Args:
        address: where the run is.
        environments: how many to step at once.
        stop: ends the service.
        hang_s: end the process if one step of all environments takes longer, seconds. None: never.
        first_index: index of its first environment.
    """
    with connected("actor", address, stop) as (transport, hello):
        name = unique_name("actor")
        ActorService(transport, hello, name, environments, stop, hang_s, first_index).run()
