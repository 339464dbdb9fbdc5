"""All services of a run on this machine, as processes or as threads."""

import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Protocol

from udrl.errors import UdrlError
from udrl_inspect.address import Address, from_this_machine
from udrl_launch import roles
from udrl_launch.process import switch_threads_soon
from udrl_launch.settings import Settings
from udrl_launch.supervisor import END_S, Supervisor
from udrl_proto.access import REPLAY
from udrl_proto.credentials import load_credentials
from udrl_proto.reports import Status
from udrl_replay.store import Store

#: Seconds for a service to find the replay service after the start.
START_S = 60.0


class Local(Protocol):
    """The services of a run on this machine."""

    @property
    def done(self) -> bool:
        """Whether all have ended without an error."""
        ...

    def failure(self) -> BaseException | None:
        """Restart dead services; return the first unrecoverable error."""
        ...

    def note(self, status: Status) -> None:
        """Receive the run's status."""
        ...

    def end(self) -> None:
        """End all services."""
        ...


class Processes:
    """A process for each service, restarted if it dies."""

    def __init__(
        self,
        run_dir: Path,
        store: Store,
        settings: Settings,
        endpoint: str,
        *,
        insecure: bool,
        keys: Path | None,
        audit: float = 0.0,
    ) -> None:
        fleet, environment = settings.fleet, settings.config.environment
        store.close()
        self._supervisor = Supervisor(run_dir / "logs")
        self._failure: UdrlError | None = None
        secured = ("--keys", str(keys)) if keys else ()

        def start(name: str, *arguments: str) -> None:
            try:
                self._supervisor.start(name, *arguments, *secured)
            except UdrlError:
                self._supervisor.end()
                raise

        start(
            "replay", "replay", environment, "--run-dir", str(run_dir), "--resume",
            "--listen", endpoint, *(["--insecure"] if insecure else []), "--audit", str(audit),
        )  # fmt: skip
        connect = from_this_machine(endpoint)
        start("learner", "learner", "--connect", connect, "--patience", f"{START_S:g}")
        envs = str(settings.envs_per_actor)
        for number in range(1, fleet.actors + 1):
            start(
                f"actor-{number}", "actor", "--connect", connect, "--envs", envs,
                "--nice", "10", "--patience", f"{START_S:g}",
                "--hang-timeout", f"{fleet.hang_timeout:g}",
                "--first-index", str((number - 1) * settings.envs_per_actor),
            )  # fmt: skip

    @property
    def done(self) -> bool:
        """Whether all have ended without an error."""
        return self._supervisor.done

    def failure(self) -> BaseException | None:
        """Restart dead services; return the first unrecoverable error."""
        if self._failure is None:
            try:
                self._supervisor.check()
            except UdrlError as failure:
                self._failure = failure
        return self._failure

    def note(self, status: Status) -> None:
        """Record the run's progress, to give up on services that die without progress."""
        self._supervisor.work = {
            "replay": status.episodes.delivered,
            "learner": status.weights_version,
            "actor": status.episodes.accepted,
        }

    def end(self) -> None:
        """End all services."""
        self._supervisor.end()


class Threads:
    """A thread for each service. The first error ends all threads."""

    def __init__(
        self,
        run_dir: Path,
        store: Store,
        settings: Settings,
        endpoint: str,
        *,
        insecure: bool,
        keys: Path | None,
        audit: float = 0.0,
    ) -> None:
        fleet = settings.fleet
        self._stop = threading.Event()
        self._errors: list[BaseException] = []
        self._threads: list[threading.Thread] = []
        self._run_ended: float | None = None
        self._switched_before = switch_threads_soon()
        self._start(
            "replay",
            partial(
                roles.replay,
                run_dir,
                store,
                settings.budget,
                self._stop,
                listen=endpoint,
                insecure=insecure,
                credentials=load_credentials(keys, REPLAY) if keys else None,
                audit=audit,
            ),
        )
        address = Address(from_this_machine(endpoint), patience_s=START_S, keys=keys)
        self._start("learner", partial(roles.learner, address, self._stop))
        for number in range(1, fleet.actors + 1):
            self._start(
                f"actor-{number}",
                partial(
                    roles.actor,
                    address,
                    settings.envs_per_actor,
                    self._stop,
                    first_index=(number - 1) * settings.envs_per_actor,
                ),
            )

    def _start(self, name: str, service: Callable[[], None]) -> None:
        def target() -> None:
            try:
                service()
            except BaseException as error:  # noqa: BLE001 - the main thread raises it
                self._errors.append(error)

        thread = threading.Thread(target=target, name=name, daemon=True)
        thread.start()
        self._threads.append(thread)

    @property
    def done(self) -> bool:
        """Whether all have ended, or the replay service has and the grace period is over."""
        if self._run_ended is None and not self._threads[0].is_alive():
            self._run_ended = time.monotonic()
        if self._run_ended is not None and time.monotonic() - self._run_ended > END_S:
            return True
        return not any(thread.is_alive() for thread in self._threads)

    def failure(self) -> BaseException | None:
        """Return the first error of a service."""
        return self._errors[0] if self._errors else None

    def note(self, status: Status) -> None:
        """Do nothing: threads are not restarted."""

    def end(self) -> None:
        """End all services."""
        self._stop.set()
        for thread in self._threads:
            thread.join(5.0)
        sys.setswitchinterval(self._switched_before)
