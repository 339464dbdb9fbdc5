"""The action mask as part of the observation (``action_mask``), and its checks."""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from udrl.environments.conversions import as_array, describe
from udrl.errors import EnvironmentFault, InvalidData
from udrl.spaces import Key

#: Key of the mask in ``info``, and in observations.
MASK = "action_mask"
#: Key of the wrapped environment's observation in the ``Dict`` observations of our wrappers.
OBSERVATION = "observation"

#: Name of the mask in messages.
_NAME = f"info[{MASK!r}]"


def below_observation(path: tuple[Key, ...]) -> tuple[Key, ...]:
    """Return a leaf's path below the nested ``observation`` keys that our wrappers add."""
    while path[:1] == (OBSERVATION,):
        path = path[1:]
    return path


class ObserveMask(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Adds ``info["action_mask"]`` to the observation, in a ``Dict``.

    Args:
        env: any environment whose ``info`` has the mask after every reset and step.
        components: number of values of each component of an action. The mask has a number for each
            of them, one for each output of the behavior function.
    """

    def __init__(self, env: gym.Env[Any, Any], components: tuple[int, ...]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, components=components)
        gym.Wrapper.__init__(self, env)
        self._components = components
        self.observation_space = spaces.Dict(
            [(OBSERVATION, env.observation_space), (MASK, spaces.MultiBinary(sum(components)))]
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        mask = mask_in(info, self._components, "reset", is_over=False)
        return {OBSERVATION: observation, MASK: mask}, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        mask = mask_in(info, self._components, "step", is_over=terminated or truncated)
        return {OBSERVATION: observation, MASK: mask}, reward, terminated, truncated, info


class CheckMask(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Checks the mask that is an entry of a ``Dict`` observation.

    Args:
        env: an environment whose observations have the entry.
        entry: key of the entry.
        components: number of values of each component of an action.
    """

    def __init__(self, env: gym.Env[Any, Any], entry: str, components: tuple[int, ...]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, entry=entry, components=components)
        gym.Wrapper.__init__(self, env)
        self._entry = entry
        self._components = components

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._check(observation, "reset", is_over=False)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._check(observation, "step", is_over=terminated or truncated)
        return observation, reward, terminated, truncated, info

    def _check(self, observation: Any, where: str, *, is_over: bool) -> None:
        while isinstance(observation, Mapping):
            if self._entry in observation:
                name = f"observation[{self._entry!r}]"
                # Other faults are found when the observation is converted.
                try:
                    mask = as_array(name, observation[self._entry]).reshape(-1)
                except InvalidData:
                    return
                if mask.size == sum(self._components) and mask.dtype.kind in "biuf":
                    _checked(name, mask, self._components, where, is_over=is_over)
                return
            observation = observation.get(OBSERVATION)


def mask_in(
    info: Any, components: tuple[int, ...], where: str, *, is_over: bool
) -> npt.NDArray[np.int8]:
    """Return the mask in the ``info`` of ``reset`` or ``step``, in one array.

    Args:
        info: the environment's ``info``.
        components: number of values of each component of an action.
        where: the method that returned it, for messages.
        is_over: whether the episode has ended, so that no action need be allowed.

    Raises:
        EnvironmentFault: there is no mask, or it is invalid.
    """
    try:
        given = info[MASK]
    except (KeyError, TypeError, IndexError) as error:
        raise EnvironmentFault(
            f"{where}() returned {describe(info)} as info, without {MASK!r}; use action_mask = "
            f"'info' only if every reset and step returns it"
        ) from error
    size = sum(components)
    try:
        mask = _flat(given)
    except ValueError:  # lists of unequal lengths
        mask = np.empty(0)
    if mask.size != size or mask.dtype.kind not in "biuf":
        raise EnvironmentFault(
            f"{where}() returned {describe(given)} as {_NAME}, expected {size} numbers, 0 or 1"
        )
    return _checked(_NAME, mask, components, where, is_over=is_over)


def _flat(given: Any) -> npt.NDArray[Any]:
    if isinstance(given, tuple) and given:
        return np.concatenate([np.asarray(part).reshape(-1) for part in given])
    return np.asarray(given).reshape(-1)


def _checked(
    name: str,
    mask: npt.NDArray[Any],
    components: tuple[int, ...],
    where: str,
    *,
    is_over: bool,
) -> npt.NDArray[np.int8]:
    """Return a mask, one number for each value of each component, as int8.

    Raises:
        EnvironmentFault: not all numbers are 0 or 1, or no action is allowed.
    """
    allowed: npt.NDArray[np.bool_] = mask == 1
    n_allowed = np.count_nonzero(allowed)
    if np.count_nonzero(mask) != n_allowed:
        place = int(np.argmax((mask != 0) & ~allowed))
        raise EnvironmentFault(
            f"{where}() returned {mask[place].item()!r} as number {place} of {name}, expected 0 "
            f"or 1"
        )
    if not is_over and (n_allowed == 0 or len(components) > 1):
        first = _firsts(components)
        found = np.logical_or.reduceat(allowed, first)
        if np.count_nonzero(found) < len(components):
            k = int(found.argmin())
            last = first[k] + components[k] - 1
            part = f"the numbers {first[k]} to {last} of " if len(components) > 1 else ""
            raise EnvironmentFault(
                f"{where}() returned no 1 in {part}{name}, so no action is allowed; expected at "
                f"least one, except after the last step"
            )
    return allowed.view(np.int8)


@lru_cache
def _firsts(components: tuple[int, ...]) -> npt.NDArray[np.int64]:
    """Return the index of each component's first number."""
    return np.cumsum((0, *components[:-1]))
