"""The wrapper that adapts an environment to the algorithm's spaces, and checks what it returns."""

import logging
import math
import sysconfig
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from udrl.environments.conversions import Array, Conversion, describe
from udrl.environments.step_limits import most_actions
from udrl.errors import EnvironmentFault, InvalidData

log = logging.getLogger("udrl")

#: An environment with any spaces.
Environment = gym.Env[Any, Any]

_RESET = "(observation, info)"
_STEP = "(observation, reward, terminated, truncated, info)"
#: Largest absolute value of a reward.
_LARGEST = float(np.finfo(np.float32).max)
#: Python's message if an environment's step() has the interface of Gym before version 0.26.
_OLD_STEP = "not enough values to unpack (expected 5, got 4)"
#: Folders of Python, of installed packages, and of this one.
_INSTALLED = (*set(sysconfig.get_paths().values()), str(Path(__file__).parents[1]))


class Adapter(gym.Wrapper[Any, Any, Any, Any]):
    """Returns plain observations and takes plain actions (:mod:`udrl.environments.conversions`).

    Args:
        env: the environment.
        observations: conversion of its observations.
        actions: conversion of its actions.
    """

    def __init__(self, env: Environment, observations: Conversion, actions: Conversion) -> None:
        super().__init__(env)
        self.observations = observations
        self.actions = actions
        self.observation_space = observations.plain.gymnasium
        self.action_space = actions.plain.gymnasium
        self._actions_left = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin an episode.

        Raises:
            EnvironmentFault: the environment returned an invalid value, or called ``sys.exit``.
        """
        try:
            returned: Any = self.env.reset(seed=seed, options=options)
        except SystemExit as error:  # it would end this process without a message
            raise EnvironmentFault(raised("reset", error)) from error
        if not isinstance(returned, tuple) or len(returned) != 2:
            raise _wrong("reset", describe(returned), _RESET)
        observation, info = returned
        if not isinstance(info, Mapping):
            raise _wrong("reset", f"{describe(info)} as info", "a dictionary")
        self._actions_left = most_actions(self.env)
        return self._seen("reset", observation), dict(info)

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Take a step.

        Args:
            action: a plain action.

        Raises:
            EnvironmentFault: the environment returned an invalid value, did not end the episode at
                its step limit, or called ``sys.exit``.
        """
        try:
            returned: Any = self.env.step(self.actions.back_one(action))
        except ValueError as error:
            if str(error).endswith(_OLD_STEP):  # raised by Gymnasium's wrappers
                raise _wrong("step", "a tuple of 4", f"{_STEP}, required since Gym 0.26") from error
            raise
        except SystemExit as error:
            raise EnvironmentFault(raised("step", error)) from error
        if type(returned) is not tuple or len(returned) != 5:
            raise _wrong("step", describe(returned), _STEP)
        observation, reward, terminated, truncated, info = returned
        if type(reward) is not float or not -_LARGEST <= reward <= _LARGEST:
            reward = checked_reward(reward)
        if type(terminated) is not bool:
            terminated = _flag("terminated", terminated)
        if type(truncated) is not bool:
            truncated = _flag("truncated", truncated)
        self._actions_left -= 1
        if self._actions_left <= 0 and not (terminated or truncated):
            raise EnvironmentFault(
                f"step() did not end the episode at its step limit of {most_actions(self.env)}; a "
                f"wrapper hides truncated, or passes by gymnasium.wrappers.TimeLimit with unwrapped"
            )
        return self._seen("step", observation), reward, terminated, truncated, info

    def close(self) -> None:
        """Close the environment; its exceptions are logged and ignored."""
        close(self.env)

    def _seen(self, where: str, observation: Any) -> Array:
        try:
            return self.observations.one(observation)
        except InvalidData as error:
            raise EnvironmentFault(f"{where}() returned {error}") from error


def close(env: Environment) -> None:
    """Close an environment; its exceptions are logged and ignored."""
    try:
        env.close()
    except (Exception, SystemExit) as error:  # noqa: BLE001 - the environment is foreign code
        log.warning("environment %s failed in close(): %s: %s", env, type(error).__name__, error)


def raised(where: str, error: BaseException) -> str:
    """Describe an exception of an environment's method, with the line of the environment's code.

    That is the innermost line outside of installed packages, or the innermost one of all. An
    :class:`EnvironmentFault` describes itself.

    Args:
        where: name of the method.
        error: the exception.
    """
    if isinstance(error, EnvironmentFault):
        return str(error)
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if not any(map(Path(f.filename).is_relative_to, _INSTALLED))]
    found = (own or frames)[-1:]
    place = "".join(f" ({Path(f.filename).name}, line {f.lineno})" for f in found)
    return f"{where}() raised {type(error).__name__}: {error}{place}"


def _wrong(where: str, returned: str, expected: str) -> EnvironmentFault:
    return EnvironmentFault(f"{where}() returned {returned}, expected {expected}")


def checked_reward(reward: Any) -> float:
    """Return the reward of a step as a float.

    Raises:
        EnvironmentFault: it is not a finite number that float32 can hold.
    """
    number = reward if type(reward) is float else _number(reward)
    if not -_LARGEST <= number <= _LARGEST:
        raise _wrong("step", f"the reward {number}", "a finite number that float32 can hold")
    return number


def _number(reward: Any) -> float:
    """Return a number, or the one element of an array, as a float."""
    if isinstance(reward, np.ndarray) and reward.size == 1:
        reward = reward.item()
    if isinstance(reward, int | float | np.integer | np.floating | np.bool_):
        try:
            return float(reward)
        except OverflowError:  # an integer
            return math.inf if reward > 0 else -math.inf
    raise _wrong("step", f"{describe(reward)} as reward", "a number")


def _flag(name: str, value: Any) -> bool:
    """Return a truth value, or the one element of an array, as a bool."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    if isinstance(value, bool | np.bool_) or (isinstance(value, int) and value in (0, 1)):
        return bool(value)
    raise _wrong("step", f"{describe(value)} as {name}", "True or False")
