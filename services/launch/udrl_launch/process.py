"""One service in one process: signals, the parent's death, memory, exit codes."""

import ctypes
import logging
import os
import resource
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress

from udrl.errors import Interrupted, UdrlError
from udrl_launch.signals import Signals

log = logging.getLogger("udrl")

#: Seconds that a service gets to end after SIGINT or SIGTERM; and one that has others to end.
GRACE_S, PARENTS_GRACE_S = 3.0, 4.5

_PR_SET_PDEATHSIG = 1

#: Six for each service that may join.
_MOST_FILES = 65_536

#: Parameters of the C library's ``mallopt``.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
#: The greatest that it takes for the second.
_MMAP_THRESHOLD = 32 * 2**20


def log_to_stderr(level: int = logging.INFO) -> None:
    """Let the log go to standard error, a line each, with the time."""
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)-7s %(message)s"))
    log.handlers[:] = [handler]
    log.setLevel(level)


def die_with_parent(parent: int) -> None:
    """Let the kernel end this process when its parent does, however that happens.

    Nothing is lost: a killed service is what the whole design is made for.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        sys.exit(0)


def allow_open_files() -> None:
    """Let this process have as many files open as it may; by default many systems say 1,024.

    Each service that joins is a connection of the replay service. More than fleets need is not
    asked for: some programs that environments start walk through all that could be open.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _MOST_FILES if hard == resource.RLIM_INFINITY else min(hard, _MOST_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with suppress(OSError, ValueError):  # another system's own limit is lower
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def keep_freed_memory() -> None:
    """Let this process keep what it frees, up to 1 GiB, for what it allocates next.

    Every update of a network for images allocates some dozens of MB and frees them again. By
    default that memory goes back to the kernel each time, which has to fill it with zeros the next
    time: a quarter of the update's time. Must be called before there are other threads. Does
    nothing where the C library is not glibc.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _MMAP_THRESHOLD)
        mallopt(_M_TRIM_THRESHOLD, 2**30)
        mallopt(_M_ARENA_MAX, 1)  # the arenas of other threads have a threshold of their own


def switch_threads_soon() -> float:
    """Let a thread that waits get the interpreter soon; return the seconds that it took before.

    An actor's courier must get it while the loop steps environments: at the default of 5 ms a
    query takes 5 ms instead of 0.2.
    """
    before = sys.getswitchinterval()
    sys.setswitchinterval(0.0005)
    return before


def run_service(service: Callable[[threading.Event], None], grace_s: float = GRACE_S) -> int:
    """Run a service until it returns or a signal comes; return the exit code.

    The service has the main thread, since some environments can be made and stepped nowhere else:
    those that handle signals, run an event loop or draw. The process may open more files from then
    on.

    Args:
        service: ends soon after the event that it is given is set.
        grace_s: seconds that it has for that.
    """
    allow_open_files()
    stop = threading.Event()
    error: UdrlError | None = None
    with Signals(stop, grace_s) as signals:
        try:
            service(stop)
        except UdrlError as raised:
            error = raised
    received = signals.received
    if received is not None and (error is None or isinstance(error, Interrupted)):
        log.warning("%s", f"{received.name}: {error or 'stopped'}")
        return 128 + received
    if error is None:
        return 0
    log.error("%s", error)
    return error.exit_code
