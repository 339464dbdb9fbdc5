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


def page_faults(program: str) -> int:
    """Return how many pages the kernel had to find for each round."""
    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True
    )
    return int(ended.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="it is a setting of glibc")
def test_freed_memory_is_kept() -> None:
    assert page_faults(PROGRAM.replace("KEEP", "keep_freed_memory()")) < 100
    # The control: 64 MB are 16,384 pages.
    assert page_faults(PROGRAM.replace("KEEP", "")) > 1000
