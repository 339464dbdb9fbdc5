"""The action mask as part of the observation (``action_mask``)."""

from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from udrl.environments.conversions import describe
from udrl.errors import EnvironmentFault
from udrl.spaces import Key

#: Key of the mask in ``info``, and in observations.
MASK = "action_mask"
OBSERVATION = "observation"


def below_observation(path: tuple[Key, ...]) -> tuple[Key, ...]:
    """Return a leaf's path below the nested ``observation`` keys that our wrappers add."""
    while path[:1] == (OBSERVATION,):
        path = path[1:]
    return path


class ObserveMask(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Adds ``info["action_mask"]`` to the observation, in a ``Dict``.

    Args:
        env: any environment whose ``info`` has the mask after every reset and step.
        size: length of the mask, one number for each output of the behavior function.
    """

    def __init__(self, env: gym.Env[Any, Any], size: int) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, size=size)
        gym.Wrapper.__init__(self, env)
        self._size = size
        self.observation_space = spaces.Dict(
            [(OBSERVATION, env.observation_space), (MASK, spaces.MultiBinary(size))]
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self._with_mask("reset", observation, info), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._with_mask("step", observation, info), reward, terminated, truncated, info

    def _with_mask(self, where: str, observation: Any, info: Any) -> dict[str, Any]:
        return {OBSERVATION: observation, MASK: mask_in(info, self._size, where)}


def mask_in(info: Any, size: int, where: str) -> npt.NDArray[np.int8]:
    """Return the mask in the ``info`` of ``reset`` or ``step``, in one array.

    Args:
        info: the environment's ``info``.
        size: length of the mask.
        where: the method that returned it, for messages.

    Raises:
        EnvironmentFault: there is no mask, or it is invalid.
    """
    try:
        given = info[MASK]
    except (KeyError, TypeError, IndexError) as error:
        raise EnvironmentFault(
            f"{where}() returned {describe(info)} as info, without {MASK!r}; set "
            f"action_mask only where every info has it"
        ) from error
    parts = given if isinstance(given, tuple) else (given,)
    mask = np.concatenate([np.asarray(part).reshape(-1) for part in parts])
    if mask.size != size or mask.dtype.kind not in "biuf":
        raise EnvironmentFault(
            f"{where}() returned as info[{MASK!r}] {describe(given)}, expected {size} "
            f"numbers, 0 or 1"
        )
    return mask.astype(np.int8)
