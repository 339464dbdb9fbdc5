"""A real run in separate processes, to inject faults into, and an observer of its progress.

The observer reads the store while the replay service writes it, so it also works when no service
replies. Logs show when services detected a fault.
"""

import os
import re
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from datetime import datetime
from pathlib import Path
from typing import NamedTuple, Protocol

from udrl.errors import RunFailed, StoreError, UdrlError
from udrl_inspect.inspection import read_status
from udrl_launch.settings import Settings
from udrl_launch.supervisor import Child, Supervisor
from udrl_proto.reports import Status
from udrl_replay.creation import create_run, write_config
from udrl_replay.progress import RunProgress
from udrl_replay.store import Store

_POLL_S = 0.02
_LINE = re.compile(r"(\d{4}-\S+ [\d:]+,\d+) (\w+) +(.*)")


class ProgressPoint(NamedTuple):
    """The progress of a run at one moment."""

    at: float
    accepted: int
    iteration: int


class Line(NamedTuple):
    """A line of a service's log."""

    at: float
    service: str
    text: str


class TooLate(UdrlError):
    """A run did not reach a state within the time limit."""


class Link(Protocol):
    """The connection between the replay service and other services.

    Attributes:
        listen: endpoint that the replay service listens on.
        listen_options: further options of the replay service.
        prefix: command that runs the replay service's command.
        endpoint: endpoint that other services connect to.
    """

    listen: str
    listen_options: tuple[str, ...]
    prefix: tuple[str, ...]
    endpoint: str

    def close(self) -> None:
        """Close the connection."""


class DisturbedRun:
    """A run with ``udrl replay``, ``udrl learner`` and ``udrl actor``, which restart when they die.

    Args:
        settings: settings of the run.
        run_dir: run directory, which must not exist.
        link: connection to the replay service; closed at the end.
        limit_s: time limit of the run in seconds.
        hang_s: ``--hang-timeout`` of the actors.
    """

    def __init__(
        self, settings: Settings, run_dir: Path, link: Link, limit_s: float, hang_s: float
    ) -> None:
        self.run_dir = run_dir
        self.settings = settings
        self.link = link
        self.unbalanced: list[str] = []
        self.moments: list[ProgressPoint] = []
        self._hang_s = hang_s
        self._deadline = time.monotonic() + limit_s
        create_run(run_dir, settings.config).close()
        write_config(run_dir, settings.config, settings.budget)
        self._supervisor = Supervisor(run_dir / "logs")

    @contextmanager
    def going(self) -> Iterator["DisturbedRun"]:
        """Start the services, and end them on exit."""
        environment = self.settings.config.environment
        start = self._supervisor.start
        try:
            start(
                "replay", "replay", environment, "--run-dir", str(self.run_dir), "--resume",
                "--listen", self.link.listen, *self.link.listen_options, prefix=self.link.prefix,
            )  # fmt: skip
            start("learner", "learner", "--connect", self.link.endpoint, "--patience", "60")
            for number in range(1, self.settings.fleet.actors + 1):
                start(
                    f"actor-{number}", "actor", "--connect", self.link.endpoint, "--patience", "60",
                    "--envs", str(self.settings.envs_per_actor),
                    "--hang-timeout", str(self._hang_s),
                )  # fmt: skip
            yield self
        finally:
            for child in self._supervisor.children:
                self._signal(child, signal.SIGCONT)
            self._supervisor.end()
            self.link.close()

    def children(self, *roles: str) -> list[Child]:
        """Return the services of some roles."""
        return [c for c in self._supervisor.children if c.name.split("-")[0] in roles]

    def send(self, number: signal.Signals, *roles: str) -> None:
        """Send a signal to services by role or by name."""
        for child in self._supervisor.children:
            if child.name in roles or child.name.split("-")[0] in roles:
                self._signal(child, number)

    def _signal(self, child: Child, number: signal.Signals) -> None:
        if child.process is not None and child.process.poll() is None:
            os.kill(child.process.pid, number)

    # Watching.

    def wait(self, condition: Callable[[], bool], what: str) -> None:
        """Wait for a condition while the run is observed and services that die are restarted."""
        while not condition():
            if time.monotonic() > self._deadline:
                raise TooLate(f"{self.run_dir}: timed out waiting for {what}")
            self._supervisor.check()
            self._observe()
            time.sleep(_POLL_S)

    def pass_by(self, seconds: float) -> None:
        """Wait for some seconds while the run is observed."""
        until = time.monotonic() + seconds
        self.wait(lambda: time.monotonic() >= until, f"{seconds} s")

    @property
    def accepted(self) -> int:
        """Accepted episodes at the last observation."""
        return self.moments[-1].accepted if self.moments else 0

    @property
    def is_over(self) -> bool:
        """Whether the run is over, so that the replay service has ended."""
        return all(child.done for child in self.children("replay"))

    def _observe(self) -> None:
        try:
            with closing(Store(self.run_dir, read_only=True)) as store:
                progress = store.fact("progress", RunProgress)
                arrived = store.pending_ids()
                waiting = [c.id for c in store.commands(cancelled=False) if c.id not in arrived]
        except StoreError as error:
            self.unbalanced.append(f"the store could not be read: {error}")
            return
        now = time.time()
        self.moments.append(ProgressPoint(now, progress.accepted, progress.iteration))
        commands = progress.accepted + progress.cancelled + len(waiting)
        episodes = progress.accepted + progress.duplicate + progress.rejected
        if (progress.issued, progress.delivered) != (commands, episodes) and progress.issued:
            self.unbalanced.append(f"{progress}, outstanding {len(waiting)}")

    def status(self) -> Status:
        """Return the status of the run from its store."""
        return read_status(self.run_dir)

    def failure(self) -> RunFailed | None:
        """Wait for the end of the run; return its error, or None."""
        try:
            self.wait(lambda: self.is_over, "the end of the run")
        except RunFailed as error:
            return error
        return None

    # Logs.

    def lines(self, pattern: str, after: float) -> list[Line]:
        """Return the lines of all logs that match a pattern, from a time on, by time."""
        found = []
        for path in sorted((self.run_dir / "logs").glob("*.log")):
            for text in path.read_text(encoding="utf-8", errors="replace").splitlines():
                match = _LINE.match(text)
                if match and re.search(pattern, match[3]):
                    at = datetime.strptime(match[1], "%Y-%m-%d %H:%M:%S,%f").timestamp()
                    if at >= after:
                        found.append(Line(at, path.stem, match[3]))
        return sorted(found)


def digests(status: Status) -> tuple[int, str, str]:
    """Return the results that faults must not change."""
    return status.iteration, status.weights_sha256, status.replay_sha256


def is_balanced(status: Status) -> bool:
    """Return whether both ledgers of a status balance."""
    commands, episodes = status.commands, status.episodes
    return (
        commands.issued == commands.accepted + commands.cancelled + commands.outstanding
        and episodes.delivered == episodes.accepted + episodes.duplicate + episodes.rejected
    )
