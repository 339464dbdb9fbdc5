"""A service as a process: signals, death of the parent, memory, exit codes."""

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
from udrl_launch.output import print_error
from udrl_launch.signals import Signals

log = logging.getLogger("udrl")

#: Seconds for a service to end after SIGINT or SIGTERM; more if it has children to end.
GRACE_S, PARENTS_GRACE_S = 3.0, 4.5

_PR_SET_PDEATHSIG = 1

#: Limit of open files to set: six for each service that may join.
_MOST_FILES = 65_536

#: Parameters of the C library's ``mallopt``.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
#: Largest value of ``M_MMAP_THRESHOLD``.
_MMAP_THRESHOLD = 32 * 2**20


def log_to_stderr(level: int = logging.INFO) -> None:
    """Write the log to standard error, one line per message, with the time."""
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)-7s %(message)s"))
    log.handlers[:] = [handler]
    log.setLevel(level)


def die_with_parent(parent: int) -> None:
    """Let the kernel kill this process when its parent ends (Linux).

    Nothing is lost: services may be killed at any time.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        sys.exit(0)


def allow_open_files() -> None:
    """Raise the limit of open files of this process; the default is often 1,024.

    Each service that joins is a connection of the replay service. The limit is raised only as far
    as fleets need: some programs that environments start iterate over all possible descriptors.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _MOST_FILES if hard == resource.RLIM_INFINITY else min(hard, _MOST_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with suppress(OSError, ValueError):  # some systems have a lower limit
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def keep_freed_memory() -> None:
    """Let this process reuse freed memory, up to 1 GiB, instead of returning it to the kernel.

    Every update of a network for images allocates and frees some dozens of MB. By default that
    memory is returned to the kernel, which zeroes it when it is allocated again: a quarter of the
    update's time. Must be called before other threads start. Has no effect unless the C library is
    glibc.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _MMAP_THRESHOLD)
        mallopt(_M_TRIM_THRESHOLD, 2**30)
        mallopt(_M_ARENA_MAX, 1)  # arenas of other threads have their own threshold


def switch_threads_soon() -> float:
    """Shorten the interpreter's switch interval; return the previous one in seconds.

    An actor's command fetcher needs the interpreter while the loop steps environments: at the
    default of 5 ms a query takes 5 ms instead of 0.2.
    """
    before = sys.getswitchinterval()
    sys.setswitchinterval(0.0005)
    return before


def run_service(service: Callable[[threading.Event], None], grace_s: float = GRACE_S) -> int:
    """Run a service until it returns or a signal arrives; return the exit code.

    The service runs in the main thread, because some environments must be created and stepped
    there: those that handle signals, run an event loop or draw. Also raises the limit of open
    files.

    Args:
        service: must return soon after its argument is set.
        grace_s: seconds for that, after which the process exits.
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
    print_error(error)
    return error.exit_code
