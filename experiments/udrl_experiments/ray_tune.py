"""Runs on Ray Tune: on this machine, or on a Ray cluster."""

import logging
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec

from udrl.errors import ConfigError, Interrupted, RunFailed, UdrlError, Unreachable
from udrl_experiments.jobs import Job
from udrl_experiments.processes import INTERRUPTED, run_jobs
from udrl_experiments.runs import unfinished

#: Cores that Ray reserves for a run.
_CORES = 2

#: Environment variables that Ray reads.
_ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_CHDIR_TO_TRIAL_DIR": "0",
    "RAY_AIR_NEW_OUTPUT": "0",  # the new output ignores verbose=0: it prints tables and paths
    "TUNE_PRINT_ALL_TRIAL_ERRORS": "0",  # with tracebacks; failures are reported here
}
#: Loggers of Ray that warn about its defaults, which the user did not choose.
_DEFAULTS_LOGGERS = ("ray._private.authentication",)


def run_jobs_on_ray(
    planned: Iterable[Job],
    root: Path,
    side_by_side: int,
    stop: threading.Event,
    echo: Callable[[str], None],
) -> None:
    """Run all jobs that are not finished on Ray Tune.

    Otherwise it is like :func:`udrl_experiments.processes.run_jobs`. With ``RAY_ADDRESS`` set, the
    runs go to that cluster, and ``root`` must be a folder that all its machines share. Finished
    runs are recognised by their files; nothing that Ray writes is read.

    A failed run does not end the search, because some hyperparameters may be unusable.

    Raises:
        ConfigError: Ray is not installed.
        Unreachable: there is no Ray cluster at ``RAY_ADDRESS``.
        RunFailed: every run failed.
        Interrupted: ``stop`` was set.
    """
    waiting = {job.name: job for job in unfinished(planned, root)}
    if not waiting:
        return
    tune = _import_tune()
    failures: list[str] = []

    def report_failure(name: str, cause: str) -> None:
        failures.append(cause)
        echo(f"failed: {waiting[name].described}: {cause}")

    watch = _watch(tune, stop, lambda name: echo(waiting[name].described), report_failure)

    def run_trial(config: dict[str, str]) -> dict[str, str]:
        job = msgspec.json.decode(config["job"], type=Job)
        try:
            run_jobs([job], root, 1, threading.Event(), lambda text: None)
        except (UdrlError, OSError) as error:  # Ray would print the traceback
            return {"failure": str(error)}
        return {"failure": ""}

    echo(f"{len(waiting)} runs on Ray Tune, {side_by_side} at a time")
    with _ray(side_by_side):
        try:
            tune.Tuner(
                tune.with_resources(run_trial, {"cpu": _CORES}),
                param_space=tune.grid_search(
                    [{"name": name, "job": msgspec.json.encode(job).decode()}
                     for name, job in waiting.items()]
                ),
                tune_config=tune.TuneConfig(max_concurrent_trials=side_by_side),
                run_config=tune.RunConfig(
                    name="ray", storage_path=str(root.resolve()), verbose=0, callbacks=[watch],
                ),
            ).fit()  # fmt: skip
        except Interrupted:
            echo(INTERRUPTED)
            raise
    if len(failures) == len(waiting):
        raise RunFailed(f"no run succeeded; the first failed: {failures[0]}")


def _import_tune() -> Any:
    for name, value in _ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    try:
        from ray import tune
    except ModuleNotFoundError as error:
        raise ConfigError(
            'the search needs Ray Tune; install it with: pip install "udrl[studies]"'
        ) from error
    for name in _DEFAULTS_LOGGERS:
        logging.getLogger(name).setLevel(logging.ERROR)
    return tune


@contextmanager
def _ray(side_by_side: int) -> Iterator[None]:
    """Connect to the cluster at ``RAY_ADDRESS``, or start Ray on this machine."""
    import ray

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
        yield
    finally:
        ray.shutdown()


def _watch(
    tune: Any,
    stop: threading.Event,
    report_start: Callable[[str], None],
    report_failure: Callable[[str, str], None],
) -> Any:
    """Return a callback of Tune that reports runs by their names, and ends the search."""

    class Watch(tune.Callback):  # type: ignore[misc]  # Ray may be missing
        def __reduce__(self) -> tuple[type[Any], tuple[()]]:
            # Tune pickles its callbacks to restore an experiment, which is never done here.
            return tune.Callback, ()

        def on_step_begin(self, iteration: int, trials: list[Any], **info: Any) -> None:
            if stop.is_set():
                raise Interrupted(INTERRUPTED)

        def on_trial_start(
            self, iteration: int, trials: list[Any], trial: Any, **info: Any
        ) -> None:
            report_start(trial.config["name"])

        def on_trial_complete(
            self, iteration: int, trials: list[Any], trial: Any, **info: Any
        ) -> None:
            if cause := trial.last_result.get("failure"):
                report_failure(trial.config["name"], cause)

        def on_trial_error(
            self, iteration: int, trials: list[Any], trial: Any, **info: Any
        ) -> None:
            # An error of Ray, e.g. a killed worker. Only its first line is for users.
            error = trial.get_pickled_error() or trial.get_error()
            cause = str(getattr(error, "cause", error)).strip()
            report_failure(trial.config["name"], cause.partition("\n")[0])

    return Watch()
