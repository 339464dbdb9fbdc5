"""Section 2.3.1: the replay buffer keeps the episodes with the highest returns.

Two settings are not in the paper. ``max_age`` keeps the best episodes of the last iterations only:
the best of all time are mostly lucky, and the agent would memorise them. ``recent_size`` also keeps
the newest episodes, regardless of their return, so that the agent trains on its present behavior.
"""

import bisect
import heapq
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from udrl.config import COMMANDS_PER_ITERATION
from udrl.setting_groups import BufferSettings


class Entry(NamedTuple):
    """One episode of the buffer. Entries compare by return; among equal ones, newer is greater."""

    episode_return: float
    id: int
    length: int

    @property
    def iteration(self) -> int:
        """The iteration of the episode."""
        return self.id // COMMANDS_PER_ITERATION


class ReplayBuffer:
    """The best and the newest of all admitted entries, in increasing order.

    It ranks episodes; it does not hold their steps (see :class:`udrl.experience.Experience`).

    Args:
        settings: ``replay_size``, number of best entries; ``recent_size``, number of newest
            entries, which may be among the best; ``max_age``, maximum age in iterations.
        entries: initial content.
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
        """Add entries and return the evicted ones, lowest first; new entries may be among them."""
        for entry in entries:
            bisect.insort(self._entries, entry)
        before, self._entries = self._entries, self._kept(self._entries)
        kept = set(self._entries)
        return [entry for entry in before if entry not in kept]

    def _kept(self, entries: list[Entry]) -> list[Entry]:
        """Return the entries that remain: young enough, and among the best or the newest."""
        if self._max_age is not None and entries:
            oldest = max(entry.iteration for entry in entries) - self._max_age
            entries = [entry for entry in entries if entry.iteration > oldest]
        surplus = max(0, len(entries) - self._capacity)
        newest = set(heapq.nlargest(self._recent, (entry.id for entry in entries)))
        return [entry for entry in entries[:surplus] if entry.id in newest] + entries[surplus:]

    def newest(self) -> Sequence[Entry]:
        """Return the entries of the newest iteration in the buffer."""
        newest = max((entry.iteration for entry in self._entries), default=0)
        return [entry for entry in self._entries if entry.iteration == newest]

    def best(self, n: int) -> Sequence[Entry]:
        """Return the best ``n`` entries, or all if there are fewer, lowest first."""
        return self._entries[-n:]
