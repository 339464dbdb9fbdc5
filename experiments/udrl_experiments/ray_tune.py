"""Runs on Ray Tune: on this machine, or unchanged on a cluster that Ray has been started on."""

import logging
import os
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import msgspec

from udrl.errors import ConfigError, Interrupted, RunFailed, Unreachable
from udrl_experiments import jobs
from udrl_experiments.jobs import INTERRUPTED, Job

#: Cores that a run is reckoned with.
_CORES = 2


def run_jobs(
    planned: Iterable[Job],
    root: Path,
    side_by_side: int,
    stop: threading.Event,
    echo: Callable[[str], None],
) -> None:
    """Do all runs that are not done; as :func:`udrl_experiments.jobs.run_jobs`, by Ray Tune.

    With ``RAY_ADDRESS`` set, the runs go to that cluster; ``root`` must be a folder that all its
    machines share. What was done is known by what lies there, so nothing of Ray's is kept.

    A run that fails does not end the search: hyperparameters that a run cannot be made with are
    what a search finds out.

    Raises:
        ConfigError: Ray is not installed.
        Unreachable: nobody answers at ``RAY_ADDRESS``.
        RunFailed: every run failed.
        Interrupted: ``stop`` was set.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_CHDIR_TO_TRIAL_DIR", "0")
    try:
        import ray
        from ray import tune
    except ModuleNotFoundError as error:
        raise ConfigError(
            'the search needs Ray Tune; install it with: pip install "udrl[studies]"'
        ) from error
    waiting = {job.name: job for job in jobs.merge_jobs(planned) if not job.done(root)}
    if not waiting:
        return

    class Watch(tune.Callback):
        def __reduce__(self) -> tuple[type[tune.Callback], tuple[()]]:
            return tune.Callback, ()  # Tune saves it with what could be restored; nobody does

        def on_step_begin(self, iteration: int, trials: list[Any], **info: Any) -> None:
            if stop.is_set():
                echo(INTERRUPTED)
                raise Interrupted(INTERRUPTED)

        def on_trial_start(
            self, iteration: int, trials: list[Any], trial: Any, **info: Any
        ) -> None:
            echo(waiting[trial.config["name"]].described)

    def trial(config: dict[str, str]) -> dict[str, float]:
        job = msgspec.json.decode(config["job"], type=Job)
        jobs.run_jobs([job], root, 1, threading.Event(), lambda text: None)
        return {"evaluations": len(job.evaluations(root))}

    echo(f"{len(waiting)} runs on Ray Tune, {side_by_side} at a time")
    if address := os.environ.get("RAY_ADDRESS"):
        try:
            ray.init(logging_level=logging.WARNING)
        except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
            raise Unreachable(
                f"RAY_ADDRESS = {address}: {error}; start Ray there (ray start --head), or unset it"
            ) from error
    else:
        cores = _CORES * side_by_side
        ray.init(num_cpus=cores, include_dashboard=False, logging_level=logging.WARNING,
                 _node_ip_address="127.0.0.1")  # fmt: skip
    try:
        results = tune.Tuner(
            tune.with_resources(trial, {"cpu": _CORES}),
            param_space=tune.grid_search(
                [{"name": name, "job": msgspec.json.encode(job).decode()}
                 for name, job in waiting.items()]
            ),
            tune_config=tune.TuneConfig(max_concurrent_trials=side_by_side),
            run_config=tune.RunConfig(
                name="ray", storage_path=str(root.resolve()), verbose=0, callbacks=[Watch()],
            ),
        ).fit()  # fmt: skip
        for failure in results.errors:
            echo(f"a run failed: {failure}")
        if len(results.errors) == len(waiting):
            raise RunFailed(f"no run succeeded; the first failed with: {results.errors[0]}")
    finally:
        ray.shutdown()
