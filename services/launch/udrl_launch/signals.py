"""SIGINT and SIGTERM for services and commands, whose main thread may be in native code."""

import contextlib
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from typing import NoReturn, Self

log = logging.getLogger("udrl")

_STOPPING = (signal.SIGINT, signal.SIGTERM)


class Signals:
    """Receives signals in its own thread, and ends the process if the service does not end.

    Args:
        stop: set when a signal arrives.
        grace_s: seconds for the service to end after that.

    Attributes:
        received: the first signal that arrived, or None.
    """

    _active: "Signals | None" = None

    def __init__(self, stop: threading.Event, grace_s: float) -> None:
        self.received: signal.Signals | None = None
        self._stop = stop
        self._grace_s = grace_s
        self._ended = threading.Event()
        self._receiver, self._sender = socket.socketpair()
        self._sender.settimeout(0.0)
        self._thread = threading.Thread(target=self._receive, name="signals", daemon=True)

    def __enter__(self) -> Self:
        self._previous = {number: signal.signal(number, self._handle) for number in _STOPPING}
        # The interpreter writes to this descriptor at once, but calls _handle only when the main
        # thread runs Python again. Some programs, such as event loops, replace the descriptor;
        # _handle still works then.
        self._wakeup_before = signal.set_wakeup_fd(self._sender.fileno(), warn_on_full_buffer=False)
        self._thread.start()
        Signals._active = self
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        Signals._active = None
        signal.set_wakeup_fd(self._wakeup_before)
        if self.received is None:  # else the process ends, and more signals may arrive
            self._restore()
        self._send(0)
        self._thread.join(1.0)
        self._close()

    def _handle(self, number: int, frame: object) -> None:
        # Must not take a lock: the next signal may arrive during this one.
        self._send(number)

    def _send(self, number: int) -> None:
        with contextlib.suppress(OSError):
            self._sender.send(bytes([number]))

    def _receive(self) -> None:
        """Wait for SIGINT or SIGTERM; an environment may use other signals."""
        while (number := self._receiver.recv(1)[0]) not in _STOPPING:
            if number == 0:  # the service has ended
                return
        self.received = signal.Signals(number)
        self._stop.set()
        if not self._ended.wait(self._grace_s):
            log.warning("the service did not stop within %.0f s; exiting", self._grace_s)
            sys.stderr.flush()
            os._exit(128 + number)

    def _restore(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _close(self) -> None:
        self._sender.close()
        self._receiver.close()

    @classmethod
    def reset_in_child(cls) -> None:
        """Restore the handlers in a forked child, whose signals would otherwise stop the parent."""
        active, cls._active = cls._active, None
        if active is not None:
            signal.set_wakeup_fd(-1)
            active._restore()
            active._close()


class Terminated(KeyboardInterrupt):
    """SIGTERM ends a command as SIGINT does, but with its own exit code."""


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """Raise :class:`Terminated` when SIGTERM arrives.

    Without a handler, pygame takes SIGTERM for the event that a window is closed, also if there is
    no window, and the process does not end.
    """
    previous = signal.signal(signal.SIGTERM, _raise_terminated)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


def _raise_terminated(number: int, frame: object) -> NoReturn:
    raise Terminated


os.register_at_fork(after_in_child=Signals.reset_in_child)
