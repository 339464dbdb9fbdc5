"""A log of a run for another program: TensorBoard, Weights & Biases or MLflow.

A log is written in a thread of its own, because a server may be slow or unreachable. Its failure
never ends the training.
"""

import logging
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from udrl_inspect.inspection import settings_of
from udrl_proto.reports import Status
from udrl_proto.text import printable
from udrl_show.metrics_file import MetricsReader
from udrl_show.scalars import RowScalars, Scalar, final_scalars

log = logging.getLogger("udrl")

#: Seconds between checks for a new status.
_CHECK_S = 1.0
#: Seconds for the rest to be written when the training ends, and when it is stopped.
FINISH_S, STOP_S = 60.0, 1.0


class Logged(NamedTuple):
    """What a log contains when it is continued.

    Attributes:
        iteration: the last iteration. -1: none.
        is_ended: whether it contains the end of the run.
    """

    iteration: int = -1
    is_ended: bool = False


class Writer(Protocol):
    """Writes scalars in the format of another program.

    Attributes:
        place: location of the log, as text for the user. Empty until the log has begun.
    """

    place: str

    def begin(self, run_id: str, settings: dict[str, Any], began: float) -> Logged:
        """Begin or continue the log of a run.

        Args:
            run_id: the run.
            settings: its settings by name.
            began: when it began, seconds since 1970, less the time during which it was stopped.
        """
        ...

    def write(self, scalars: Sequence[Scalar]) -> None:
        """Write scalars."""
        ...

    def end(self, because: str) -> None:
        """Note that the run has ended, and why."""
        ...

    def close(self) -> None:
        """Write what is buffered, and close the log."""
        ...


class RunLog:
    """Keeps a log up to date with ``metrics.csv``, while it receives the status of a run.

    Args:
        run_dir: the run's directory.
        name: the log's name, for messages.
        writer: writes it; used in this log's thread only.

    Attributes:
        name: the log's name.
    """

    def __init__(self, run_dir: Path, name: str, writer: Writer) -> None:
        self._run_dir = run_dir
        self.name = name
        self._writer = writer
        self._metrics = MetricsReader(run_dir)
        self._scalars = RowScalars(0)
        self._logged = Logged()
        self._has_begun = False
        self._eval_episodes = 0
        self._status: Status | None = None
        self._is_closing = False
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._work, name=f"log-{name}", daemon=True)
        self._thread.start()

    @property
    def place(self) -> str:
        """Where the log is. Empty if it has not begun."""
        return self._writer.place

    def show(self, status: Status) -> None:
        """Write what has happened since the last status."""
        self._status = status
        self._wake.set()

    def finish(self) -> None:
        """Begin to write the rest and to close the log; :meth:`join` waits for that."""
        self._is_closing = True
        self._wake.set()

    def join(self, patience_s: float = FINISH_S) -> None:
        """Wait until the log is closed, and warn if it is not after so many seconds."""
        self._thread.join(max(0.0, patience_s))
        if self._thread.is_alive():
            log.warning("the log for %s is incomplete: it takes too long to write", self.name)

    def _work(self) -> None:
        try:
            is_last = False
            while not is_last:
                if not self._wake.wait(_CHECK_S):
                    continue
                self._wake.clear()
                is_last = self._is_closing  # before the status, so that none is missed
                if self._status is not None:
                    self._update(self._status)
            self._writer.close()
        except Exception as error:  # noqa: BLE001 - of a foreign library, and the run continues
            log.warning(
                "the log for %s failed, and the run continues without it: %s",
                self.name, printable(f"{type(error).__name__}: {error}"),
            )  # fmt: skip

    def _update(self, status: Status) -> None:
        """Write the iterations and the end of the run that are not yet in the log."""
        if not self._has_begun:
            self._has_begun = True
            settings = settings_of(self._run_dir)
            self._eval_episodes = settings["eval_episodes"]
            began = time.time() - status.wall_s
            self._logged = self._writer.begin(status.run_id, settings, began)
        found = self._metrics.read()
        if found.is_new_file:  # a restarted replay service writes it again
            self._scalars = RowScalars(self._eval_episodes)
        new: list[Scalar] = []
        for row in found.rows:
            scalars, iteration = self._scalars.of(row), int(row["iteration"])
            if iteration > self._logged.iteration:
                new += scalars
                self._logged = Logged(iteration)
        is_end = status.state == "ended" and not self._logged.is_ended
        if is_end:
            new += final_scalars(status)
        if new:
            self._writer.write(new)
        if is_end:
            self._logged = self._logged._replace(is_ended=True)
            self._writer.end(status.ended_because)
