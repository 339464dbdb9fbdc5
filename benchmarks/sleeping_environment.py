"""An environment whose steps take time but no CPU: ``sleeping_environment:Sleeping-v0``."""

import time
from typing import Any

import gymnasium as gym


class Sleeping(gym.Wrapper[Any, Any, Any, Any]):
    """Sleeps after every step, like an environment that waits for a remote simulator.

    Args:
        env: the environment.
        seconds: duration of the sleep.
    """

    def __init__(self, env: gym.Env[Any, Any], seconds: float) -> None:
        super().__init__(env)
        self._seconds = seconds

    def step(self, action: Any) -> Any:
        """Advance, then sleep."""
        outcome = super().step(action)
        time.sleep(self._seconds)
        return outcome


def make(inner: str = "LunarLander-v3", seconds: float = 0.002) -> Sleeping:
    """Return an environment that sleeps."""
    return Sleeping(gym.make(inner), seconds)


if "Sleeping-v0" not in gym.registry:
    gym.register("Sleeping-v0", entry_point="sleeping_environment:make")
