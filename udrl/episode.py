"""Episodes, and the one function that computes all sums of rewards."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from udrl.actions import Actions
from udrl.environments.specification import EnvironmentSpec
from udrl.spaces import Observations, parts_of

Rewards = npt.NDArray[np.float32]


def cumulative(rewards: Rewards) -> npt.NDArray[np.float64]:
    """Return P, float64 of length T+1, with P[t] = r_0 + ... + r_{t-1}, summed in that order."""
    sums = np.zeros(len(rewards) + 1)
    # add.accumulate is sequential, unlike numpy's pairwise sum, so the rounding is always the same.
    np.add.accumulate(rewards, dtype=np.float64, out=sums[1:])
    return sums


@dataclass(frozen=True, eq=False)
class Episode:
    """A trajectory of T steps (section 2.1), a pure function of its command.

    Attributes:
        command_id: id of the command, and of the episode.
        observations: s_t, T elements of the observation space, not stacked
            (:mod:`udrl.frame_stack`).
        actions: a_t, T elements of the action space.
        rewards: r_t, float32 [T], rounded once, at the environment.
        terminated: whether the environment reached a terminal state.
        truncated: whether a step limit ended the episode.
    """

    command_id: int
    observations: Observations
    actions: Actions
    rewards: Rewards
    terminated: bool
    truncated: bool

    @property
    def length(self) -> int:
        """Number of steps, T."""
        return len(self.rewards)

    @cached_property
    def cumulative_rewards(self) -> npt.NDArray[np.float64]:
        """:func:`cumulative` of the rewards."""
        return cumulative(self.rewards)

    @property
    def episode_return(self) -> float:
        """The sum of all rewards."""
        return float(self.cumulative_rewards[-1])


def fault(episode: Episode, spec: EnvironmentSpec) -> str | None:
    """Return why an episode is invalid for an environment; None: it is valid."""
    rewards, n = episode.rewards, len(episode.rewards) if episode.rewards.ndim == 1 else -1
    if rewards.dtype != np.float32 or not 1 <= n <= spec.max_episode_steps:
        return (
            f"rewards are {rewards.dtype} {rewards.shape}, expected float32, one dimension of 1 to "
            f"{spec.max_episode_steps} steps"
        )
    if not np.isfinite(rewards).all():
        return "rewards are not all finite numbers"
    if found := spec.observation_space.fault(episode.observations, n):
        return f"observations are {found}"
    if found := spec.action_space.fault(episode.actions, n):
        return f"actions are {found}"
    if spec.action_mask is not None:
        mask = parts_of(episode.observations)[spec.action_mask]
        if not spec.action_space.allowed(mask, episode.actions).all():
            return "an action was taken that action_mask does not allow"
    if not (episode.terminated or episode.truncated):
        return "it neither terminated nor was truncated"
    return None
