import fcntl
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from tests.experiments.finished_runs import CONFIG, evaluated, job
from udrl.config import flat
from udrl.errors import RunFailed, RunInUse
from udrl_experiments import job as job_module
from udrl_experiments.job import run_job
from udrl_experiments.jobs import Job
from udrl_experiments.records import EvaluationRecord
from udrl_inspect.csv_tables import read


def test_evaluations_of_an_extended_run_are_those_of_a_long_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    final, kept, later = (
        msgspec.structs.replace(evaluated(n), mean=mean)
        for n, mean in ((100, 1.0), (150, 2.0), (100, 3.0))
    )
    tables = iter([[final, kept], [later, evaluated(200)]])
    monkeypatch.setattr(job_module, "run_training", lambda *_, **__: SimpleNamespace(problem=""))
    monkeypatch.setattr(job_module, "_evaluations", lambda *_: next(tables))
    (tmp_path / "run").mkdir()
    for _ in range(2):
        run_job(job(), tmp_path, threading.Event())
    rows = read(tmp_path / "evaluations.csv", EvaluationRecord)
    assert rows == [later, kept, evaluated(200)]


@pytest.mark.parametrize(
    ("state", "kept"), [("run", True), ("state.safetensors", True), ("", False)]
)
def test_run_with_records_only_starts_from_the_beginning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, state: str, *, kept: bool
) -> None:
    def fail(*arguments: Any, **others: Any) -> None:
        raise RunFailed("later")

    monkeypatch.setattr(job_module, "run_training", fail)
    (tmp_path / "done.json").write_text("{}")
    if state:
        (tmp_path / state).touch()
    with pytest.raises(RunFailed, match="later"):
        run_job(job(), tmp_path, threading.Event())
    assert (tmp_path / "done.json").exists() is kept


def test_run_is_locked_against_other_processes(tmp_path: Path) -> None:
    dqn = Job(algorithm="DQN", settings=flat(CONFIG), max_env_steps=10)
    with (tmp_path / "lock").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(RunInUse, match="another process is running"):
            run_job(dqn, tmp_path, threading.Event())
