"""The previous action and reward as part of the observation (``observe_previous``)."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from udrl.environments.adapter import checked_reward
from udrl.environments.masking import OBSERVATION

#: Keys of the added entries; training hides them together, from random examples.
ACTION, REWARD, HAS_PREVIOUS = PREVIOUS = ("previous_action", "previous_reward", "has_previous")


class ObservePrevious(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Adds the previous action and reward to the observation, in a ``Dict``.

    At an episode's first observation, the reward is 0, the action is :func:`null_action`, and
    ``has_previous`` is 0. Afterwards it is 1.

    Args:
        env: any environment.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        self.observation_space = space_with_previous(env.observation_space, env.action_space)
        self._null = null_action(env.action_space)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        return _with_previous(observation, self._null, 0.0, has_previous=False), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        earned = checked_reward(reward)
        shown = _with_previous(observation, action, earned, has_previous=True)
        return shown, reward, terminated, truncated, info


def space_with_previous(
    observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
) -> spaces.Dict:
    """Return the space of observations with the previous action and reward.

    Args:
        observation_space: space of the environment's observations.
        action_space: space of its actions.
    """
    return spaces.Dict(
        [
            (OBSERVATION, observation_space),
            (ACTION, action_space),
            (REWARD, spaces.Box(-np.inf, np.inf, (), np.float32)),
            (HAS_PREVIOUS, spaces.MultiBinary(1)),
        ]
    )


def null_action(space: spaces.Space[Any]) -> Any:
    """Return the action that represents a missing one: the first, or zeros."""
    match space:
        case spaces.Discrete(start=start):
            return start
        case spaces.MultiDiscrete(start=start):
            return np.array(start)
        case spaces.Dict():
            return {key: null_action(inner) for key, inner in space.spaces.items()}
        case spaces.Tuple():
            return tuple(map(null_action, space.spaces))
    return np.zeros(space.shape or (), space.dtype)


def _with_previous(
    observation: Any, action: Any, reward: float, *, has_previous: bool
) -> dict[str, Any]:
    return {
        OBSERVATION: observation,
        ACTION: action,
        REWARD: np.array(reward, np.float32),
        HAS_PREVIOUS: np.array([has_previous], np.int8),
    }


def add_previous(
    space: spaces.Space[Any], observations: Any, actions: Any, rewards: npt.ArrayLike
) -> dict[str, Any]:
    """Return an episode's observations as the wrapper would have returned them.

    Args:
        space: space of the actions.
        observations: arrays with one element more than ``actions`` has
            (:meth:`.conversions.Conversion.convert`).
        actions: arrays of the environment's actions.
        rewards: one for each action.
    """
    earned = np.asarray(rewards, np.float32)
    has_previous = np.ones((len(earned) + 1, 1), np.int8)
    has_previous[0] = 0
    return {
        OBSERVATION: observations,
        ACTION: _prepend(null_action(space), actions),
        REWARD: np.concatenate([np.zeros(1, np.float32), earned]),
        HAS_PREVIOUS: has_previous,
    }


def _prepend(first: Any, rest: Any) -> Any:
    """Return arrays with one element inserted at the beginning."""
    if isinstance(first, Mapping):
        return {key: _prepend(value, rest[key]) for key, value in first.items()}
    if isinstance(first, tuple):
        return tuple(_prepend(value, rest[k]) for k, value in enumerate(first))
    return np.concatenate([np.asarray(first)[None], np.asarray(rest)])
