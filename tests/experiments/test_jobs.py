import fcntl
import os
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from tests.experiments.finished_runs import finish
from udrl.config import Config, build, change, flat
from udrl.errors import ConfigError, Interrupted, InvalidData, RunFailed, RunInUse
from udrl_experiments import job as job_module
from udrl_experiments import jobs
from udrl_experiments.job import run_job
from udrl_experiments.jobs import (
    RECORDS,
    Job,
    copy_finished,
    merge_jobs,
    read_job,
    require_runs,
    run_jobs,
)
from udrl_experiments.records import EvaluationRecord
from udrl_inspect.csv_tables import read, write

CONFIG = build(Config, {"environment": "CartPole-v1", "eval_every": 100})


def job(max_env_steps: int = 1000, variant: str = "", **changes: Any) -> Job:
    settings = flat(change(CONFIG, **changes))
    return Job(algorithm="UDRL", settings=settings, max_env_steps=max_env_steps, variant=variant)


TABLE = (
    "environment,algorithm,variant,seed,env_steps,wall_s,mean,std,episodes\n"
    "CartPole-v1,UDRL,,1,105,1.0,2.0,3.0,4\n"
)


def evaluated(env_steps: int) -> EvaluationRecord:
    return EvaluationRecord(
        environment="CartPole-v1", algorithm="UDRL", variant="", seed=1,
        env_steps=env_steps, wall_s=1.0, mean=2.0, std=3.0, episodes=4,
    )  # fmt: skip


def test_runs_of_equal_settings_share_a_folder() -> None:
    planned = [job(100), job(50, "short"), job(300, "long"), job(10, seed=2)]
    assert [(one.config.seed, one.max_env_steps) for one in merge_jobs(planned)] == [
        (1, 300),
        (2, 10),
    ]


@pytest.mark.parametrize("change", [{"seed": 2}, {"lead": 1}, {"environment": "Acrobot-v1"}])
def test_other_settings_give_another_folder(change: dict[str, Any]) -> None:
    assert job(**change).name != job().name


def test_names_do_not_depend_on_defaults() -> None:
    settings = {name: v for name, v in flat(CONFIG).items() if name != "advantage_bound"}
    before = Job(algorithm="UDRL", settings=settings, max_env_steps=1)
    after = Job(algorithm="UDRL", settings=flat(CONFIG), max_env_steps=1)
    assert before.name == after.name
    assert job().name == "udrl-cartpole-v1-seed1-9b61e2eb49be"


def test_a_finished_run_with_other_defaults_is_another_run(tmp_path: Path) -> None:
    one = job(100_000)
    finish(tmp_path, one)
    assert one.done(tmp_path)
    stored = msgspec.structs.replace(one, settings=one.settings | {"memory_size": 65})
    (one.folder(tmp_path) / "job.json").write_bytes(msgspec.json.encode(stored))
    assert not one.done(tmp_path)


def test_other_hyperparameters_give_another_folder() -> None:
    dqn = Job(algorithm="DQN", settings=flat(CONFIG), max_env_steps=1)
    other = msgspec.structs.replace(dqn, hyperparameters={"gamma": 0.9})
    assert len({job().name, dqn.name, other.name}) == 3


def test_evaluations_beyond_the_budget_are_left_out(tmp_path: Path) -> None:
    one = job(300, "mine")
    one.folder(tmp_path).mkdir(parents=True)
    rows = [evaluated(n) for n in (105, 203, 310, 400, 950)]
    write(one.folder(tmp_path) / "evaluations.csv", EvaluationRecord, rows)
    found = one.evaluations(tmp_path)
    assert [(row.env_steps, row.variant) for row in found] == [
        (105, "mine"),
        (203, "mine"),
        (310, "mine"),
    ]


