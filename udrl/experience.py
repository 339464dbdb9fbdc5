"""The steps of the replay buffer's episodes, from which the examples of segments are gathered."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from udrl.actions import Actions
from udrl.config import Config
from udrl.environments.specification import EnvironmentSpec
from udrl.episode import Episode
from udrl.errors import ConfigError
from udrl.frame_stack import FrameStack, Seen
from udrl.segments import IndexArray, Segments
from udrl.spaces import leaves_of
from udrl.targets import Desired, ReturnInTime

#: Steps per page.
_PAGE = 64
#: More than the steps of any episode.
_NEVER = 2**62
#: Minimum number of pages to allocate at once.
_MIN_PAGES = 256

Array = npt.NDArray[Any]


class Examples(NamedTuple):
    """Inputs and targets of the behavior function, one per row.

    Attributes:
        seen: s_t1, as the networks see it (:mod:`udrl.frame_stack`), [n, *shape] for each leaf.
        command: desired return, which is the segment's return or its label
            (:meth:`RankedExperience.label`), and desired horizon in steps, float64 [n, 2].
        action: a_t1, n elements of the action space.
    """

    seen: Seen
    command: Desired
    action: Actions


@dataclass(frozen=True)
class _Place:
    """Where an episode is held: its row in the tables of episodes, and its pages of steps."""

    slot: int
    pages: IndexArray


class Experience:
    """The steps of the buffer's episodes in flat arrays, from which examples are gathered.

    Steps are stored in pages of 64, which are allocated and freed with their episodes, so that
    other episodes need not be copied. The arrays grow as needed, at least doubling, because step
    limits are often much longer than episodes.
    """

    def __init__(self, config: Config, spec: EnvironmentSpec) -> None:
        # If the agent observes the time left, the limit is like a terminal state (Pardo et al.,
        # 2018).
        self._ends_at = spec.max_episode_steps if config.observe_time else _NEVER
        n_episodes = config.buffer.replay_size + config.buffer.recent_size
        observed, acted = spec.observation_space, spec.action_space
        self._leaves = leaves_of(observed)
        self._stack = FrameStack(observed, config.network.frame_stack)
        self._observations = np.empty((0, *observed.shape), observed.dtype)
        self._actions = np.empty((0, *acted.shape), acted.dtype)
        self._earned = np.empty(0)  # P[t]: rewards earned before step t
        self._page_table = np.zeros((n_episodes, 1), np.int64)
        self._lengths = np.zeros(n_episodes, np.int64)
        self._returns = np.zeros(n_episodes)
        self._terminated = np.zeros(n_episodes, np.bool_)
        self._free_slots = list(range(n_episodes))[::-1]
        self._free_pages: list[int] = []
        self._places: dict[int, _Place] = {}

    def __contains__(self, episode_id: int) -> bool:
        return episode_id in self._places

    def ids(self) -> set[int]:
        """Return the ids of the episodes held."""
        return set(self._places)

    def add(self, episode: Episode) -> None:
        """Add an episode; evicted episodes must be removed before.

        Raises:
            ConfigError: there is not enough memory.
        """
        slot = self._free_slots.pop()
        count = -(-episode.length // _PAGE)
        self._make_room(count)
        pages = np.array([self._free_pages.pop() for _ in range(count)], np.int64)
        rows = (pages[:, None] * _PAGE + np.arange(_PAGE)).reshape(-1)[: episode.length]
        self._observations[rows] = episode.observations
        self._actions[rows] = episode.actions
        self._earned[rows] = episode.cumulative_rewards[:-1]
        self._page_table[slot, :count] = pages
        self._lengths[slot] = episode.length
        self._returns[slot] = episode.episode_return
        self._terminated[slot] = episode.terminated
        self._places[episode.command_id] = _Place(slot, pages)

    def _make_room(self, count: int) -> None:
        """Make room for an episode of ``count`` pages."""
        width = self._page_table.shape[1]
        if count > width:
            wider = max(count, 2 * width) - width
            self._page_table = np.pad(self._page_table, ((0, 0), (0, wider)))
        pages = len(self._earned) // _PAGE
        if count > len(self._free_pages):
            more = max(count - len(self._free_pages), pages, _MIN_PAGES)
            try:
                self._observations = _longer(self._observations, more * _PAGE)
                self._actions = _longer(self._actions, more * _PAGE)
                self._earned = _longer(self._earned, more * _PAGE)
            except MemoryError as error:
                raise ConfigError(
                    f"the learner cannot allocate memory for {(pages + more) * _PAGE:,} steps; "
                    f"lower replay_size, recent_size or max_train_steps"
                ) from error
            self._free_pages[:0] = range(pages, pages + more)[::-1]

    def remove(self, episode_id: int) -> None:
        """Remove an episode."""
        place = self._places.pop(episode_id)
        self._free_slots.append(place.slot)
        self._free_pages.extend(place.pages.tolist())

    def by_rank(self, ids: list[int]) -> "RankedExperience":
        """Return a view in which episodes have the order of ``ids``, by rank in the buffer."""
        slots = np.array([self._places[i].slot for i in ids], np.int64)
        return RankedExperience(self, slots)


def _longer(array: Array, more: int) -> Array:
    """Return a copy of an array with ``more`` uninitialised rows appended."""
    longer = np.empty((len(array) + more, *array.shape[1:]), array.dtype)
    longer[: len(array)] = array
    return longer


class RankedExperience:
    """The episodes of an :class:`Experience` in the order of the buffer, lowest return first.

    Attributes:
        lengths: lengths of the episodes by rank, int64 [episodes].
        labels: desired return of each step's trailing segment, in the order of :meth:`steps`,
            float64 [steps]; None: the obtained return.
        expected: (V, D) at every step, in the same order, scaled, float32 [steps, 2]
            (:mod:`udrl.value`); None: unknown.
        shapes: shape of the networks' input for each leaf.
        leaves: leaves of the observation space.
        action_shape: shape of an action.
    """

    def __init__(self, experience: Experience, slots: IndexArray) -> None:
        self._experience = experience
        self._slots = slots
        self.labels: npt.NDArray[np.float64] | None = None
        self.expected: npt.NDArray[np.float32] | None = None
        self.shapes = experience._stack.shapes
        self.leaves = experience._leaves
        self.action_shape = experience._actions.shape[1:]
        self.lengths: IndexArray = experience._lengths[slots]
        self._first_step: IndexArray = np.cumsum(self.lengths) - self.lengths

    def examples(self, segments: Segments) -> Examples:
        """Gather the examples of segments."""
        held = self._experience
        slot = self._slots[segments.rank]
        row = self._row(slot, segments.t1)
        if self.labels is not None:
            desired_return = self.labels[self._step(segments)]
        else:
            earned_at_t2 = held._returns[slot]
            inner = np.flatnonzero(segments.t2 < held._lengths[slot])
            if len(inner):
                earned_at_t2[inner] = held._earned[self._row(slot[inner], segments.t2[inner])]
            desired_return = earned_at_t2 - held._earned[row]
        command = np.empty((len(row), ReturnInTime.size))
        command[:, 0], command[:, 1] = desired_return, segments.t2 - segments.t1
        return Examples(self._observed(slot, segments.t1), command, held._actions[row])

    def expected_at(self, segments: Segments) -> npt.NDArray[np.float32] | None:
        """Return (V, D) of s_t1, float32 [n, 2]; None if unknown."""
        return None if self.expected is None else self.expected[self._step(segments)]

    def _step(self, segments: Segments) -> IndexArray:
        """Return the index of each t1 in the order of :meth:`steps`."""
        steps: IndexArray = self._first_step[segments.rank] + segments.t1
        return steps

    def steps(self, at_once: int = 4096) -> Iterator[tuple[Seen, Array]]:
        """Yield observations, as the networks see them, and actions of all steps, by episode."""
        slot, t = self._all_steps()
        actions = self._experience._actions
        for first in range(0, len(t), at_once):
            part = slice(first, first + at_once)
            yield self._observed(slot[part], t[part]), actions[self._row(slot[part], t[part])]

    def label(self, expected: npt.NDArray[np.floating[Any]], lam: float) -> None:
        """Label all trailing segments with lambda-returns as their desired returns.

        G_t = r_t + (1 - lambda) V(s_t+1) + lambda G_t+1. V is 0 after a terminal state. After a
        truncation it is V of the last stored observation, because the next one is not stored. At
        the environment's own limit it is 0 if the time left is observed.

        Args:
            expected: V at every step, not scaled, in the order of :meth:`steps`, [steps].
            lam: lambda, in [0, 1].
        """
        held, slots, first = self._experience, self._slots, self._first_step
        last = first + self.lengths - 1
        earned = held._earned[self._row(*self._all_steps())]
        continues = ~held._terminated[slots] & (self.lengths < held._ends_at)
        beyond = np.where(continues, expected[last], 0.0)
        # Values after each step: rewards earned so far, V, and at the end the label.
        earned_next, expected_next = np.roll(earned, -1), np.roll(expected, -1)
        earned_next[last], expected_next[last] = held._returns[slots], beyond
        labels = earned_next - earned + (1 - lam) * expected_next
        labels[last] += lam * beyond
        longest_first = np.argsort(-self.lengths, kind="stable")
        first, lengths = first[longest_first], self.lengths[longest_first]
        for t in reversed(range(int(lengths[0]) - 1)):
            step = first[: np.searchsorted(-lengths, -(t + 1), side="left")] + t
            labels[step] += lam * labels[step + 1]
        self.labels = labels

    def _all_steps(self) -> tuple[IndexArray, IndexArray]:
        """Return slot and time of every step, episode by episode."""
        rank = np.repeat(np.arange(len(self.lengths)), self.lengths)
        return self._slots[rank], np.arange(len(rank)) - self._first_step[rank]

    def _observed(self, slot: IndexArray, t: IndexArray) -> Seen:
        """Return what the network sees at times t: single observations, or stacks of them."""
        held = self._experience
        stack = held._stack
        if stack.length == 1:
            return stack.join(held._observations[self._row(slot, t)])
        return stack.join(held._observations[self._row(slot[:, None], stack.times(t))])

    def _row(self, slot: IndexArray, t: IndexArray) -> IndexArray:
        """Return the index of steps in the flat arrays, given their episodes' slots and times."""
        page = self._experience._page_table[slot, t // _PAGE]
        rows: IndexArray = page * _PAGE + t % _PAGE
        return rows
