"""Figure 2: a toy environment with four discrete states; Table 1 has its behavior function.

::

    s0 --a1, +2--> s1 --a3, -1--> s3
    s0 --a2, +1--> s2

Episodes start in s0 or s1 and end in s2 or s3. Every action number is legal in every state: in s0,
action 0 is a1 and every other is a2; in s1 all of them are a3.
"""

from typing import Any

import gymnasium as gym
import numpy as np

A1, A2, A3 = 0, 1, 2


class Figure2(gym.Env[np.int64, np.int64]):
    """The toy environment; observations are the numbers of states, actions those of the figure."""

    metadata = {"render_modes": [], "max_return": 2.0}

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Discrete(4)
        self.action_space = gym.spaces.Discrete(3)
        self.render_mode = None
        self._state = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.int64, dict[str, Any]]:
        """Start in s0 or s1, drawn from the environment's generator."""
        super().reset(seed=seed)
        self._state = int(self.np_random.integers(2))
        return np.int64(self._state), {}

    def step(self, action: np.int64) -> tuple[np.int64, float, bool, bool, dict[str, Any]]:
        """Take a transition of the figure."""
        if self._state == 0:
            self._state, reward = (1, 2.0) if action == A1 else (2, 1.0)
        else:
            self._state, reward = 3, -1.0
        return np.int64(self._state), reward, self._state in (2, 3), False, {}
