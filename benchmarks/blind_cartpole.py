"""CartPole without velocities, so that a single observation is not enough to act well."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control.cartpole import CartPoleEnv


class BlindCartPole(gym.ObservationWrapper[Any, Any, Any]):
    """Observes only the cart's position and the pole's angle."""

    def __init__(self, **kwargs: Any) -> None:
        env = CartPoleEnv(**kwargs)
        super().__init__(env)
        space = env.observation_space
        assert isinstance(space, gym.spaces.Box)
        kept = [0, 2]
        self.observation_space = gym.spaces.Box(space.low[kept], space.high[kept], dtype=np.float32)

    def observation(self, observation: Any) -> Any:
        """Remove the velocities."""
        return observation[[0, 2]]


if "BlindCartPole-v0" not in gym.registry:
    gym.register(
        "BlindCartPole-v0", entry_point="blind_cartpole:BlindCartPole", max_episode_steps=500
    )
