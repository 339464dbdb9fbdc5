"""The time left as part of the observation (``observe_time``)."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from udrl.environments.masking import OBSERVATION

TIME_LEFT = "time_left"


class ObserveTime(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Adds the time left to the observation, in a ``Dict``.

    It is 1 at an episode's first observation and counts down to 0 at the step limit.

    Args:
        env: any environment.
        max_steps: its step limit.
    """

    def __init__(self, env: gym.Env[Any, Any], max_steps: int) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, max_steps=max_steps)
        gym.Wrapper.__init__(self, env)
        self._max_steps = max_steps
        self._step = 0
        self.observation_space = space_with_time_left(env.observation_space)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._step = 0
        return self._with_time(observation), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._step += 1
        return self._with_time(observation), reward, terminated, truncated, info

    def _with_time(self, observation: Any) -> dict[str, Any]:
        left = 1 - self._step / self._max_steps
        return {OBSERVATION: observation, TIME_LEFT: np.array([left], np.float32)}


def space_with_time_left(observation_space: spaces.Space[Any]) -> spaces.Dict:
    """Return the space of observations with the time left."""
    return spaces.Dict(
        [(OBSERVATION, observation_space), (TIME_LEFT, spaces.Box(0, 1, (1,), np.float32))]
    )


def add_time_left(observations: Any, n: int, max_steps: int) -> dict[str, Any]:
    """Return an episode's ``n`` observations as the wrapper would have returned them."""
    left = np.array([[1 - step / max_steps] for step in range(n)], np.float32)
    return {OBSERVATION: observations, TIME_LEFT: left}
