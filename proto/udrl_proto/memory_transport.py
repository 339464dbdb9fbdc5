"""An in-process transport, for services that share a process and for tests."""

import threading
from collections.abc import Callable, Iterator

from udrl_proto.transport import EncodedReply, Presence, Query


class Exchange:
    """Connects the transports of one process."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.queryables: dict[str, Callable[[Query], None]] = {}
        self.subscribed: list[tuple[str, Callable[[bytes], None]]] = []
        self.watching: list[tuple[str, Callable[[Presence], None]]] = []
        self.here: list[str] = []

    def notify(self, presence: Presence) -> None:
        """Notify the watchers that a service appeared or disappeared."""
        with self.lock:
            watchers = [r for pattern, r in self.watching if _matches(pattern, presence.key)]
        for receive in watchers:
            receive(presence)


class MemoryTransport:
    """One service's transport over an :class:`Exchange`. Callbacks run on the sender's thread.

    Args:
        exchange: shared by all services of the process.
    """

    def __init__(self, exchange: Exchange) -> None:
        self._exchange = exchange

    def query(self, key: str, data: bytes, timeout_s: float) -> Iterator[EncodedReply]:
        """Yield the reply to a query, if there is one in time."""
        receive = self._exchange.queryables.get(key)
        if receive is None:
            return
        query = _MemoryQuery(data)
        receive(query)
        query.completed.wait(timeout_s)
        if query.sent is not None:
            yield query.sent

    def declare_queryable(self, key: str, receive: Callable[[Query], None]) -> "_Declared":
        """Call ``receive`` for each query on a key."""
        self._exchange.queryables[key] = receive
        return _Declared(lambda: self._exchange.queryables.pop(key))

    def publish(self, key: str, data: bytes) -> None:
        """Send to all subscribers."""
        with self._exchange.lock:
            subscribers = [receive for held, receive in self._exchange.subscribed if held == key]
        for receive in subscribers:
            receive(data)

    def subscribe(self, key: str, receive: Callable[[bytes], None]) -> "_Declared":
        """Call ``receive`` for each publication on a key."""
        subscribed, entry = self._exchange.subscribed, (key, receive)
        with self._exchange.lock:
            subscribed.append(entry)
        return _Declared(lambda: subscribed.remove(entry))

    def declare_presence(self, key: str) -> "_Declared":
        """Announce a service."""
        with self._exchange.lock:
            self._exchange.here.append(key)
        self._exchange.notify(Presence(key, here=True))

        def vanish() -> None:
            self._exchange.here.remove(key)
            self._exchange.notify(Presence(key, here=False))

        return _Declared(vanish)

    def present(self, key: str, timeout_s: float) -> list[str]:
        """Return the keys of the services that are present."""
        with self._exchange.lock:
            return [held for held in self._exchange.here if _matches(key, held)]

    def watch(self, key: str, receive: Callable[[Presence], None]) -> "_Declared":
        """Call ``receive`` for each service that is present, appears or disappears."""
        watching, entry = self._exchange.watching, (key, receive)
        with self._exchange.lock:
            watching.append(entry)
            here = [held for held in self._exchange.here if _matches(key, held)]
        for held in here:
            receive(Presence(held, here=True))
        return _Declared(lambda: watching.remove(entry))


class _Declared:
    """A declaration that a function withdraws."""

    def __init__(self, undeclare: Callable[[], object]) -> None:
        self._undeclare = undeclare

    def undeclare(self) -> None:
        self._undeclare()


class _MemoryQuery:
    def __init__(self, data: bytes) -> None:
        self._data = data
        self.sent: EncodedReply | None = None
        self.completed = threading.Event()

    @property
    def data(self) -> bytes:
        return self._data

    def reply(self, reply: EncodedReply) -> None:
        self.sent = reply
        self.completed.set()

    def drop(self) -> None:
        self.completed.set()


def _matches(pattern: str, key: str) -> bool:
    """Return whether a pattern matches a key: ``*`` is any part, ``$*`` the end of a part."""
    wanted, found = pattern.split("/"), key.split("/")
    return len(wanted) == len(found) and all(
        w == "*" or w == f or (w.endswith("$*") and f.startswith(w[:-2]))
        for w, f in zip(wanted, found, strict=True)
    )
