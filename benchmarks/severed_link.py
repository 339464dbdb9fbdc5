"""A TCP proxy between services and their router, which can be stalled and severed."""

import contextlib
import socket
import threading
from collections.abc import Iterator

from udrl_launch.training_run import free_port

_CHUNK = 1 << 16
_TRY_AGAIN_S = 0.2


class SeveredLink:
    """Forwards connections to the replay service, unless it is stalled or severed."""

    def __init__(self) -> None:
        self._target = free_port()
        self._flows = threading.Event()
        self._flows.set()
        self._refuses = False
        self._ends = threading.Event()
        self._sockets: set[socket.socket] = set()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.listen = f"tcp/127.0.0.1:{self._target}"
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self.listen_options: tuple[str, ...] = ()
        self.prefix: tuple[str, ...] = ()
        threading.Thread(target=self._accept, name="link", daemon=True).start()

    @contextlib.contextmanager
    def stalled(self) -> Iterator[None]:
        """Forward nothing, without an error, like an unplugged cable."""
        self._flows.clear()
        try:
            yield
        finally:
            self._flows.set()

    @contextlib.contextmanager
    def severed(self) -> Iterator[None]:
        """Close all connections and refuse new ones, like a firewall or a dead router."""
        self._refuses = True
        self._close_all()
        try:
            yield
        finally:
            self._refuses = False

    def close(self) -> None:
        """Close the proxy and all connections."""
        self._ends.set()
        self._flows.set()
        self._listener.close()
        self._close_all()

    def _close_all(self) -> None:
        for one in list(self._sockets):
            self._close(one)

    def _close(self, one: socket.socket) -> None:
        self._sockets.discard(one)
        with contextlib.suppress(OSError):  # the other side may have closed it already
            one.shutdown(socket.SHUT_RDWR)
        one.close()

    def _accept(self) -> None:
        while not self._ends.is_set():
            try:
                here, _ = self._listener.accept()
            except OSError:
                return  # closed
            if self._refuses:
                here.close()
                continue
            try:
                there = socket.create_connection(("127.0.0.1", self._target), timeout=_TRY_AGAIN_S)
            except OSError:
                here.close()  # the router is dead, so the connection is too
                continue
            there.settimeout(None)
            self._sockets |= {here, there}
            for source, sink in ((here, there), (there, here)):
                threading.Thread(target=self._pump, args=(source, sink), daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        try:
            while chunk := source.recv(_CHUNK):
                self._flows.wait()
                sink.sendall(chunk)
        except OSError:
            pass  # severed, or one side died; close the other side too
        finally:
            self._close(source)
            self._close(sink)
