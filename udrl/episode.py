"""What an episode is, and the one function that every sum of rewards goes through."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

Observations = npt.NDArray[np.float32] | npt.NDArray[np.uint8]
Actions = npt.NDArray[np.integer[Any]]
Rewards = npt.NDArray[np.float32]


def action_dtype(n_actions: int) -> type[np.uint8] | type[np.int32]:
    """Return the dtype that actions are kept in: the smaller of the two that holds them."""
    return np.uint8 if n_actions <= 256 else np.int32


def recent(t: npt.NDArray[np.int64], frame_stack: int) -> npt.NDArray[np.int64]:
    """Return the times of the observations that the network sees at times ``t``.

    Args:
        t: int64 [n].
        frame_stack: how many.

    Returns:
        int64 [n, frame_stack]: t - frame_stack + 1 to t; 0 for those before the episode, so that
        its first observation stands in for what was not observed.
    """
    times: npt.NDArray[np.int64] = np.maximum(t[:, None] - np.arange(frame_stack)[::-1], 0)
    return times


def cumulative(rewards: Rewards) -> npt.NDArray[np.float64]:
    """Return P, float64 of length T+1, with P[t] = r_0 + ... + r_{t-1}, summed in that order."""
    sums = np.zeros(len(rewards) + 1)
    # numpy's add.accumulate is sequential, unlike its pairwise sum: one order of rounding for all.
    np.add.accumulate(rewards, dtype=np.float64, out=sums[1:])
    return sums


@dataclass(frozen=True, eq=False)
class Episode:
    """A trajectory of T steps (section 2.1), a pure function of its command.

    Attributes:
        command_id: the id of the command that it answers, and its own.
        observations: what the environment showed at each step, [T, *observation_shape]: float32
            vectors or uint8 images. With ``frame_stack`` 1 they are the s_t; else s_t is built of
            them by :func:`recent`.
        actions: a_t, uint8 or int32 [T].
        rewards: r_t, float32 [T], rounded once, at the environment.
        terminated: the environment reached a terminal state.
        truncated: a time limit ended it.
    """

    command_id: int
    observations: Observations
    actions: Actions
    rewards: Rewards
    terminated: bool
    truncated: bool

    @property
    def length(self) -> int:
        """T."""
        return len(self.rewards)

    @cached_property
    def cumulative_rewards(self) -> npt.NDArray[np.float64]:
        """:func:`cumulative` of the rewards."""
        return cumulative(self.rewards)

    @property
    def episode_return(self) -> float:
        """The sum of all rewards."""
        return float(self.cumulative_rewards[-1])
