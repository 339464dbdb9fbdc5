"""The programs that a run can be logged to."""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from udrl.errors import ConfigError, Interrupted
from udrl_show.event_files import EventFiles
from udrl_show.mlflow_writer import MlflowWriter
from udrl_show.run_log import FINISH_S, STOP_S, RunLog, Writer
from udrl_show.wandb_writer import WandbWriter

WRITERS: dict[str, Callable[[Path], Writer]] = {
    "tensorboard": EventFiles,
    "wandb": WandbWriter,
    "mlflow": MlflowWriter,
}


@contextmanager
def opened(names: Iterable[str], run_dir: Path) -> Iterator[list[RunLog]]:
    """Open the logs of a run, and close them at the end.

    Args:
        names: names from :data:`WRITERS`.
        run_dir: the run's directory.

    Raises:
        ConfigError: a name is unknown, or an extra is not installed.
    """
    wanted = list(dict.fromkeys(names))
    for name in wanted:
        if name not in WRITERS:
            raise ConfigError(f"log {name!r}: expected one of {', '.join(WRITERS)}")
    writers = [(name, WRITERS[name](run_dir)) for name in wanted]
    logs = [RunLog(run_dir, name, writer) for name, writer in writers]
    patience_s = FINISH_S
    try:
        yield logs
    except Interrupted:
        patience_s = STOP_S
        raise
    finally:
        deadline = time.monotonic() + patience_s
        for log in logs:
            log.finish()
        for log in logs:
            log.join(deadline - time.monotonic())
