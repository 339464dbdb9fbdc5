"""``udrl.train``: the command ``udrl train`` as a function.

::

    import udrl

    trained = udrl.train("CartPole-v1", max_env_steps=100_000, seed=7)
    print(trained.status.closing_evaluation.mean)
    action = trained.policy.predict(observation, desired_return=400, desired_horizon=400)
"""

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from udrl.errors import ConfigError, Interrupted, UdrlError
from udrl.policy import Policy
from udrl_inspect.agents import load_agent
from udrl_inspect.inspection import read_status, settings_of
from udrl_launch.paths import new_run_dir
from udrl_launch.settings import gather
from udrl_launch.training import train as run_training
from udrl_proto.reports import Status
from udrl_replay.creation import directory_name, exists

#: Called with the status of a run. It stops the run by returning False.
Callback = Callable[[Status], bool | None]


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
        callbacks: called with the run's status about twice a second, and at the end. A callback
            that returns False stops the run, which can then be resumed.
        in_process: run all services as threads of this process. False: as separate processes,
            which is faster for long runs.
        settings: any setting of ``docs/configuration.md``, by name.

    Raises:
        ConfigError: a setting is unknown or invalid.
        UdrlError: the run cannot be started, cannot continue, or failed.
    """
    if resume and run_dir is None:
        raise ConfigError("resume needs run_dir, the directory of the run to resume")
    chosen = None if run_dir is None else Path(run_dir).absolute()
    going_on = resume and chosen is not None and exists(chosen)
    gathered = gather(
        environment,
        preset_name=preset,
        stored=settings_of(chosen) if going_on and chosen is not None else None,
        options=settings,
    )
    folder = chosen or new_run_dir(directory_name(gathered.config))
    stop = threading.Event()
    watcher = _Callbacks([callbacks] if callable(callbacks) else list(callbacks), stop)
    try:
        status = run_training(
            gathered, folder, stop, go_on=resume, in_process=in_process, watcher=watcher
        )
    except Interrupted:
        status = read_status(folder)
    watcher.show(status)
    if status.problem:
        raise UdrlError(status.problem)
    return Trained(folder, status)


class _Callbacks:
    """Passes the status to callbacks, and stops the run if one returns False."""

    def __init__(self, callbacks: list[Callback], stop: threading.Event) -> None:
        self._callbacks = callbacks
        self._stop = stop

    def show(self, status: Status) -> None:
        for callback in self._callbacks:
            if callback(status) is False:
                self._stop.set()
