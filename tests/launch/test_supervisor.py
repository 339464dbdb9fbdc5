"""The supervisor restarts children that die, unless the error would repeat."""

import errno
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from udrl.config import Config
from udrl.errors import RunFailed, StoreError
from udrl_launch import supervisor as module
from udrl_launch.local import Processes
from udrl_launch.settings import gather
from udrl_launch.supervisor import Supervisor
from udrl_replay.creation import create_run

WAIT = "import time; time.sleep(100)"


@pytest.fixture
def supervisor(tmp_path: Path) -> Iterator[Supervisor]:
    one = Supervisor(tmp_path / "logs")
    yield one
    one.end()


def start(one: Supervisor, name: str, code: str) -> None:
    """Start Python code as a child; it ignores its other arguments."""
    one.start(name, prefix=(sys.executable, "-c", code))


def check_until(one: Supervisor, condition: Callable[[], bool]) -> None:
    pause = threading.Event()
    while not condition():
        one.check()
        pause.wait(0.01)


def pid(one: Supervisor) -> int:
    process = one.children[0].process
    assert process is not None
    return process.pid


def test_child_that_exits_normally_is_done(supervisor: Supervisor) -> None:
    start(supervisor, "child", "print('bye')")
    check_until(supervisor, lambda: supervisor.done)
    assert supervisor.children[0].log_tail() == "bye"


def test_killed_child_is_restarted(supervisor: Supervisor) -> None:
    start(supervisor, "child", WAIT)
    first = pid(supervisor)
    os.kill(first, signal.SIGKILL)
    check_until(supervisor, lambda: pid(supervisor) != first)
    assert not supervisor.done


@pytest.mark.parametrize("code", sorted(module.FINAL_CODES))
def test_permanent_error_is_not_retried(supervisor: Supervisor, code: int) -> None:
    start(supervisor, "child", f"print('because'); raise SystemExit({code})")
    with pytest.raises(RunFailed, match=f"child ended with code {code}:\nbecause") as failure:
        check_until(supervisor, lambda: False)
    assert failure.value.exit_code == code


def test_child_that_dies_without_progress_is_given_up(supervisor: Supervisor) -> None:
    start(supervisor, "child", "print('why'); raise SystemExit(1)")
    message = "child ended with code 1 6 times without progress:\nwhy"
    with pytest.raises(RunFailed, match=message):
        check_until(supervisor, lambda: False)


def test_child_that_makes_progress_is_always_restarted(supervisor: Supervisor) -> None:
    supervisor.start("actor-1", "actor", prefix=(sys.executable, "-c", "raise SystemExit(1)"))
    child, started = supervisor.children[0], set[int]()

    def has_restarted_often() -> bool:
        assert child.process is not None
        started.add(child.process.pid)
        supervisor.work["actor"] = len(started) // 4
        return len(started) >= 20

    check_until(supervisor, has_restarted_often)


def test_signal_is_reported_with_its_name_and_usual_cause(supervisor: Supervisor) -> None:
    start(supervisor, "child", "import os; os.kill(os.getpid(), 9)")
    message = r"child ended by SIGKILL \(killed, or out of memory\) 6 times"
    with pytest.raises(RunFailed, match=message):
        check_until(supervisor, lambda: False)
    assert module.how_it_ended(-11) == "ended by SIGSEGV (a crash in native code)"
    assert module.how_it_ended(-40) == "ended by signal 40"


def test_removed_log_is_tolerated(supervisor: Supervisor) -> None:
    start(supervisor, "child", WAIT)
    (log_file,) = (child.log_file for child in supervisor.children)
    log_file.unlink()
    supervisor.check()
    tail = supervisor.children[0].log_tail()
    assert tail == f"{log_file} cannot be read: No such file or directory"


