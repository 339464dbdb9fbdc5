"""The steps of running episodes, in ring buffers that grow with the longest episode."""

import numpy as np
import numpy.typing as npt

from udrl.commands import Command, Decisions
from udrl.environments.specification import EnvironmentSpec
from udrl.episode import Episode
from udrl.frame_stack import FrameStack, Seen
from udrl.spaces import Observations

#: Rings whose content becomes part of an episode.
_KEPT = ("observations", "actions", "rewards")
#: Upper bounds of the initial capacity, in rounds and in bytes; it is at least 64 rounds.
_FIRST_CAPACITY, _FIRST_BYTES = 1024, 64 << 20


class Recording:
    """Ring buffers of rounds: a round is one step in all rows; round k is at k % capacity.

    Args:
        spec: specification of the environment.
        n: number of rows.

    Attributes:
        round: number of completed rounds.
        began: first round of each row's episode, int64 [n].
    """

    def __init__(self, spec: EnvironmentSpec, n: int) -> None:
        self.round = 0
        self.began = np.zeros(n, np.int64)
        self._longest = spec.max_episode_steps
        self._capacity = min(
            self._longest, _FIRST_CAPACITY, max(64, _FIRST_BYTES // (n * spec.step_bytes))
        )
        shape = (self._capacity, n)
        observed, acted = spec.observation_space, spec.action_space
        self._rings = {
            "observations": np.zeros((*shape, *observed.shape), observed.dtype),
            "actions": np.zeros((*shape, *acted.shape), acted.dtype),
            "rewards": np.zeros(shape, np.float32),
            "numbers": np.zeros((*shape, *acted.shape)),
            "random": np.zeros(shape, np.bool_),
        }
        self._commands: dict[int, Command] = {}

    def begin(self, row: int, command: Command) -> None:
        """Begin an episode in this round, and draw its random numbers."""
        self.began[row] = self.round
        self._commands[row] = command
        self._draw(row, command)

    def begin_round(self, observation: Observations) -> Decisions:
        """Store observations, [n, *observation_shape]; return the numbers that choose actions."""
        self._make_room()
        at = self.round % self._capacity
        self._rings["observations"][at] = observation
        return Decisions(self._rings["numbers"][at], self._rings["random"][at])

    def end_round(self, actions: npt.NDArray[np.integer], rewards: npt.NDArray[np.float32]) -> None:
        """Store actions and rewards, and advance to the next round."""
        at = self.round % self._capacity
        self._rings["actions"][at] = actions
        self._rings["rewards"][at] = rewards
        self.round += 1

    def stacks(self, stack: FrameStack) -> Seen:
        """Return the networks' input in this round, [n, *shape] for each leaf."""
        rounds = (self.began[:, None] + stack.times(self.round - self.began)) % self._capacity
        rows = np.arange(len(self.began))[:, None]
        return stack.join(self._rings["observations"][rounds, rows])

    def end(self, row: int, *, terminated: bool, truncated: bool) -> Episode:
        """Return a row's episode, which ended in the last completed round."""
        began = int(self.began[row])
        places = self._places(began, self.round - began)
        kept = {name: self._rings[name][places, row] for name in _KEPT}
        command = self._commands.pop(row)
        return Episode(command_id=command.id, terminated=terminated, truncated=truncated, **kept)

    def drop(self, row: int) -> None:
        """Discard a row's episode."""
        del self._commands[row]

    def _places(self, first: int, count: int) -> npt.NDArray[np.int64]:
        """Return the ring indices of ``count`` rounds, beginning with ``first``."""
        return np.arange(first, first + count) % self._capacity

    def _draw(self, row: int, command: Command) -> None:
        """Draw the random numbers of an episode's first ``capacity`` steps, at their places."""
        numbers, random = self._rings["numbers"], self._rings["random"]
        places = self._places(int(self.began[row]), self._capacity)
        numbers[places, row], random[places, row] = command.decisions(
            self._capacity, numbers.shape[2:]
        )

    def _make_room(self) -> None:
        """Double the capacity if an episode would overwrite its own first step."""
        first = self.round - self._capacity
        if self._capacity >= self._longest or first < 0:
            return
        if not any(self.began[row] == first for row in self._commands):
            return
        count = self._capacity
        old = self._places(first, count)
        self._capacity *= 2
        new = self._places(first, count)
        for name, ring in self._rings.items():
            longer = np.zeros((self._capacity, *ring.shape[1:]), ring.dtype)
            longer[new] = ring[old]
            self._rings[name] = longer
        for row, command in self._commands.items():
            self._draw(row, command)
