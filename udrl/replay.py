"""Section 2.3.1: the replay buffer keeps the episodes with the highest returns.

On request it keeps the newest ones too, whatever they returned. Elites alone are all good, so a
behavior function cannot learn from them what distinguishes a good return from a bad one, and
imitates them instead of obeying; what the agent did last is the contrast that it needs.
"""

import bisect
import heapq
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple


class Entry(NamedTuple):
    """One episode of the buffer. Entries compare by return; of equal ones the newer is greater."""

    episode_return: float
    id: int
    length: int


class ReplayBuffer:
    """The greatest of all entries that were ever admitted, and the newest, in increasing order.

    It ranks episodes; who needs their steps keeps them (:class:`udrl.segments.Experience`).

    Args:
        capacity: how many of the greatest it keeps.
        entries: what it holds at first.
        recent: how many of the newest it keeps, those among the greatest counted; 0 is the paper's.
    """

    def __init__(self, capacity: int, entries: Iterable[Entry] = (), *, recent: int = 0) -> None:
        self.capacity = capacity
        self.recent = recent
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
        lesser, greatest = self._entries[:surplus], self._entries[surplus:]
        newest = set(heapq.nlargest(self.recent, (entry.id for entry in self._entries)))
        self._entries = [entry for entry in lesser if entry.id in newest] + greatest
        return [entry for entry in lesser if entry.id not in newest]

    def best(self, n: int) -> Sequence[Entry]:
        """Return the last ``n`` entries, or all when there are fewer."""
        return self._entries[-n:]
