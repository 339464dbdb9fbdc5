"""One service in one process: signals, the parent's death, memory, exit codes."""

import contextlib
import ctypes
import logging
import os
import resource
import signal
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress

from udrl.errors import Interrupted, UdrlError

log = logging.getLogger("udrl")

#: Seconds that a service gets to end after SIGINT or SIGTERM.
GRACE_S = 4.0

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


def run_service(service: Callable[[threading.Event], None]) -> int:
    """Run a service until it returns or a signal comes; return the exit code.

    The service has the main thread, since some environments can be made and stepped nowhere else:
    those that handle signals, run an event loop or draw. A thread beside it hears of signals even
    while native code keeps the main thread, and ends the process if the service does not.
    The process may open more files from then on.
    """
    allow_open_files()
    stop = threading.Event()
    ended = threading.Event()
    received: list[int] = []
    ear, mouth = socket.socketpair()
    mouth.settimeout(0.0)

    def watch() -> None:
        number = ear.recv(1)[0]
        if number == 0:  # the service has ended
            return
        received.append(number)
        stop.set()
        if not ended.wait(GRACE_S):
            log.warning("the service did not end in %.0f s and is abandoned", GRACE_S)
            sys.stderr.flush()
            os._exit(128 + number)

    def on_signal(number: int, frame: object) -> None:
        # Nothing that takes a lock: the next signal may come in the middle of this one.
        with contextlib.suppress(OSError):
            mouth.send(bytes([number]))

    previous = {s: signal.signal(s, on_signal) for s in (signal.SIGINT, signal.SIGTERM)}
    # The interpreter writes to it at once, and calls on_signal when the main thread is back.
    before = signal.set_wakeup_fd(mouth.fileno(), warn_on_full_buffer=False)
    watcher = threading.Thread(target=watch, name="signals", daemon=True)
    watcher.start()
    error: UdrlError | None = None
    try:
        service(stop)
    except UdrlError as raised:
        error = raised
    finally:
        ended.set()
        signal.set_wakeup_fd(before)
        if not received:  # else the process ends, and may be told so again
            for number, handler in previous.items():
                signal.signal(number, handler)
        with contextlib.suppress(OSError):
            mouth.send(b"\0")
        watcher.join(1.0)
        mouth.close()
        ear.close()
    if received and (error is None or isinstance(error, Interrupted)):
        by = signal.Signals(received[0]).name
        log.warning("%s", f"{by}: {error or 'stopped'}")
        return 128 + received[0]
    if error is None:
        return 0
    log.error("%s", error)
    return error.exit_code
