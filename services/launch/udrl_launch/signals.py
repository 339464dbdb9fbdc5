"""SIGINT and SIGTERM for a service in the main thread, which native code may block."""

import contextlib
import logging
import os
import signal
import socket
import sys
import threading
from typing import Self

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

    _heard: "Signals | None" = None

    def __init__(self, stop: threading.Event, grace_s: float) -> None:
        self.received: signal.Signals | None = None
        self._stop = stop
        self._grace_s = grace_s
        self._ended = threading.Event()
        self._ear, self._mouth = socket.socketpair()
        self._mouth.settimeout(0.0)
        self._thread = threading.Thread(target=self._listen, name="signals", daemon=True)

    def __enter__(self) -> Self:
        self._previous = {number: signal.signal(number, self._tell) for number in _STOPPING}
        # The interpreter writes to it at once, and calls _tell once the main thread runs Python
        # again. Some programs, such as event loops, replace it; _tell still works then.
        self._wakeup_before = signal.set_wakeup_fd(self._mouth.fileno(), warn_on_full_buffer=False)
        self._thread.start()
        Signals._heard = self
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        Signals._heard = None
        signal.set_wakeup_fd(self._wakeup_before)
        if self.received is None:  # else the process ends, and more signals may arrive
            self._restore()
        self._say(0)
        self._thread.join(1.0)
        self._close()

    def _tell(self, number: int, frame: object) -> None:
        # Must not take a lock: the next signal may arrive during this one.
        self._say(number)

    def _say(self, number: int) -> None:
        with contextlib.suppress(OSError):
            self._mouth.send(bytes([number]))

    def _listen(self) -> None:
        """Wait for SIGINT or SIGTERM; an environment may use other signals."""
        while (number := self._ear.recv(1)[0]) not in _STOPPING:
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
        self._mouth.close()
        self._ear.close()

    @classmethod
    def forget(cls) -> None:
        """Restore the signals in a forked child, whose signals would otherwise stop the parent."""
        heard, cls._heard = cls._heard, None
        if heard is not None:
            signal.set_wakeup_fd(-1)
            heard._restore()
            heard._close()


os.register_at_fork(after_in_child=Signals.forget)
