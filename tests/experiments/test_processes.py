import os
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.experiments.finished_runs import job
from udrl.errors import Interrupted, RunFailed
from udrl_experiments import processes
from udrl_experiments.processes import run_jobs
from udrl_experiments.runs import read_job

TABLE = (
    "environment,algorithm,variant,seed,env_steps,wall_s,mean,std,episodes\n"
    "CartPole-v1,UDRL,,1,105,1.0,2.0,3.0,4\n"
)
FINISH = f"""
open(folder + '/evaluations.csv', 'w').write({TABLE!r})
asked = json.load(open(folder + '/job.json'))['max_env_steps']
json.dump({{'max_env_steps': asked}}, open(folder + '/done.json', 'w'))
"""
#: Writes the process's id and sleeps.
LAST = "open(folder + '/pid', 'w').write(str(os.getpid())); time.sleep(600)"


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Replace a run by a line of Python, which has the variables ``folder`` and ``json``."""

    def replace(line: str) -> None:
        code = f"import json, os, shutil, sys, time\nfolder = sys.argv[1]\n{line}"
        monkeypatch.setattr(processes, "_PROGRAM", ("-c", code))

    return replace


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
