"""Environments of every kind of space, importable as ``kinds_of_spaces:Nested-v0`` and so on.

Each is learned quickly: it pays for every component of the action that equals its counterpart in
the observation.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

STEPS = 8


class Nested(gym.Env[Any, Any]):
    """Dictionaries and tuples of all kinds of spaces, as observation and as action."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.observation_space = spaces.Dict(
            bag=spaces.Tuple((spaces.MultiBinary(2), spaces.MultiDiscrete([2, 3]))),
            map=spaces.Box(0, 255, (6, 6, 3), np.uint8),
            room=spaces.Discrete(3, start=1),
            speed=spaces.Box(-1, 1, (2, 2), np.float64),
        )
        self.action_space = spaces.Dict(
            door=spaces.Discrete(3, start=1),
            hands=spaces.MultiBinary(2),
            legs=spaces.Box(-1, 1, (2,), np.float32),
        )

    def _seen(self) -> Any:
        draw = self.np_random
        self._door, self._hands = int(draw.integers(1, 4)), draw.integers(0, 2, 2, np.int8)
        return {
            "bag": (self._hands, draw.integers([2, 3])),
            "map": draw.integers(0, 256, (6, 6, 3), np.uint8),
            "room": self._door,
            "speed": draw.uniform(-1, 1, (2, 2)),
        }

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self._step = 0
        return self._seen(), {}

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action), action
        reward = float(action["door"] == self._door) + float((action["hands"] == self._hands).sum())
        self._step += 1
        return (
            self._seen(),
            reward - float(abs(action["legs"]).sum()),
            self._step == STEPS,
            False,
            {},
        )

    def render(self) -> Any:
        return np.zeros((32, 32, 3), np.uint8)


class Reach(gym.Env[Any, Any]):
    """Pays if the action is close to the observed number."""

    def __init__(self) -> None:
        self.observation_space = spaces.Box(-1, 1, (), np.float32)
        self.action_space = spaces.Box(-1, 1, (1,), np.float64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self._step = 0
        self._goal = self.np_random.uniform(-1, 1)
        return np.array(self._goal, np.float32), {}

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action), action
        reward = -abs(float(action[0]) - self._goal)
        self._step += 1
        self._goal = self.np_random.uniform(-1, 1)
        return np.array(self._goal, np.float32), reward, self._step == STEPS, False, {}


class Unsorted(gym.Env[Any, Any]):
    """Pays for the first component of the action; the keys of its spaces are not sorted."""

    def __init__(self) -> None:
        place = spaces.Box(-1, 1, (1,), np.float32)
        self.observation_space = spaces.Dict([("sight", place), ("health", place)])
        self.action_space = spaces.Dict(
            [("walk", spaces.Discrete(2)), ("talk", spaces.Discrete(2))]
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self._step = 0
        return self._seen(), {}

    def step(self, action: Any) -> Any:
        self._step += 1
        return self._seen(), float(action["walk"]), self._step == STEPS, False, {}

    def _seen(self) -> Any:
        sight, health = self.np_random.uniform(-1, 1, (2, 1)).astype(np.float32)
        return {"sight": sight, "health": health}


for environment in (Nested, Reach, Unsorted):
    name = f"{environment.__name__}-v0"
    if name not in gym.registry:
        gym.register(
            name, entry_point=f"kinds_of_spaces:{environment.__name__}", max_episode_steps=100
        )
