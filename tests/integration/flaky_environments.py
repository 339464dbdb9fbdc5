"""Failing environments, importable as ``flaky_environments:Flaky-v0`` and so on."""

import ctypes
from typing import Any, ClassVar

import gymnasium as gym
from gymnasium.envs.classic_control.cartpole import CartPoleEnv


class Flaky(CartPoleEnv):
    """CartPole that raises in many episodes, but at most once in each."""

    raised_for: ClassVar[set[int]] = set()  # reset seeds of training episodes
    _seed = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self._seed = seed or 0
        return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> Any:
        training = self._seed > 1_000_100
        if training and self._seed % 3 == 0 and self._seed not in self.raised_for:
            self.raised_for.add(self._seed)
            raise RuntimeError("the simulator lost its mind")
        return super().step(action)  # type: ignore[no-untyped-call]


class Cursed(CartPoleEnv):
    """CartPole that always raises in episodes with certain reset seeds."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        if seed is not None and seed > 1_000_100 and seed % 7 == 0:
            raise RuntimeError(f"seed {seed} is cursed")
        return super().reset(seed=seed, options=options)


class Hung(CartPoleEnv):
    """CartPole that hangs in native code, while it holds the GIL, for certain reset seeds."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        if seed is not None and seed > 1_000_100 and seed % 7 == 0:
            ctypes.PyDLL(None).sleep(3600)
        return super().reset(seed=seed, options=options)


for environment in (Flaky, Cursed, Hung):
    name = f"{environment.__name__}-v0"
    if name not in gym.registry:
        gym.register(
            name, entry_point=f"flaky_environments:{environment.__name__}", max_episode_steps=500
        )
