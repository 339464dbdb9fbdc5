"""A bounded queue of queries for the thread that replies to them; bulk comes last."""

import threading
from collections import deque
from typing import Generic, TypeVar

Item = TypeVar("Item")


class Inbox(Generic[Item]):
    """Two queues of bounded length and size: one for bulk, one for all other items.

    Bulk has the lower priority and its own bounds. Otherwise a request for commands or the status
    would time out behind a long queue of episodes, and its retry would join the end of the queue.

    Args:
        max_items: most items in each queue.
        max_bytes: most bytes in each queue; a single item may be larger.
    """

    def __init__(self, max_items: int, max_bytes: int) -> None:
        self._changed = threading.Condition()
        self._urgent: _Lane[Item] = _Lane(max_items, max_bytes)
        self._bulk: _Lane[Item] = _Lane(max_items, max_bytes)

    def has_room(self, size: int, *, bulk: bool = False) -> bool:
        """Return whether :meth:`put` would accept an item of ``size`` bytes now."""
        return (self._bulk if bulk else self._urgent).has_room(size)

    def put(self, item: Item, size: int, *, bulk: bool = False) -> bool:
        """Add an item of ``size`` bytes; return False if there is no room."""
        with self._changed:
            if not self.has_room(size, bulk=bulk):
                return False
            (self._bulk if bulk else self._urgent).append(item, size)
            self._changed.notify()
            return True

    def must_put(self, item: Item) -> None:
        """Add an item that would not be sent again, even if the queue is full."""
        with self._changed:
            self._urgent.append(item, 0)
            self._changed.notify()

    def take(self, max_items: int, max_bytes: int, timeout_s: float) -> list[Item]:
        """Remove and return items: at most ``max_items``, and none after ``max_bytes``.

        If there are none, waits up to ``timeout_s`` seconds for the first.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._urgent.waiting or self._bulk.waiting, timeout_s)
            taken: list[Item] = []
            total = 0
            for lane in (self._urgent, self._bulk):
                while lane.waiting and len(taken) < max_items and total < max_bytes:
                    item, size = lane.pop()
                    taken.append(item)
                    total += size
            return taken


class _Lane(Generic[Item]):
    """A queue of bounded length and size."""

    def __init__(self, max_items: int, max_bytes: int) -> None:
        self._max_items = max_items
        self._max_bytes = max_bytes
        self._bytes = 0
        self.waiting: deque[tuple[Item, int]] = deque()

    def has_room(self, size: int) -> bool:
        fits = self._bytes + size <= self._max_bytes or not self._bytes
        return len(self.waiting) < self._max_items and fits

    def append(self, item: Item, size: int) -> None:
        self.waiting.append((item, size))
        self._bytes += size

    def pop(self) -> tuple[Item, int]:
        item, size = self.waiting.popleft()
        self._bytes -= size
        return item, size
