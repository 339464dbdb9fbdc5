"""An environment in which following the command is trivial.

Action 1 has reward 1, action 0 has reward 0, and the episode ends after a number of steps that the
observation counts down. To obtain a return r, choose action 1 exactly r times.
"""

from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt


class Obedience(gym.Env[npt.NDArray[np.float32], np.int64]):
    """The reward is the action.

    Args:
        steps: length of every episode.
    """

    metadata = {"render_modes": []}

    def __init__(self, steps: int = 8) -> None:
        self.observation_space = gym.spaces.Box(0.0, 1.0, (1,), np.float32)
        self.action_space = gym.spaces.Discrete(2)
        self.render_mode = None
        self.max_return = float(steps)
        self._steps = steps
        self._left = steps

    def _observe(self) -> npt.NDArray[np.float32]:
        return np.array([self._left / self._steps], np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        self._left = self._steps
        return self._observe(), {}

    def step(
        self, action: np.int64
    ) -> tuple[npt.NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Take a step; the reward is the action."""
        self._left -= 1
        return self._observe(), float(action), self._left <= 0, False, {}
