"""One service in one process: signals, the parent's death, memory, exit codes."""

import ctypes
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable

from udrl.errors import Interrupted, UdrlError

log = logging.getLogger("udrl")

#: Seconds that a service gets to end after SIGINT or SIGTERM.
GRACE_S = 4.0

_PR_SET_PDEATHSIG = 1

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
    """Run a service in a thread until it returns or a signal comes; return the exit code.

    The main thread only waits, so that a signal is answered at once whatever the service does.
    """
    stop = threading.Event()
    outcome: list[BaseException | None] = []

    def target() -> None:
        try:
            service(stop)
            outcome.append(None)
        except BaseException as error:  # noqa: BLE001 - handed to the main thread, which reports it
            outcome.append(error)

    received: list[int] = []

    def on_signal(number: int, frame: object) -> None:
        # Nothing that takes a lock: the next signal may come in the middle of this one.
        received.append(number)

    previous = {s: signal.signal(s, on_signal) for s in (signal.SIGINT, signal.SIGTERM)}
    thread = threading.Thread(target=target, name="service", daemon=True)
    thread.start()
    try:
        while thread.is_alive() and not received and not stop.is_set():
            thread.join(0.2)
        if received:
            stop.set()
        thread.join(GRACE_S)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    if thread.is_alive():
        log.warning("the service did not end in %.0f s and is abandoned", GRACE_S)
        sys.stderr.flush()
        os._exit(128 + received[0] if received else 1)
    error = outcome[0]
    if received and (error is None or isinstance(error, Interrupted)):
        by = signal.Signals(received[0]).name
        log.warning("%s", f"{by}: {error or 'stopped'}")
        return 128 + received[0]
    if error is None:
        return 0
    if isinstance(error, UdrlError):
        log.error("%s", error)
        return error.exit_code
    raise error
