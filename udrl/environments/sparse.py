"""Section 3.4: sparse rewards, all at the last step."""

from typing import Any, SupportsFloat

import gymnasium as gym


class RewardAtEnd(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Withholds the rewards of an episode and returns their sum, a float, at the last step.

    Apply it outside the ``TimeLimit`` wrapper, so that it sees truncations. Gymnasium applies a
    registration's ``additional_wrappers`` there.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        self._withheld = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode, with nothing withheld."""
        self._withheld = 0.0
        return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Take a step; the reward is 0 until the episode ends, then the sum of all rewards."""
        observation, reward, terminated, truncated, info = super().step(action)
        self._withheld += float(reward)
        given = self._withheld if terminated or truncated else 0.0
        return observation, given, terminated, truncated, info
