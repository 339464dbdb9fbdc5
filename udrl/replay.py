"""Section 2.3.1: the replay buffer keeps the episodes with the highest returns.

Two settings that are not in the paper change what "all episodes" are. With an age limit the best of
the last iterations are kept: elites of all times are lucky ones in the end, imitated long after the
agent could have replaced them, and learned by heart. And the newest can be kept whatever they
returned, which holds the agent near what it does.
"""

import bisect
import heapq
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from udrl.config import COMMANDS_PER_ITERATION
from udrl.setting_groups import BufferSettings


class Entry(NamedTuple):
    """One episode of the buffer. Entries compare by return; of equal ones the newer is greater."""

    episode_return: float
    id: int
    length: int

    @property
    def iteration(self) -> int:
        """The iteration that the episode was made in."""
        return self.id // COMMANDS_PER_ITERATION


class ReplayBuffer:
    """The greatest of all entries that were admitted, and the newest, in increasing order.

    It ranks episodes; who needs their steps keeps them (:class:`udrl.segments.Experience`).

    Args:
        settings: ``replay_size``, how many of the greatest it keeps; ``recent_size``, how many of
            the newest, those among the greatest counted; ``max_age``, for how many iterations.
        entries: what it holds at first.
    """

    def __init__(self, settings: BufferSettings, entries: Iterable[Entry] = ()) -> None:
        self._capacity = settings.replay_size
        self._recent = settings.recent_size
        self._max_age = settings.max_age
        self._entries = sorted(entries)

    def __len__(self) -> int:
        return len(self._entries)

    def __iter__(self) -> Iterator[Entry]:
        return iter(self._entries)

    def admit(self, entries: Iterable[Entry]) -> list[Entry]:
        """Add entries and return those that had to leave, least first; some may be new ones."""
        for entry in entries:
            bisect.insort(self._entries, entry)
        before, self._entries = self._entries, self._kept(self._entries)
        kept = set(self._entries)
        return [entry for entry in before if entry not in kept]

    def _kept(self, entries: list[Entry]) -> list[Entry]:
        if self._max_age is not None and entries:
            oldest = max(entry.iteration for entry in entries) - self._max_age
            entries = [entry for entry in entries if entry.iteration > oldest]
        surplus = max(0, len(entries) - self._capacity)
        newest = set(heapq.nlargest(self._recent, (entry.id for entry in entries)))
        return [entry for entry in entries[:surplus] if entry.id in newest] + entries[surplus:]

    def newest(self) -> Sequence[Entry]:
        """Return the entries of the newest iteration of which it holds any."""
        newest = max((entry.iteration for entry in self._entries), default=0)
        return [entry for entry in self._entries if entry.iteration == newest]

    def best(self, n: int) -> Sequence[Entry]:
        """Return the last ``n`` entries, or all when there are fewer."""
        return self._entries[-n:]
