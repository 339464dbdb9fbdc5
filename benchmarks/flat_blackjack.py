"""Gymnasium's Blackjack with its three observations as one number, ``FlatBlackjack-v0``."""

from typing import Any

import gymnasium as gym
import numpy as np


class FlatBlackjack(gym.ObservationWrapper[np.int64, Any, Any]):
    """Sum, dealer's card and usable ace as a ``Discrete`` observation."""

    def __init__(self, **arguments: Any) -> None:
        super().__init__(gym.make("Blackjack-v1", **arguments))
        self.observation_space = gym.spaces.Discrete(32 * 11 * 2)

    def observation(self, observation: Any) -> np.int64:
        """Return their number."""
        total, dealer, ace = observation
        return np.int64((total * 11 + dealer) * 2 + int(ace))


gym.register("FlatBlackjack-v0", entry_point="flat_blackjack:FlatBlackjack", max_episode_steps=20)