@pytest.mark.parametrize(
    ("text", "done"),
    [('{"max_env_steps": 1000}', True), ('{"max_env_steps": 999}', False), ("", False),
     ("[]", False), ('{"max_env_steps": null}', False), ('{"max_env_steps": 1e999}', False)],
)  # fmt: skip
def test_run_is_done_if_it_reached_its_budget(tmp_path: Path, text: str, *, done: bool) -> None:
    folder = job().folder(tmp_path)
    folder.mkdir(parents=True)
    (folder / "job.json").write_bytes(msgspec.json.encode(job()))
    (folder / "done.json").write_text(text, encoding="utf-8")
    assert not job().done(tmp_path), "without evaluations it is not done"
    write(folder / "evaluations.csv", EvaluationRecord, [evaluated(2000)])
    assert not job().done(tmp_path), "nor with evaluations that are too late"
    write(folder / "evaluations.csv", EvaluationRecord, [evaluated(105)])
    assert job().done(tmp_path) is done


def test_folder_without_a_run_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(InvalidData, match=r"job\.json"):
        read_job(tmp_path)


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Replace a run by a line of Python, which has the variables ``folder`` and ``json``."""

    def replace(line: str) -> None:
        code = f"import json, os, shutil, sys, time\nfolder = sys.argv[1]\n{line}"
        monkeypatch.setattr(jobs, "_PROGRAM", ("-c", code))

    return replace


FINISH = f"""
open(folder + '/evaluations.csv', 'w').write({TABLE!r})
asked = json.load(open(folder + '/job.json'))['max_env_steps']
json.dump({{'max_env_steps': asked}}, open(folder + '/done.json', 'w'))
"""
#: Writes the process's id and sleeps.
LAST = "open(folder + '/pid', 'w').write(str(os.getpid())); time.sleep(600)"


def ignore(text: str) -> None:
    """Print nothing."""


def test_finished_run_is_not_repeated(tmp_path: Path, program: Callable[[str], None]) -> None:
    program(FINISH)
    printed: list[str] = []
    planned = [job(seed=n) for n in (1, 2, 3)]
    run_jobs(planned[:2], tmp_path, 2, threading.Event(), printed.append)
    assert len(printed) == 2
    run_jobs(planned, tmp_path, 2, threading.Event(), printed.append)
    assert printed[2:] == ["[1/1] UDRL, CartPole-v1, seed 3: 1,000 env steps"]
    assert read_job(planned[2].folder(tmp_path)) == planned[2]


def test_number_of_concurrent_runs_is_limited(
    tmp_path: Path, program: Callable[[str], None]
) -> None:
    # Each run has a file while it exists, and counts the files of the others.
    program(
        "root = os.path.dirname(folder); mark = folder + '.on'; open(mark, 'w').close(); "
        "time.sleep(0.5); n = sum(f.endswith('.on') for f in os.listdir(root)); "
        "open(folder + '.count', 'w').write(str(n)); os.remove(mark)\n" + FINISH
    )
    run_jobs([job(seed=n) for n in range(4)], tmp_path, 2, threading.Event(), ignore)
    counts = [int(file.read_text()) for file in (tmp_path / "runs").glob("*.count")]
    assert len(counts) == 4
    assert max(counts) == 2


def names_in(folder: Path) -> set[str]:
    return {file.name for file in folder.iterdir()}


def test_records_of_finished_runs_are_copied_and_not_repeated(
    tmp_path: Path, program: Callable[[str], None]
) -> None:
    first, second, here = (tmp_path / name for name in ("first", "second", "here"))
    program(FINISH)
    run_jobs([job(seed=1), job(seed=2)], first, 1, threading.Event(), ignore)
    run_jobs([job(2000, seed=2)], second, 1, threading.Event(), ignore)
    printed: list[str] = []
    wanted = [job(seed=1), job(2000, seed=2), job(seed=3)]
    copy_finished(wanted, here, [first, second], printed.append)
    assert printed == [
        f"copied from {first}: UDRL, CartPole-v1, seed 1: 1,000 env steps",
        f"copied from {second}: UDRL, CartPole-v1, seed 2: 2,000 env steps",
    ]
    for one, source in ((wanted[0], first), (wanted[1], second)):
        assert names_in(one.folder(here)) == set(RECORDS) < names_in(one.folder(source))
        for name in RECORDS:
            kept = one.folder(here) / name
            assert kept.read_bytes() == (one.folder(source) / name).read_bytes()

    del printed[:]
    copy_finished(wanted, here, [first, second], printed.append)  # they have been copied
    run_jobs(wanted, here, 1, threading.Event(), printed.append)
    assert printed == ["[1/1] UDRL, CartPole-v1, seed 3: 1,000 env steps"]


def test_folder_without_runs_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "runs" / "lander").mkdir(parents=True)
    with pytest.raises(
        ConfigError, match=r"--runs-from .*runs: expected a folder of studies.*--folder"
    ):
        require_runs([tmp_path / "runs"])


@pytest.mark.parametrize("state", ["run", "state.safetensors"])
def test_records_are_not_copied_over_a_run_that_can_be_continued(
    tmp_path: Path, program: Callable[[str], None], state: str
) -> None:
    program(FINISH)
    other, here = tmp_path / "other", tmp_path / "here"
    run_jobs([job(2000)], other, 1, threading.Event(), ignore)
    run_jobs([job()], here, 1, threading.Event(), ignore)
    (job().folder(here) / state).touch()
    copy_finished([job(2000)], here, [other], ignore)
    assert job().done(here)
    assert not job(2000).done(here)


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


class SetWhenRunning(threading.Event):
    """Set as soon as a run has written its process's id."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.file = folder / "pid"

    @property
    def pid(self) -> int:
        text = self.file.read_text() if self.file.exists() else ""
        return int(text or 0)

    def wait(self, timeout: float | None = None) -> bool:
        return bool(self.pid) or super().wait(timeout)


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_stop_ends_active_runs(tmp_path: Path, program: Callable[[str], None]) -> None:
    program(LAST)
    stop, printed = SetWhenRunning(job().folder(tmp_path)), list[str]()
    with pytest.raises(Interrupted, match="--resume"):
        run_jobs([job()], tmp_path, 1, stop, printed.append)
    assert "--resume" in printed[-1]
    assert not is_running(stop.pid)


