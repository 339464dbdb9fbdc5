"""TensorBoard event files, written from ``metrics.csv`` during a run."""

import json
import time
from pathlib import Path
from typing import Any

from udrl.errors import ConfigError
from udrl_inspect.inspection import settings_of
from udrl_proto.reports import Status
from udrl_show.metrics_file import MetricsReader

#: Columns by tag; the tags are those of other libraries.
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
#: Columns by tag for evaluations, which have their own env steps.
EVALUATION_TAGS = {
    "eval/mean_reward": "eval_mean",
    "eval/ci95_low": "eval_ci95_low",
    "eval/ci95_high": "eval_ci95_high",
    "eval/desired_return": "eval_desired_return",
    "eval/desired_horizon": "eval_desired_horizon",
}
#: Tags of values computed from two rows.
DERIVED_TAGS = ("rollout/ep_len_mean", "time/fps")

FOLDER = "tensorboard"


class EventFiles:
    """The event files of a run, rewritten from the first iteration at every start.

    The run's settings are their hyperparameters.

    Args:
        run_dir: the run's directory.

    Raises:
        ConfigError: the extra is not installed, or the folder cannot be written.
    """

    def __init__(self, run_dir: Path) -> None:
        try:
            from tensorboard.compat.proto.event_pb2 import Event
            from tensorboard.compat.proto.summary_pb2 import Summary
            from tensorboard.plugins.hparams.summary_v2 import hparams_pb
            from tensorboard.summary.writer.event_file_writer import EventFileWriter
        except ModuleNotFoundError as error:
            raise ConfigError(
                'event files need tensorboard; install it with: pip install "udrl[tensorboard]"'
            ) from error
        self._run_dir = run_dir
        self._folder = run_dir / FOLDER
        self._metrics = MetricsReader(run_dir)
        self._kind, self._event, self._summary = EventFileWriter, Event, Summary
        self._hyperparameters = hparams_pb
        self._writer: Any = None
        self._has_rows = False
        self._began = 0.0
        self._eval_episodes = 0
        self._env_steps = 0
        self._timed = 0, 0.0
        self._is_closed = False
        self._begin()

    def show(self, status: Status) -> None:
        """Write the rows of ``metrics.csv`` since the last call."""
        found = self._metrics.read()
        if found.is_new_file:
            if self._has_rows:
                self._begin()
            self._has_rows = True
            self._env_steps, self._timed, self._is_closed = 0, (0, 0.0), False
            self._began = time.time() - status.wall_s
            self._write_settings(status.run_id)
        if not self._has_rows:
            return
        for row in found.rows:
            self._write(row)
        if status.closing_evaluation is not None and not self._is_closed:
            self._is_closed = True
            final, at = status.closing_evaluation, self._began + status.wall_s
            for tag, value in (
                ("eval/mean_reward", final.mean),
                ("eval/ci95_low", final.ci95_low),
                ("eval/ci95_high", final.ci95_high),
            ):
                self._add(tag, value, final.env_steps, at)
        self._writer.flush()

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            self._writer.close()

    def _begin(self) -> None:
        """Replace the event files by a new one."""
        self.close()
        try:
            for old in self._folder.glob("events.out.tfevents.*"):
                old.unlink()
            self._writer = self._kind(str(self._folder))
        except OSError as error:
            raise ConfigError(
                f"{self._folder}: {error.strerror}; make it a writable folder"
            ) from error

    def _write_settings(self, run_id: str) -> None:
        settings = settings_of(self._run_dir)
        self._eval_episodes = settings["eval_episodes"]
        values = {
            name: value if isinstance(value, bool | int | float | str) else json.dumps(value)
            for name, value in settings.items()
        }
        summary = self._hyperparameters(values, trial_id=run_id, start_time_secs=self._began)
        self._writer.add_event(self._event(wall_time=self._began, summary=summary))

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
        env_steps, wall_s = int(row["env_steps"]), float(row["wall_s"])
        episodes = int(row["commands"]) - (self._eval_episodes if row["eval_mean"] else 0)
        if episodes > 0:
            length = (env_steps - self._env_steps) / episodes
            self._add("rollout/ep_len_mean", length, env_steps, at)
        self._env_steps = env_steps
        if wall_s > self._timed[1]:  # iterations can be complete at the same moment
            speed = (env_steps - self._timed[0]) / (wall_s - self._timed[1])
            self._add("time/fps", speed, env_steps, at)
            self._timed = env_steps, wall_s
