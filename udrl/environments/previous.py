"""The previous action and reward as a part of what is observed (``observe_previous``)."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from udrl.environments.masking import OBSERVATION

#: Keys of what is observed besides; in training they are hidden together, at random.
ACTION, REWARD, IS_THERE = PREVIOUS = ("previous_action", "previous_reward", "has_previous")


class ObservePrevious(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Shows the environment's observation in a ``Dict``, with the action and reward before it.

    At an episode's first step, where there are none, they are zeros, and ``has_previous`` is 0. It
    is 1 at all others.

    Args:
        env: any environment.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        self.observation_space = observation_space(env.observation_space, env.action_space)
        self._none = nothing(env.action_space)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        return _shown(observation, self._none, 0.0, there=False), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return _shown(observation, action, reward, there=True), reward, terminated, truncated, info


def observation_space(seen: spaces.Space[Any], done: spaces.Space[Any]) -> spaces.Dict:
    """Return the space of observations with what was before them.

    Args:
        seen: the environment's observations.
        done: its actions.
    """
    return spaces.Dict(
        [
            (OBSERVATION, seen),
            (ACTION, done),
            (REWARD, spaces.Box(-np.inf, np.inf, (), np.float32)),
            (IS_THERE, spaces.MultiBinary(1)),
        ]
    )


def nothing(space: spaces.Space[Any]) -> Any:
    """Return the element of a space that stands for none: the first, or zeros."""
    match space:
        case spaces.Discrete(start=start):
            return start
        case spaces.MultiDiscrete(start=start):
            return np.array(start)
        case spaces.Dict():
            return {key: nothing(inner) for key, inner in space.spaces.items()}
        case spaces.Tuple():
            return tuple(map(nothing, space.spaces))
    return np.zeros(space.shape or (), space.dtype)


def _shown(observation: Any, action: Any, reward: Any, *, there: bool) -> dict[str, Any]:
    return {
        OBSERVATION: observation,
        ACTION: action,
        REWARD: np.asarray(reward, np.float32).reshape(()),
        IS_THERE: np.array([there], np.int8),
    }


def shown_in_all_steps(
    space: spaces.Space[Any], observations: Any, actions: Any, rewards: npt.ArrayLike
) -> dict[str, Any]:
    """Return an episode's observations as the wrapper would have shown them.

    Args:
        space: of the actions.
        observations: one more than actions, in arrays (:meth:`.conversions.Conversion.convert`).
        actions: likewise.
        rewards: one for each action.
    """
    earned = np.asarray(rewards, np.float32)
    there = np.ones((len(earned) + 1, 1), np.int8)
    there[0] = 0
    return {
        OBSERVATION: observations,
        ACTION: _after(nothing(space), actions),
        REWARD: np.concatenate([np.zeros(1, np.float32), earned]),
        IS_THERE: there,
    }


def _after(first: Any, others: Any) -> Any:
    """Return arrays with one element before all others."""
    if isinstance(first, Mapping):
        return {key: _after(value, others[key]) for key, value in first.items()}
    if isinstance(first, tuple):
        return tuple(_after(value, others[k]) for k, value in enumerate(first))
    return np.concatenate([np.asarray(first)[None], np.asarray(others)])