def test_failure_is_reported_with_its_last_output_and_ends_the_others(
    tmp_path: Path, program: Callable[[str], None]
) -> None:
    lasting = job(seed=1)
    pid = str(lasting.folder(tmp_path) / "pid")
    program(
        f"if folder == {str(lasting.folder(tmp_path))!r}: {LAST}\n"
        f"while not (os.path.exists({pid!r}) and open({pid!r}).read()): time.sleep(0.01)\n"
        "print('no such luck', file=sys.stderr); sys.exit(7)"
    )
    with pytest.raises(RunFailed, match="no such luck") as raised:
        run_jobs([lasting, job(seed=2)], tmp_path, 2, threading.Event(), ignore)
    assert raised.value.exit_code == 7
    assert not is_running(SetWhenRunning(lasting.folder(tmp_path)).pid)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("raise ValueError('no luck')", r"failed with exit code 1: ValueError: no luck; see .*log"),
        (
            "print('udrl: error: full\\nlast lines of a service', file=sys.stderr); sys.exit(8)",
            "failed with exit code 8: full; see",
        ),
        ("sys.exit(3)", "failed with exit code 3: no output; see"),
        ("os.kill(os.getpid(), 9)", "was killed by signal 9; see"),
    ],
)
def test_failure_is_one_line_with_its_cause(
    tmp_path: Path, program: Callable[[str], None], line: str, message: str
) -> None:
    folder = job().folder(tmp_path)
    folder.mkdir(parents=True)
    (folder / "log.txt").write_text("udrl: error: of an earlier process\n", encoding="utf-8")
    program(line)
    with pytest.raises(RunFailed, match=message) as raised:
        run_jobs([job()], tmp_path, 1, threading.Event(), ignore)
    assert "\n" not in str(raised.value)


def test_run_without_evaluations_is_reported(
    tmp_path: Path, program: Callable[[str], None]
) -> None:
    program("")
    with pytest.raises(RunFailed, match=r"without an evaluation within 1,000 env steps; raise"):
        run_jobs([job()], tmp_path, 1, threading.Event(), ignore)


def test_run_is_locked_against_other_processes(tmp_path: Path) -> None:
    dqn = Job(algorithm="DQN", settings=flat(CONFIG), max_env_steps=10)
    with (tmp_path / "lock").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(RunInUse, match="another process is running"):
            run_job(dqn, tmp_path, threading.Event())
