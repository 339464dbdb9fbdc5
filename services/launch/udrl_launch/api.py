"""``udrl.train``: the command ``udrl train`` as a function.

::

    import udrl

    trained = udrl.train("CartPole-v1", max_env_steps=100_000, seed=7)
    print(trained.status.final_evaluation.mean)
    action = trained.policy.predict(observation, desired_return=400, desired_horizon=400)
"""

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from udrl.errors import ConfigError, Interrupted, RunFailed, UdrlError
from udrl.policy import Policy
from udrl_inspect.agents import load_agent
from udrl_inspect.inspection import last_iteration, read_status, settings_to_resume
from udrl_launch.paths import new_run_dir
from udrl_launch.settings import gather
from udrl_launch.training_run import run_training
from udrl_proto.reports import EvaluationStatus, IterationStatus, Status
from udrl_replay.creation import directory_name
from udrl_replay.store import EVALUATION_COLUMNS
from udrl_show.metrics_file import MetricsReader
from udrl_show.run_logs import opened

#: Called with the status of a run. It stops the run by returning False.
Callback = Callable[[Status], bool | None]
#: Called with a completed iteration. It stops the run by returning False.
IterationCallback = Callable[[IterationStatus], bool | None]
#: Called with an evaluation. It stops the run by returning False.
EvaluationCallback = Callable[[EvaluationStatus], bool | None]


@dataclass(frozen=True)
class Trained:
    """The result of a training.

    Attributes:
        run_dir: the run's directory.
        status: the run's status when it ended or was stopped (``docs/metrics.md``).
    """

    run_dir: Path
    status: Status

    @cached_property
    def policy(self) -> Policy:
        """The agent.

        Raises:
            StoreError: the run ended before any weights were trained.
        """
        return load_agent(self.run_dir).policy


def train(
    environment: str,
    *,
    run_dir: str | Path | None = None,
    preset: str | None = None,
    resume: bool = False,
    callbacks: Callback | Iterable[Callback] = (),
    on_iteration: IterationCallback | None = None,
    on_evaluation: EvaluationCallback | None = None,
    on_end: Callable[[Status], object] | None = None,
    log: str | Iterable[str] = (),
    in_process: bool = True,
    **settings: Any,
) -> Trained:
    """Train an agent until its final evaluation.

    Args:
        environment: a Gymnasium id, registered or importable.
        run_dir: the run's directory. None: a new one in ``./runs``.
        preset: a preset. None: the one named after the environment, else ``any``. ``"none"``: the
            defaults.
        resume: resume the run in ``run_dir``, if there is one.
        callbacks: called with the run's status about twice a second, and at the end.
        on_iteration: called once with each iteration, in order.
        on_evaluation: called once with each evaluation, in order. The final evaluation is in the
            status that ``on_end`` receives.
        on_end: called once with the last status, when the run has ended, failed or was stopped.
        log: programs to log to: ``tensorboard``, ``wandb``, ``mlflow``.
        in_process: run all services as threads of this process. False: as separate processes,
            which is faster for long runs.
        settings: any setting of ``docs/configuration.md``, by name. Numbers of env steps can be
            strings, such as ``"3M"``.

    If one of ``callbacks``, ``on_iteration`` or ``on_evaluation`` returns False, the run is stopped
    and can be resumed. So it is if one raises an exception, which is passed on; ``on_end`` is then
    not called.

    Raises:
        ConfigError: a setting is unknown or invalid.
        UdrlError: the run cannot be started, cannot continue, or failed.
    """
    if resume and run_dir is None:
        raise ConfigError("resume needs run_dir, the directory of the run to resume")
    to_call = [callbacks] if callable(callbacks) else list(callbacks)
    _require_functions(callbacks=to_call)
    events = {"on_iteration": on_iteration, "on_evaluation": on_evaluation, "on_end": on_end}
    _require_functions(**{name: [one] for name, one in events.items() if one is not None})
    chosen = None if run_dir is None else Path(run_dir).absolute()
    stored = settings_to_resume(chosen if resume else None)
    gathered = gather(environment, preset_name=preset, stored=stored, options=settings)
    folder = chosen or new_run_dir(directory_name(gathered.config))
    stop = threading.Event()
    after = -1 if stored is None else last_iteration(folder)
    watcher = _Callbacks(folder, after, gathered.config.evaluation.eval_episodes, stop)
    watcher.on_status += to_call
    watcher.on_iteration, watcher.on_evaluation = on_iteration, on_evaluation
    try:
        with opened([log] if isinstance(log, str) else log, folder) as run_logs:
            watcher.on_status += [run_log.show for run_log in run_logs]
            status = run_training(
                gathered, folder, stop, resume=resume, in_process=in_process, watcher=watcher
            )
            watcher.show(status)
    except Interrupted:
        status = read_status(folder)
        watcher.show(status)
    except RunFailed:
        if on_end is not None:
            on_end(read_status(folder))
        raise
    if on_end is not None:
        on_end(status)
    if status.problem:
        raise UdrlError(status.problem)
    return Trained(folder, status)


def _require_functions(**values: Iterable[object]) -> None:
    """Raise :class:`ConfigError` for values of a parameter that are not functions."""
    for name, several in values.items():
        for value in several:
            if not callable(value):
                raise ConfigError(f"{name}: {value!r} is not a function; pass one, or leave it out")


class _Callbacks:
    """Calls callbacks, and stops the run if one returns False.

    Args:
        run_dir: the run's directory, whose metrics have the iterations.
        after: the last iteration completed before; -1: none.
        eval_episodes: number of episodes in an evaluation.
        stop: stops the run.
    """

    def __init__(
        self, run_dir: Path, after: int, eval_episodes: int, stop: threading.Event
    ) -> None:
        self.on_status: list[Callback] = []
        self.on_iteration: IterationCallback | None = None
        self.on_evaluation: EvaluationCallback | None = None
        self._metrics = MetricsReader(run_dir)
        self._after = after
        self._eval_episodes = eval_episodes
        self._stop = stop

    def show(self, status: Status) -> None:
        if self.on_iteration is not None or self.on_evaluation is not None:
            for row in self._metrics.read().rows:
                if int(row["iteration"]) > self._after:
                    self._after = int(row["iteration"])
                    self._events(row)
        for callback in self.on_status:
            self._stop_if_false(callback(status))

    def _events(self, row: dict[str, str]) -> None:
        values = {name: value or None for name, value in row.items()}
        if self.on_iteration is not None:
            found = {name: values[name] for name in IterationStatus.__struct_fields__}
            iteration = msgspec.convert(found, IterationStatus, strict=False)
            self._stop_if_false(self.on_iteration(iteration))
        if self.on_evaluation is not None and values["eval_mean"] is not None:
            found = {name: values[column] for column, name in EVALUATION_COLUMNS.items()}
            found |= {"iteration": values["iteration"], "episodes": str(self._eval_episodes)}
            found = {name: found[name] for name in EvaluationStatus.__struct_fields__}
            evaluation = msgspec.convert(found, EvaluationStatus, strict=False)
            self._stop_if_false(self.on_evaluation(evaluation))

    def _stop_if_false(self, returned: bool | None) -> None:
        # Comparisons of numpy's numbers return its own False.
        if isinstance(returned, bool | np.bool_) and not returned:
            self._stop.set()
