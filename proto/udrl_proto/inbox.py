"""Where questions wait for the thread that answers them: within bounds, the short ones first."""

import threading
import time
from collections import deque
from typing import Generic, TypeVar

Item = TypeVar("Item")


class Inbox(Generic[Item]):
    """A queue of bounded length and size.

    Bulk waits for all else: in a long queue of episodes, whoever asks for commands or the status
    would give up before its turn, ask again, and wait behind them anew.

    Args:
        max_items: how many may wait.
        max_bytes: how many bytes they may have together; a single one may have more.
    """

    def __init__(self, max_items: int, max_bytes: int) -> None:
        self._max_items = max_items
        self._max_bytes = max_bytes
        self._changed = threading.Condition()
        self._urgent: deque[tuple[Item, int]] = deque()
        self._bulk: deque[tuple[Item, int]] = deque()
        self._bytes = 0

    def has_room(self, size: int) -> bool:
        """Say whether :meth:`put` would accept so many bytes now."""
        waiting = len(self._urgent) + len(self._bulk)
        fits = self._bytes + size <= self._max_bytes or not self._bytes
        return waiting < self._max_items and fits

    def put(self, item: Item, size: int, *, bulk: bool = False) -> bool:
        """Let an item of so many bytes wait; False: there is no room."""
        with self._changed:
            if not self.has_room(size):
                return False
            self._append(self._bulk if bulk else self._urgent, item, size)
            return True

    def must_put(self, item: Item) -> None:
        """Let an item wait that nobody would send again, whether there is room or not."""
        with self._changed:
            self._append(self._urgent, item, 0)

    def _append(self, waiting: "deque[tuple[Item, int]]", item: Item, size: int) -> None:
        waiting.append((item, size))
        self._bytes += size
        self._changed.notify()

    def take(self, max_items: int, max_bytes: int, timeout_s: float) -> list[Item]:
        """Return what waits: at most so many, and no more after so many bytes.

        Waits for the first, ``timeout_s`` seconds at most.
        """
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while not (self._urgent or self._bulk):
                left = deadline - time.monotonic()
                if left <= 0:
                    return []
                self._changed.wait(left)
            taken: list[Item] = []
            total = 0
            while (self._urgent or self._bulk) and len(taken) < max_items and total < max_bytes:
                item, size = (self._urgent or self._bulk).popleft()
                taken.append(item)
                total += size
            self._bytes -= total
            return taken
