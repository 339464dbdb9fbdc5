"""Section 3.4: the same task with all reward at the last step."""

from typing import Any, SupportsFloat

import gymnasium as gym


class RewardAtEnd(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Withholds the rewards of an episode and gives their sum, a float, with its last step.

    It belongs outside the time limit, so that it sees an episode that is cut
    (``additional_wrappers`` of a registration stand there).
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        self._withheld = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; nothing is withheld yet."""
        self._withheld = 0.0
        return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Give 0 until the episode ends, then everything that was withheld."""
        observation, reward, terminated, truncated, info = super().step(action)
        self._withheld += float(reward)
        given = self._withheld if terminated or truncated else 0.0
        return observation, given, terminated, truncated, info
