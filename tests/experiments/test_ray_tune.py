"""Searches with a stand-in for Ray; ``tests/integration/test_studies.py`` uses Ray itself."""

import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from udrl.config import Config, build, flat
from udrl.errors import Interrupted, RunFailed
from udrl_experiments import processes, ray_tune
from udrl_experiments.jobs import Job
from udrl_experiments.ray_tune import run_jobs_on_ray

CONFIG = build(Config, {"environment": "CartPole-v1", "eval_every": 100})
JOBS = [
    Job(algorithm="UDRL", settings=flat(CONFIG), max_env_steps=n, hyperparameters={"n": n})
    for n in (1000, 2000)
]


class Tuner:
    """Runs the trials in order, as Ray Tune does."""

    def __init__(self, trainable: Callable[[Any], Any], **options: Any) -> None:
        self.trainable, self.configs = trainable, options["param_space"]
        (self.callback,) = options["run_config"].callbacks

    def fit(self) -> None:
        for config in self.configs:
            trial = SimpleNamespace(config=config, last_result={})
            self.callback.on_step_begin(0, [])
            self.callback.on_trial_start(0, [], trial)
            try:
                trial.last_result = self.trainable(config)
                self.callback.on_trial_complete(0, [], trial)
            except RuntimeError as error:
                trial.get_pickled_error = lambda error=error: error
                self.callback.on_trial_error(0, [], trial)


@pytest.fixture(autouse=True)
def ray(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace Ray."""
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    package, tune = ModuleType("ray"), ModuleType("ray.tune")
    attributes = {
        "Callback": object, "Tuner": Tuner, "TuneConfig": SimpleNamespace,
        "RunConfig": SimpleNamespace, "grid_search": list,
        "with_resources": lambda trainable, resources: trainable,
    }  # fmt: skip
    for name, value in attributes.items():
        setattr(tune, name, value)
    for name in ("init", "shutdown"):
        setattr(package, name, lambda **options: None)
    setattr(package, "tune", tune)  # noqa: B010 - mypy knows no such attribute
    monkeypatch.setitem(sys.modules, "ray", package)
    monkeypatch.setitem(sys.modules, "ray.tune", tune)


def test_each_failed_run_is_one_line_with_its_cause(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("RAY_AIR_NEW_OUTPUT", "TUNE_PRINT_ALL_TRIAL_ERRORS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(processes, "_PROGRAM", ("-c", "raise ValueError('no luck')"))
    lines: list[str] = []
    with pytest.raises(
        RunFailed, match=r"no run succeeded; the first failed: .*exit code 1: ValueError: no luck"
    ):
        run_jobs_on_ray(JOBS, tmp_path, 1, threading.Event(), lines.append)
    assert lines[0] == "2 runs on Ray Tune, 1 at a time"
    assert lines[1::2] == [job.described for job in JOBS]
    for line, job in zip(lines[2::2], JOBS, strict=True):
        assert line.startswith(f"failed: {job.described}: the run in {job.folder(tmp_path)} failed")
        assert "ValueError: no luck" in line
        assert "\n" not in line
    # Ray prints tables, paths and tracebacks without these.
    assert os.environ["RAY_AIR_NEW_OUTPUT"] == os.environ["TUNE_PRINT_ALL_TRIAL_ERRORS"] == "0"


def test_error_of_ray_is_its_first_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def die(*arguments: Any) -> None:
        raise RuntimeError("The actor died unexpectedly.\n\tclass_name: ImplicitFunc")

    monkeypatch.setattr(ray_tune, "run_jobs", die)
    lines: list[str] = []
    with pytest.raises(RunFailed, match=r"the first failed: The actor died unexpectedly\.$"):
        run_jobs_on_ray(JOBS[:1], tmp_path, 1, threading.Event(), lines.append)
    assert lines[2:] == [f"failed: {JOBS[0].described}: The actor died unexpectedly."]


def test_some_failed_runs_do_not_fail_the_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail_once(planned: list[Job], *others: Any) -> None:
        if planned[0].max_env_steps == 1000:
            raise RunFailed("no luck")

    monkeypatch.setattr(ray_tune, "run_jobs", fail_once)
    lines: list[str] = []
    run_jobs_on_ray(JOBS, tmp_path, 1, threading.Event(), lines.append)
    assert [line for line in lines if line.startswith("failed")] == [
        f"failed: {JOBS[0].described}: no luck"
    ]


def test_stop_interrupts_the_search(tmp_path: Path) -> None:
    stop = threading.Event()
    stop.set()
    lines: list[str] = []
    with pytest.raises(Interrupted, match="--resume"):
        run_jobs_on_ray(JOBS, tmp_path, 1, stop, lines.append)
    assert "--resume" in lines[-1]
