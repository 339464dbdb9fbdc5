"""Where questions wait for the thread that answers them: within bounds, the short ones first."""

import threading
from collections import deque
from typing import Generic, TypeVar

Item = TypeVar("Item")


class Inbox(Generic[Item]):
    """Two queues, of bulk and of all else, each of bounded length and size.

    Bulk waits for all else, and takes none of its room: in a long queue of episodes, whoever asks
    for commands or the status would give up before its turn, ask again, and wait behind them anew.

    Args:
        max_items: how many may wait in each.
        max_bytes: how many bytes these may have together; a single one may have more.
    """

    def __init__(self, max_items: int, max_bytes: int) -> None:
        self._changed = threading.Condition()
        self._urgent: _Lane[Item] = _Lane(max_items, max_bytes)
        self._bulk: _Lane[Item] = _Lane(max_items, max_bytes)

    def has_room(self, size: int, *, bulk: bool = False) -> bool:
        """Say whether :meth:`put` would accept so many bytes now."""
        return (self._bulk if bulk else self._urgent).has_room(size)

    def put(self, item: Item, size: int, *, bulk: bool = False) -> bool:
        """Let an item of so many bytes wait; False: there is no room."""
        with self._changed:
            if not self.has_room(size, bulk=bulk):
                return False
            (self._bulk if bulk else self._urgent).append(item, size)
            self._changed.notify()
            return True

    def must_put(self, item: Item) -> None:
        """Let an item wait that nobody would send again, whether there is room or not."""
        with self._changed:
            self._urgent.append(item, 0)
            self._changed.notify()

    def take(self, max_items: int, max_bytes: int, timeout_s: float) -> list[Item]:
        """Return what waits: at most so many, and no more after so many bytes.

        Waits for the first, ``timeout_s`` seconds at most.
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
