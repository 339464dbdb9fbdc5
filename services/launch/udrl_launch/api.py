"""``udrl.train``: what ``udrl train`` does, as a function.

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

#: Called with the status of a run; what returns False stops it.
Callback = Callable[[Status], bool | None]


@dataclass(frozen=True)
class Trained:
    """What came of a training.

    Attributes:
        run_dir: the run's directory, for everything that looks at runs.
        status: how it ended, or was when it was stopped (``docs/metrics.md``).
    """

    run_dir: Path
    status: Status

    @cached_property
    def policy(self) -> Policy:
        """The agent.

        Raises:
            StoreError: the run ended before anything was trained.
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
    """Train an agent: replay, learner and actors, from the first episode to the last evaluation.

    Args:
        environment: a Gymnasium id, registered or importable.
        run_dir: the run's directory; None: a new one in ``./runs``.
        preset: shipped settings; None: those named like the environment, else ``any``;
            ``"none"``: none.
        resume: go on with the run in ``run_dir``, if there is one.
        callbacks: called about twice a second with the run's status, and at the end; one that
            returns False stops the run, which can be resumed.
        in_process: all services as threads of this process; else a process each, faster for long
            runs.
        settings: any of ``docs/configuration.md``: of the run, its budget and its fleet.

    Raises:
        ConfigError: a setting is unknown or impossible.
        UdrlError: the run cannot be started, cannot go on, or failed.
    """
    if resume and run_dir is None:
        raise ConfigError("resume needs run_dir: the directory of the run to go on with")
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
    """Tells others of the run, and stops it if one of them wants that."""

    def __init__(self, callbacks: list[Callback], stop: threading.Event) -> None:
        self._callbacks = callbacks
        self._stop = stop

    def show(self, status: Status) -> None:
        for callback in self._callbacks:
            if callback(status) is False:
                self._stop.set()
