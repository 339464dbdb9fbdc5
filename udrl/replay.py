"""Section 2.3.1: the replay buffer keeps the episodes with the highest returns."""

import bisect
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple


class Entry(NamedTuple):
    """One episode of the buffer. Entries compare by return; of equal ones the newer is greater."""

    episode_return: float
    id: int
    length: int


class ReplayBuffer:
    """The ``capacity`` greatest entries of all that were ever admitted, in increasing order.

    It ranks episodes; who needs their steps keeps them (:class:`udrl.segments.Experience`).
    """

    def __init__(self, capacity: int, entries: Iterable[Entry] = ()) -> None:
        self.capacity = capacity
        self._entries = sorted(entries)

    def __len__(self) -> int:
        return len(self._entries)

    def __iter__(self) -> Iterator[Entry]:
        return iter(self._entries)

    def admit(self, entries: Iterable[Entry]) -> list[Entry]:
        """Add entries and return those that had to leave, least first; some may be new ones."""
        for entry in entries:
            bisect.insort(self._entries, entry)
        surplus = max(0, len(self._entries) - self.capacity)
        evicted, self._entries = self._entries[:surplus], self._entries[surplus:]
        return evicted

    def best(self, n: int) -> Sequence[Entry]:
        """Return the last ``n`` entries, or all when there are fewer."""
        return self._entries[-n:]
