"""Faulty wrappers of environments, e.g. ``disturbed_environments:Raising-v0``.

Some fail at random, independently of the command, so that the same command succeeds in another
process or later. The others always fail, but only for one command. If the environment variable
``UDRL_HEALED`` is set, none fails. None fails in the probes that services run before they join,
whose seeds are the lowest.
"""

import ctypes
import itertools
import os
import random
import sys
import time
from functools import partial
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

#: Environment variable; if it is set, no environment fails.
HEALED = "UDRL_HEALED"
#: Environment variable with the path of a file. The process that creates it is the slow one.
SLOW_ONE = "UDRL_SLOW_ONE"

#: Environment variable with the seed of the command that always fails.
CURSED = "UDRL_CURSED"

_FIRST_OF_A_RUN = 1_000_100

_chance = random.Random(f"{os.environ.get('UDRL_CHAOS_SEED', '0')}-{os.getpid()}")  # noqa: S311


class Disturbed(gym.Wrapper[Any, Any, Any, Any]):
    """Base of environments that fail in some episodes of a run."""

    #: Probability that an episode fails. None: always, for one command.
    chance: ClassVar[float | None] = None

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self._fails = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin an episode, and decide whether it fails."""
        in_run = (seed or 0) > _FIRST_OF_A_RUN and HEALED not in os.environ
        self._fails = in_run and self.is_faulty(seed or 0)
        return super().reset(seed=seed, options=options)

    def is_faulty(self, seed: int) -> bool:
        """Return whether the episode fails."""
        return _is_cursed(seed) if self.chance is None else _draw() < self.chance

    def step(self, action: Any) -> Any:
        """Advance; fail at about one in ten steps of a failing episode."""
        if self._fails and _draw() < 0.1:
            return self.fail(super().step(action))
        return super().step(action)

    def fail(self, outcome: Any) -> Any:
        """Raise, hang, or return an invalid outcome."""
        raise NotImplementedError


def _is_cursed(seed: int) -> bool:
    return str(seed) == os.environ.get(CURSED)


def _draw() -> float:
    return _chance.random()


class Raising(Disturbed):
    """Raises in one of 20 episodes."""

    chance: ClassVar[float | None] = 0.05

    def fail(self, outcome: Any) -> Any:
        """Raise."""
        raise RuntimeError("injected fault")


class Nan(Disturbed):
    """Observes NaN in one of 20 episodes."""

    chance: ClassVar[float | None] = 0.05

    def fail(self, outcome: Any) -> Any:
        """Return an observation of NaN."""
        observation, *others = outcome
        return np.full_like(observation, np.nan), *others


class Hanging(Disturbed):
    """Hangs in native code and holds the GIL, in every 150th episode of a process.

    Not at random: ``udrl train`` ends a run if a service dies more than five times within a minute.
    """

    _episodes = itertools.count(1)

    def is_faulty(self, seed: int) -> bool:
        """Return whether this is a 150th episode."""
        return next(self._episodes) % 150 == 0

    def fail(self, outcome: Any) -> Any:
        """Sleep in C with the GIL held: no Python code of this process runs again."""
        ctypes.PyDLL(None).sleep(3600)
        return outcome


class AlwaysRaising(Raising):
    """Always raises, for one command."""

    chance = None


class AlwaysHanging(Hanging):
    """Always hangs, for one command."""

    def is_faulty(self, seed: int) -> bool:
        """Return whether this is the command that always fails."""
        return _is_cursed(seed)


class Slow(gym.Wrapper[Any, Any, Any, Any]):
    """Makes steps 20 times as slow, in one actor process of a run."""

    _slow: ClassVar[bool | None] = None

    def step(self, action: Any) -> Any:
        """Advance slowly."""
        began = time.perf_counter()
        outcome = super().step(action)
        if self._is_slow():
            time.sleep(19 * (time.perf_counter() - began))
        return outcome

    @classmethod
    def _is_slow(cls) -> bool:
        if cls._slow is None:
            cls._slow = "actor" in sys.argv and _is_first(os.environ[SLOW_ONE])
        return cls._slow


def _is_first(path: str) -> bool:
    try:
        os.close(os.open(path, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return False
    return True


def _make(wrapper: type[gym.Wrapper[Any, Any, Any, Any]], inner: str, **options: Any) -> Any:
    return wrapper(gym.make(inner, **options))


for _wrapper in (Raising, Nan, Hanging, AlwaysRaising, AlwaysHanging, Slow):
    _name = f"{_wrapper.__name__}-v0"
    if _name not in gym.registry:
        gym.register(_name, entry_point=partial(_make, _wrapper))
