import platform
import subprocess
import sys

import pytest

#: Frees 64 MB and allocates them again, a hundred times, in a thread as a service does.
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


def said_by(program: str) -> int:
    """Return the number that a program prints."""
    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True
    )
    return int(ended.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="it is a setting of glibc")
def test_freed_memory_is_kept() -> None:
    assert said_by(PROGRAM.replace("KEEP", "keep_freed_memory()")) < 100
    # The control: 64 MB are 16,384 pages.
    assert said_by(PROGRAM.replace("KEEP", "")) > 1000


@pytest.mark.parametrize(("given", "found"), [(256, 4096), (4096, 4096), (16, 4096)])
def test_as_many_files_may_be_open_as_the_system_allows(given: int, found: int) -> None:
    program = (
        "from resource import RLIMIT_NOFILE, getrlimit, setrlimit\n"
        "from udrl_launch.process import allow_open_files\n"
        f"setrlimit(RLIMIT_NOFILE, ({given}, 4096))\n"
        "allow_open_files()\n"
        "print(getrlimit(RLIMIT_NOFILE)[0])"
    )
    assert said_by(program) == found
