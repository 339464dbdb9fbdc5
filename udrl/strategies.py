"""Section 2.3.4: strategies that choose exploratory commands, given the best episodes.

The paper's desired returns are slightly above the mean of the best episodes. Section 6 suggests
studying other strategies. A strategy is a class with one method. The setting ``command_strategy``
names it: one of :data:`STRATEGIES`, or your own, importable as ``package.module:Class``::

    class Patient:
        def __init__(self, config: Config) -> None: ...

        def __call__(self, best: Sequence[Entry], u: float) -> tuple[float, int]:
            return best[-1].episode_return, 2 * best[-1].length
"""

import math
from collections.abc import Sequence
from importlib import import_module
from typing import NamedTuple, Protocol

import numpy as np

from udrl.config import Config
from udrl.errors import ConfigError
from udrl.replay_buffer import Entry

#: Largest absolute value of a desired horizon, and of a desired return that a user may enter.
MAX_DESIRED = 10**9
_MAX_RETURN = float(np.finfo(np.float32).max)


class CommandStrategy(Protocol):
    """Chooses exploratory commands. Created once per run, from its settings."""

    def __init__(self, config: Config) -> None: ...

    def __call__(self, best: Sequence[Entry], u: float) -> tuple[float, int]:
        """Return the desired return and horizon of one exploratory command.

        The result must depend only on the arguments; otherwise the run is not reproducible.

        Args:
            best: the ``last_few`` best episodes, lowest return first; at least one.
            u: uniform in [0, 1), different for each command.

        Returns:
            Desired return, which float32 can hold, and desired horizon in steps, at most 1e9;
            values below 1 count as 1.
        """
        ...


class Best(NamedTuple):
    """Statistics of the best episodes (sections 2.3.4 and 2.3.6).

    Attributes:
        mean: M, the mean of their returns.
        deviation: S, the population standard deviation of their returns.
        horizon: their mean length, rounded to the nearest integer.
    """

    mean: float
    deviation: float
    horizon: int

    @classmethod
    def of(cls, episodes: Sequence[Entry]) -> "Best":
        """Return the statistics of the given episodes, at least one."""
        n = len(episodes)
        # fsum rounds once, so that the result does not depend on the order of summation.
        mean = math.fsum(e.episode_return for e in episodes) / n
        variance = math.fsum((e.episode_return - mean) ** 2 for e in episodes) / n
        mean_length = sum(e.length for e in episodes) / n
        return cls(mean, math.sqrt(variance), nearest(mean_length))


def nearest(number: float) -> int:
    """Round to the nearest integer, halves up."""
    return math.floor(number + 0.5)


class Uniform:
    """The paper's strategy: returns uniform in [M, M + S], and the mean length."""

    def __init__(self, config: Config) -> None:
        pass

    def __call__(self, best: Sequence[Entry], u: float) -> tuple[float, int]:
        """Return M + u S and the mean length."""
        mean, deviation, horizon = Best.of(best)
        return mean + deviation * u, horizon


class Ranked:
    """Command the return and length of one of the best episodes; better ones are more likely.

    Such commands are diverse, and each has been fulfilled by an episode. This keeps the agent from
    converging to one behavior, and lets it repeat successes while they are still rare.
    """

    def __init__(self, config: Config) -> None:
        pass

    def __call__(self, best: Sequence[Entry], u: float) -> tuple[float, int]:
        """Return the return and length of one of the best episodes.

        With probability sqrt(k / n), it is one of the k best of n.
        """
        chosen = best[-1 - int(u * u * len(best))]
        return chosen.episode_return, chosen.length


class Maximum:
    """Always command the highest possible return (``max_return``).

    For tasks in which an agent obtains what is commanded and no more, such as balancing for a
    number of steps. There, commands slightly above the best episodes make progress slow.

    Raises:
        ConfigError: ``max_return`` is not set, and the environment does not declare it.
    """

    def __init__(self, config: Config) -> None:
        if config.max_return is None:
            raise ConfigError(
                "command_strategy = 'maximum' commands the highest possible return, but max_return "
                "is neither set nor declared by the environment; set it, e.g. --set max_return=500"
            )
        self._max_return = config.max_return

    def __call__(self, best: Sequence[Entry], u: float) -> tuple[float, int]:
        """Return ``max_return`` and the mean length of the best episodes."""
        return self._max_return, Best.of(best).horizon


STRATEGIES: dict[str, type[CommandStrategy]] = {
    "uniform": Uniform,
    "ranked": Ranked,
    "maximum": Maximum,
}


def strategy_class(name: str) -> type[CommandStrategy]:
    """Return the strategy of a name.

    Raises:
        ConfigError: there is none, or it cannot be imported.
    """
    if name in STRATEGIES:
        return STRATEGIES[name]
    module, colon, attribute = name.partition(":")
    if not colon:
        raise ConfigError(
            f"command_strategy {name!r}: expected {', '.join(STRATEGIES)}, or a class of your own "
            f"as package.module:Class"
        )
    try:
        kind: type[CommandStrategy] = getattr(import_module(module), attribute)
    except (Exception, SystemExit) as error:
        raise ConfigError(
            f"command_strategy {name!r} cannot be imported: {type(error).__name__}: {error}; name "
            f"a class that is importable here (PYTHONPATH)"
        ) from error
    return kind


def make_strategy(config: Config) -> CommandStrategy:
    """Return the strategy named by ``command_strategy``.

    Raises:
        ConfigError: there is no strategy of that name, or it cannot be imported or created.
    """
    name = config.commands.command_strategy
    kind = strategy_class(name)
    try:
        return kind(config)
    except ConfigError:
        raise
    except (Exception, SystemExit) as error:
        raise ConfigError(
            f"command_strategy {name!r} cannot be created: {type(error).__name__}: {error}; name a "
            f"class that takes a udrl.config.Config"
        ) from error


def choose_command(strategy: CommandStrategy, best: Sequence[Entry], u: float) -> tuple[float, int]:
    """Return the desired return and horizon that a strategy chooses, after checking them.

    Raises:
        ConfigError: the strategy raised an exception, or returned an invalid command.
    """
    name = type(strategy).__name__
    try:
        desired_return, desired_horizon = strategy(tuple(best), u)
        desired_return, desired_horizon = float(desired_return), int(desired_horizon)
    except (Exception, SystemExit) as error:
        raise ConfigError(
            f"command strategy {name} failed: {type(error).__name__}: {error}; expected a desired "
            f"return and a desired horizon"
        ) from error
    if not abs(desired_return) <= _MAX_RETURN or abs(desired_horizon) > MAX_DESIRED:
        raise ConfigError(
            f"command strategy {name} commands a return of {desired_return} within "
            f"{desired_horizon} steps; expected a return that float32 can hold, and at most "
            f"{MAX_DESIRED:,} steps"
        )
    return desired_return, max(1, desired_horizon)