def test_log_that_cannot_be_shortened_is_tolerated(
    supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_LONGEST_LOG", -1)
    start(supervisor, "child", WAIT)
    log_file = supervisor.children[0].log_file
    log_file.unlink()
    log_file.mkdir()
    supervisor.check()


def test_child_whose_log_folder_was_removed_is_restarted(supervisor: Supervisor) -> None:
    start(supervisor, "child", WAIT)
    first = pid(supervisor)
    shutil.rmtree(supervisor.children[0].log_file.parent)
    os.kill(first, signal.SIGKILL)
    check_until(supervisor, lambda: pid(supervisor) != first)


def test_log_folder_that_is_a_file_is_reported_with_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "logs").touch()
    supervisor = Supervisor(tmp_path / "logs")
    with pytest.raises(StoreError, match=r"child\.log cannot be written: .*; .* --resume"):
        start(supervisor, "child", WAIT)


class KilledProcess:
    """A process that was killed; a third one cannot be started."""

    started = 0

    def __init__(self, *_: object, **__: object) -> None:
        KilledProcess.started += 1
        if KilledProcess.started > 2:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    def poll(self) -> int:
        return -signal.SIGKILL

    def wait(self, timeout: float) -> int:
        return self.poll()


def test_service_that_cannot_be_restarted_is_a_failure_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = create_run(tmp_path / "run", Config(environment="Figure2-v0"))
    settings = gather("Figure2-v0", preset_name="none", options={"actors": 0})
    monkeypatch.setattr(subprocess, "Popen", KilledProcess)
    services = Processes(
        tmp_path / "run", store, settings, "tcp/127.0.0.1:1", insecure=False, keys=None
    )
    expected = "cannot start replay: Resource temporarily unavailable; free memory, processes or"
    assert str(services.failure()).startswith(expected)
    assert services.failure() is services.failure()
    services.end()


def test_long_log_is_shortened(supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_LONGEST_LOG", 4000)
    chatty = (
        "import os, time\n"
        "for n in range(20_000): print('line', n, flush=True)\n"
        "while os.fstat(1).st_size > 4000: time.sleep(0.01)\n"
        "print('end')"
    )
    start(supervisor, "child", chatty)
    check_until(supervisor, lambda: supervisor.done)
    supervisor.children[0].shorten_log()
    log_file = supervisor.children[0].log_file
    assert log_file.stat().st_size <= 4000
    assert log_file.read_text().splitlines()[0] == "... earlier output was removed"
    # The child may be in the middle of a line when its log is shortened: "line end" is right, too.
    assert supervisor.children[0].log_tail().endswith("end")


def test_end_kills_an_unresponsive_child(
    supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "END_S", 0.2)
    ready = supervisor._log_dir / "child.log"
    start(
        supervisor,
        "child",
        "import signal,time; signal.signal(signal.SIGTERM, signal.SIG_IGN); "
        "print('ready', flush=True); time.sleep(100)",
    )
    check_until(supervisor, lambda: "ready" in ready.read_text())
    supervisor.end()
    process = supervisor.children[0].process
    assert process is not None
    assert process.returncode == -signal.SIGKILL


def test_no_child_is_restarted_after_the_first_is_done(supervisor: Supervisor) -> None:
    start(supervisor, "first", "pass")
    check_until(supervisor, lambda: supervisor.children[0].done)
    start(supervisor, "other", "raise SystemExit(1)")
    check_until(supervisor, lambda: supervisor.done)
    assert supervisor.children[1].starts == 1


def test_remaining_children_are_ended_after_a_grace_period(
    supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "END_S", 0.2)
    start(supervisor, "first", "pass")
    start(supervisor, "other", WAIT)
    check_until(supervisor, lambda: supervisor.done)
    assert not supervisor.children[1].done
    supervisor.end()
    other = supervisor.children[1].process
    assert other is not None
    assert other.returncode == -signal.SIGTERM


def test_child_that_ends_long_before_the_first_is_restarted(
    supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_AHEAD_S", 0.2)
    start(supervisor, "first", WAIT)
    start(supervisor, "other", "print('bye')")
    with pytest.raises(RunFailed, match="other ended with code 0 6 times without progress:\nbye"):
        check_until(supervisor, lambda: False)


def test_killed_first_child_is_restarted(supervisor: Supervisor) -> None:
    start(supervisor, "first", WAIT)
    start(supervisor, "other", "pass")
    check_until(supervisor, lambda: supervisor.children[1].done)
    first = pid(supervisor)
    os.kill(first, signal.SIGKILL)
    check_until(supervisor, lambda: pid(supervisor) != first)
    assert not supervisor.done
