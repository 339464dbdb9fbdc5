"""TensorBoard's event files, written from ``metrics.csv`` while it grows."""

import csv
import os
import time
from pathlib import Path
from typing import Any

from udrl.errors import ConfigError
from udrl_proto.reports import Status

#: The names that others use for the same, and the columns that they are.
TAGS = {
    "rollout/ep_rew_mean": "explored_return",
    "rollout/desired_return_min": "commanded_min",
    "rollout/desired_return_max": "commanded_max",
    "train/loss": "loss",
    "replay/return_min": "return_min",
    "replay/return_mean": "return_mean",
    "replay/return_max": "return_max",
    "replay/admitted": "admitted",
    "time/iterations": "iteration",
    "time/wall_s": "wall_s",
}
#: Of evaluations, which stand at env steps of their own.
EVALUATION_TAGS = {
    "eval/mean_reward": "eval_mean",
    "eval/ci95_low": "eval_ci95_low",
    "eval/ci95_high": "eval_ci95_high",
    "eval/desired_return": "eval_desired_return",
    "eval/desired_horizon": "eval_desired_horizon",
}

FOLDER = "tensorboard"


class EventFiles:
    """The event files of a run, made anew whenever somebody begins to work on it.

    Args:
        run_dir: the run's directory.

    Raises:
        ConfigError: the extra is not installed, or the folder cannot be written.
    """

    def __init__(self, run_dir: Path) -> None:
        try:
            from tensorboard.compat.proto.event_pb2 import Event
            from tensorboard.compat.proto.summary_pb2 import Summary
            from tensorboard.summary.writer.event_file_writer import EventFileWriter
        except ModuleNotFoundError as error:
            raise ConfigError(
                'event files need tensorboard; install it with: pip install "udrl[tensorboard]"'
            ) from error
        self._metrics = run_dir / "metrics.csv"
        self._folder = run_dir / FOLDER
        self._kind, self._event, self._summary = EventFileWriter, Event, Summary
        self._writer: Any = None
        self._read = 0
        self._columns: list[str] = []
        self._file: os.stat_result | None = None
        self._began = 0.0
        self._before = (0.0, 0.0)
        self._is_closed = False
        self._begin()

    def show(self, status: Status) -> None:
        """Write what has come to ``metrics.csv`` since the last time."""
        try:
            with self._metrics.open("rb") as file:
                self._begin_if_new(os.fstat(file.fileno()), status)
                file.seek(self._read)
                text = file.read()
        except FileNotFoundError:
            return  # the replay service has not written anything yet
        whole = text[: text.rfind(b"\n") + 1]
        self._read += len(whole)
        for row in csv.reader(whole.decode().splitlines()):
            if self._columns:
                self._write(dict(zip(self._columns, row, strict=True)))
            else:
                self._columns = row
        if status.closing_evaluation is not None and not self._is_closed:
            self._is_closed = True
            found, at = status.closing_evaluation, self._began + status.wall_s
            for tag, value in (
                ("eval/mean_reward", found.mean),
                ("eval/ci95_low", found.ci95_low),
                ("eval/ci95_high", found.ci95_high),
            ):
                self._add(tag, value, found.env_steps, at)
        self._writer.flush()

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            self._writer.close()

    def _begin_if_new(self, found: os.stat_result, status: Status) -> None:
        """Begin again if this is another file, or it has been begun anew."""
        held, self._file = self._file, found
        if held is None or held.st_ino != found.st_ino or found.st_size < self._read:
            if held is not None:
                self._begin()
            self._read, self._columns = 0, []
            self._before, self._is_closed = (0.0, 0.0), False
            self._began = time.time() - status.wall_s

    def _begin(self) -> None:
        """Open a file of events in the place of those that are there."""
        self.close()
        try:
            for old in self._folder.glob("events.out.tfevents.*"):
                old.unlink()
            self._writer = self._kind(str(self._folder))
        except OSError as error:
            raise ConfigError(
                f"{self._folder}: {error.strerror}; make it a folder that you may write"
            ) from error

    def _add(self, tag: str, value: float, step: int, at: float) -> None:
        scalar = self._summary.Value(tag=tag, simple_value=value)
        summary = self._summary(value=[scalar])
        self._writer.add_event(self._event(wall_time=at, step=step, summary=summary))

    def _write(self, row: dict[str, str]) -> None:
        at = self._began + float(row["wall_s"])
        for tags, steps in ((TAGS, "env_steps"), (EVALUATION_TAGS, "eval_at_env_steps")):
            for tag, column in tags.items():
                if row[column] and row[steps]:
                    self._add(tag, float(row[column]), int(row[steps]), at)
        now = float(row["env_steps"]), float(row["wall_s"])
        if now[1] > self._before[1]:
            speed = (now[0] - self._before[0]) / (now[1] - self._before[1])
            self._add("time/fps", speed, int(now[0]), at)
            self._before = now
