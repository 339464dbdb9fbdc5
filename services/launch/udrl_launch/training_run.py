"""``udrl train``: all services on this machine, until the final evaluation."""

import logging
import shlex
import socket
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Protocol

from udrl.errors import Interrupted, Unreachable
from udrl_inspect.address import Address, connected, from_this_machine
from udrl_inspect.inspection import read_status
from udrl_launch.local import START_S, Local, Processes, Threads
from udrl_launch.paths import shown
from udrl_launch.roles import load_learner_service, open_run, require_device, require_torch
from udrl_launch.settings import Settings
from udrl_proto import session as sessions
from udrl_proto import verbs
from udrl_proto.access import ROLES
from udrl_proto.credentials import load_credentials
from udrl_proto.replay_client import ReplayClient
from udrl_proto.reports import Status, StatusRequest
from udrl_replay.creation import config_of
from udrl_replay.reporting import write_weights
from udrl_replay.run import StoredRun

log = logging.getLogger("udrl")


class Watcher(Protocol):
    """Observes the status of a run."""

    def show(self, status: Status) -> None:
        """Receive a status; called about twice a second."""
        ...


class Watchers:
    """Several watchers, and the last status that they received.

    Args:
        clock: returns the time, seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._watchers: list[Watcher] = []
        self._latest: Status | None = None
        self._shown_at = 0.0

    def add(self, watcher: Watcher) -> None:
        """Add a watcher."""
        self._watchers.append(watcher)

    def show(self, status: Status) -> None:
        """Pass a status to all watchers."""
        self._latest, self._shown_at = status, self._clock()
        for watcher in self._watchers:
            watcher.show(status)

    def latest(self) -> Status | None:
        """Return the last status; None if there was none in the last few seconds."""
        return self._latest if self._clock() - self._shown_at < _STALE_S else None


class Adviser:
    """Warns once if a run does not learn."""

    def __init__(self) -> None:
        self._has_warned = False

    def show(self, status: Status) -> None:
        """Receive a status."""
        if status.advice and not self._has_warned:
            log.warning("%s", status.advice)
            self._has_warned = True


#: Seconds after which a status is stale.
_STALE_S = 10.0
#: Seconds between checks of the processes, and between status requests.
_CHECK_S, _POLL_S = 0.1, 0.5


def run_training(
    settings: Settings,
    run_dir: Path,
    stop: threading.Event,
    *,
    resume: bool = False,
    in_process: bool = False,
    allow_inexact: bool = False,
    listen: str | None = None,
    insecure: bool = False,
    keys: Path | None = None,
    audit: float = 0.0,
    watcher: Watcher | None = None,
    resume_options: Sequence[str] = (),
) -> Status:
    """Train an agent and return the final status of its run.

    Args:
        settings: the run's settings, budget and parallelism.
        run_dir: the run's directory.
        stop: ends the training early; the run can be resumed.
        resume: resume the run in ``run_dir`` if there is one.
        in_process: run all services as threads of this process, not as processes.
        allow_inexact: accept actors of other numerics classes.
        listen: the endpoint of the run. None: a free port of the loopback interface.
        insecure: allow ``listen`` to be beyond loopback without keys.
        keys: folder with the keys of all roles (``udrl keys create``). None: no authentication.
        audit: share of the episodes that are audited, 0 to 1.
        watcher: receives the status.
        resume_options: further options of the command that resumes the run, for the message.

    Raises:
        UdrlError: the run cannot be started or cannot continue.
        Interrupted: ``stop`` was set.
    """
    if in_process:
        # Not in the learner's thread: a native library is not loaded safely while others run.
        load_learner_service()
    else:
        require_torch()
    require_device(settings.config)
    endpoint = listen or f"{'tls' if keys else 'tcp'}/127.0.0.1:{free_port()}"
    sessions.check_endpoint(endpoint, secure=keys is not None)
    if keys is not None:
        for role in ROLES:
            load_credentials(keys, role)
    store = open_run(
        run_dir, settings, resume=resume, allow_inexact=allow_inexact, listen=endpoint,
        insecure=insecure, secure=keys is not None,
    )  # fmt: skip
    settings = settings._replace(config=config_of(store), automatic=frozenset())
    with ExitStack() as closing_store:
        closing_store.callback(store.close)
        run = StoredRun(store, settings.budget)
        if run.progress.state == "ended":
            write_weights(run_dir, store, run.progress.latest_version)
            return read_status(run_dir)
        with store.transaction():  # until its replay service has started
            run.stop()
        closing_store.pop_all()  # the services take over the store
    kind = Threads if in_process else Processes
    services: Local = kind(
        run_dir, store, settings, endpoint, insecure=insecure, keys=keys, audit=audit
    )
    address = Address(from_this_machine(endpoint), patience_s=START_S, keys=keys)
    try:
        with suppress(Interrupted):  # while it connects to the replay service
            _watch(services, address, stop, watcher)
        failure = services.failure()
        if failure is not None:
            raise failure
    finally:
        services.end()
    if stop.is_set():
        resume_with = ["udrl", "train", settings.config.environment, "--run-dir", shown(run_dir)]
        command = shlex.join([*resume_with, "--resume", *resume_options])
        raise Interrupted(f"stopped; resume with: {command}")
    return read_status(run_dir)


def _watch(
    services: Local, address: Address, stop: threading.Event, watcher: Watcher | None
) -> None:
    """Show the status until the services are done, one has failed, or ``stop`` is set."""
    over = _Over(services, stop)
    with connected("observer", address, over) as (transport, hello):
        client = ReplayClient(transport, hello.run_id, "the display", over)
        requested = time.monotonic() - _POLL_S
        while not over.wait(_CHECK_S):
            if time.monotonic() - requested < _POLL_S:
                continue
            requested = time.monotonic()
            try:
                status = client.request(verbs.STATUS, StatusRequest())
            except (Unreachable, Interrupted) as error:
                log.debug("no status: %s", error)
                continue
            services.note(status)
            if watcher is not None:
                watcher.show(status)


class _Over(threading.Event):
    """Set when the services are done, one has failed, or ``stop`` is set. Ends waits."""

    def __init__(self, services: Local, stop: threading.Event) -> None:
        super().__init__()
        self._services = services
        self._stop_event = stop

    def is_set(self) -> bool:
        services = self._services
        return self._stop_event.is_set() or services.failure() is not None or services.done

    def wait(self, timeout: float | None = None) -> bool:
        return self._stop_event.wait(timeout) or self.is_set()


def free_port() -> int:
    """Return a free port of the loopback interface."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
