"""Environments around another one that misbehave: ``disturbed_environments:Raising-v0`` and so on.

Those that misbehave now and then do so by a chance of the process, whatever the command, so that
the same command succeeds elsewhere or later. The others do it always, under one command.
``UDRL_HEALED`` in the process' environment cures all of them. They spare the probes that services
run before they join, whose seeds come first.
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

HEALED = "UDRL_HEALED"
#: A file; the process that creates it is the slow one.
SLOW_ONE = "UDRL_SLOW_ONE"

#: The seed of the command that fails always.
CURSED = "UDRL_CURSED"

_FIRST_OF_A_RUN = 1_000_100

_chance = random.Random(f"{os.environ.get('UDRL_CHAOS_SEED', '0')}-{os.getpid()}")  # noqa: S311


class Disturbed(gym.Wrapper[Any, Any, Any, Any]):
    """An environment that is well until an episode of a run begins."""

    #: Chance that an episode is disturbed; None: always, under one command.
    chance: ClassVar[float | None] = None

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self._sick = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin an episode and decide its fate."""
        in_run = (seed or 0) > _FIRST_OF_A_RUN and HEALED not in os.environ
        self._sick = in_run and self.is_doomed(seed or 0)
        return super().reset(seed=seed, options=options)

    def is_doomed(self, seed: int) -> bool:
        """Say whether the episode that begins is a bad one."""
        return _is_cursed(seed) if self.chance is None else _draw() < self.chance

    def step(self, action: Any) -> Any:
        """Advance, or misbehave in about one of ten steps of a doomed episode."""
        if self._sick and _draw() < 0.1:
            return self.misbehave(super().step(action))
        return super().step(action)

    def misbehave(self, outcome: Any) -> Any:
        """Do what this environment is for."""
        raise NotImplementedError


def _is_cursed(seed: int) -> bool:
    return str(seed) == os.environ.get(CURSED)


def _draw() -> float:
    return _chance.random()


class Raising(Disturbed):
    """Raises in one of twenty episodes."""

    chance: ClassVar[float | None] = 0.05

    def misbehave(self, outcome: Any) -> Any:
        """Raise."""
        raise RuntimeError("the simulator lost its mind")


class Nan(Disturbed):
    """Observes NaN in one of twenty episodes."""

    chance: ClassVar[float | None] = 0.05

    def misbehave(self, outcome: Any) -> Any:
        """Return NaN for every number observed."""
        observation, *others = outcome
        return np.full_like(observation, np.nan), *others


class Hanging(Disturbed):
    """Hangs in native code, holding the interpreter's lock, in every 150th episode of a process.

    Counted, not by chance: `udrl train` gives up what dies more than five times within a minute.
    """

    _episodes = itertools.count(1)

    def is_doomed(self, seed: int) -> bool:
        """Count."""
        return next(self._episodes) % 150 == 0

    def misbehave(self, outcome: Any) -> Any:
        """Sleep in C without letting go of the lock: no Python code of this process runs again."""
        ctypes.PyDLL(None).sleep(3600)
        return outcome


class AlwaysRaising(Raising):
    """Raises under one command every time."""

    chance = None


class AlwaysHanging(Hanging):
    """Hangs under one command every time."""

    def is_doomed(self, seed: int) -> bool:
        """Decide by the command."""
        return _is_cursed(seed)


class Slow(gym.Wrapper[Any, Any, Any, Any]):
    """Takes twenty times as long for a step, in one actor process of a run."""

    _slow: ClassVar[bool | None] = None

    def step(self, action: Any) -> Any:
        """Advance, and be slow about it."""
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
