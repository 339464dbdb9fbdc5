"""TensorBoard event files."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from udrl.errors import ConfigError
from udrl.file_remedies import file_remedy
from udrl_show.run_log import Logged
from udrl_show.scalars import Scalar

FOLDER = "tensorboard"


class EventFiles:
    """The event files of a run, rewritten from the first iteration at every start.

    The run's settings are their hyperparameters.

    Args:
        run_dir: the run's directory.

    Raises:
        ConfigError: the extra is not installed.
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
        self._event, self._summary, self._hyperparameters = Event, Summary, hparams_pb
        self._open = EventFileWriter
        self._folder = run_dir / FOLDER
        self._began = 0.0
        self._writer: Any = None
        self.place = ""

    def begin(self, run_id: str, settings: dict[str, Any], began: float) -> Logged:
        """Replace older files, and write the settings.

        Not earlier: until the run is served, its directory may belong to another process.

        Raises:
            ConfigError: the folder cannot be written.
        """
        self._began = began
        try:
            for old in self._folder.glob("events.out.tfevents.*"):
                old.unlink()
            self._writer = self._open(str(self._folder))
        except OSError as error:
            what_to_do = file_remedy(error, "make it a writable folder")
            raise ConfigError(f"{self._folder}: {error.strerror}; {what_to_do}") from error
        self.place = str(self._folder)
        values = {
            name: value if isinstance(value, bool | int | float | str) else json.dumps(value)
            for name, value in settings.items()
        }
        summary = self._hyperparameters(values, trial_id=run_id, start_time_secs=began)
        self._writer.add_event(self._event(wall_time=began, summary=summary))
        return Logged()

    def write(self, scalars: Sequence[Scalar]) -> None:
        """Write scalars."""
        for tag, value, env_steps, wall_s in scalars:
            summary = self._summary(value=[self._summary.Value(tag=tag, simple_value=value)])
            event = self._event(wall_time=self._began + wall_s, step=env_steps, summary=summary)
            self._writer.add_event(event)
        self._writer.flush()

    def end(self, because: str) -> None:
        """Write the rest; event files do not say why a run ended."""
        self._writer.flush()

    def close(self) -> None:
        """Close the file."""
        if self._writer is not None:
            self._writer.close()
