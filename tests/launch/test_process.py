import platform
import signal
import subprocess
import sys

import pytest

#: Frees and allocates 64 MB a hundred times, in a thread as services do.
PROGRAM = """
import resource, threading
from udrl_launch.process import keep_freed_memory

KEEP

def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

def work(times):
    for _ in range(times):
        held = [b"1" * 2**23 for _ in range(8)]
        del held

def service():
    work(3)
    before = faults()
    work(100)
    print((faults() - before) // 100)

thread = threading.Thread(target=service)
thread.start()
thread.join()
"""


def number_printed_by(program: str) -> int:
    """Return the number that a program prints."""
    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True
    )
    return int(ended.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="it is a setting of glibc")
def test_freed_memory_is_kept() -> None:
    assert number_printed_by(PROGRAM.replace("KEEP", "keep_freed_memory()")) < 100
    # The control: 64 MB are 16,384 pages.
    assert number_printed_by(PROGRAM.replace("KEEP", "")) > 1000


SERVICE = """
import os, signal, threading, time
from udrl.errors import Interrupted, StoreError
from udrl_launch.process import log_to_stderr, run_service

log_to_stderr()

def service(stop):
    assert threading.current_thread() is threading.main_thread()
    signal.signal(signal.SIGUSR1, lambda *_: None)  # as some environments do
    print("up", flush=True)
    BODY

os._exit(run_service(service))  # as the command does: at its end Python drops all handlers
"""


def ended(body: str, *signals: int) -> tuple[int, str]:
    """Run a service and send it signals once it is up; return its exit code and its log."""
    with subprocess.Popen(
        [sys.executable, "-c", SERVICE.replace("BODY", body)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        for number in signals:
            process.send_signal(number)
        _, log = process.communicate(timeout=30)
    return process.returncode, log


def test_service_runs_in_the_main_thread_and_its_error_sets_the_exit_code() -> None:
    assert ended("pass") == (0, "")
    code, log = ended("raise StoreError('the disk is gone')")
    assert code == 8
    assert log == "udrl: error: the disk is gone\n"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_stops_a_service(number: signal.Signals) -> None:
    code, log = ended("assert stop.wait(20)", number)
    assert code == 128 + number
    assert "stopped" in log
    code, log = ended("assert stop.wait(20); raise Interrupted('in the middle')", number, number)
    assert code == 128 + number
    assert "in the middle" in log


def test_other_signals_are_left_to_the_environment() -> None:
    body = (
        "alarms = []; signal.signal(signal.SIGALRM, lambda *_: alarms.append(1)); "
        "signal.setitimer(signal.ITIMER_REAL, 0.01, 0.01); "
        "deadline = time.monotonic() + 20\n"
        "    while len(alarms) < 5 and time.monotonic() < deadline: signal.sigtimedwait([], 0.05)\n"
        "    signal.setitimer(signal.ITIMER_REAL, 0); assert len(alarms) >= 5\n"
        "    assert not stop.is_set()"
    )
    assert ended(body) == (0, "")


def test_forked_child_handles_its_own_signals() -> None:
    body = (
        "import multiprocessing as m; context = m.get_context('fork'); up = context.Event(); "
        "child = context.Process(target=lambda: (up.set(), time.sleep(30))); child.start(); "
        "assert up.wait(10); child.terminate(); child.join(10); "
        "assert child.exitcode == -15, child.exitcode; assert not stop.is_set()"
    )
    assert ended(body) == (0, "")


def test_unresponsive_service_is_abandoned() -> None:
    code, log = ended("time.sleep(20)", signal.SIGTERM)
    assert code == 128 + signal.SIGTERM
    assert "did not stop within 3 s; exiting" in log


@pytest.mark.parametrize(("given", "found"), [(256, 4096), (4096, 4096), (16, 4096)])
def test_limit_of_open_files_is_raised_to_the_maximum(given: int, found: int) -> None:
    program = (
        "from resource import RLIMIT_NOFILE, getrlimit, setrlimit\n"
        "from udrl_launch.process import allow_open_files\n"
        f"setrlimit(RLIMIT_NOFILE, ({given}, 4096))\n"
        "allow_open_files()\n"
        "print(getrlimit(RLIMIT_NOFILE)[0])"
    )
    assert number_printed_by(program) == found
