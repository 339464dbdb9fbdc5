"""Checks that an environment is deterministic: on this machine, on other machines, and later.

A run is exact only if its environment is. Whether machines compute the same numbers is a separate
question, with a separate remedy (:mod:`udrl.numerics`).
"""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.commands import TRAINING_SEEDS, Command
from udrl.config import Config
from udrl.digests import episode_digest
from udrl.environments.adapter import raised
from udrl.environments.making import make_environment
from udrl.environments.step_limits import limit_steps
from udrl.episode import Episode
from udrl.errors import EnvironmentFault
from udrl.streams import Purpose, stream_key

Result = TypeVar("Result")

#: Maximum length of a probe's episode, in steps.
PROBE_STEPS = 64


def environment_digest(generator: EpisodeGenerator) -> str:
    """Return the digest of a short episode of random actions, 16 hexadecimal digits.

    Raises:
        EnvironmentFault: the environment raised an exception, or returned an invalid value.
    """
    return _short_episode(generator, index=0).hex()[:16]


def repeated_digest(generator: EpisodeGenerator) -> str:
    """Return :func:`environment_digest`, or "" if it differs after another episode.

    Raises:
        EnvironmentFault: the environment raised an exception, or returned an invalid value.
    """
    first = environment_digest(generator)
    _short_episode(generator, index=1)
    return first if environment_digest(generator) == first else ""


def _short_episode(generator: EpisodeGenerator, index: int) -> bytes:
    steps = min(PROBE_STEPS, generator.spec.max_episode_steps)
    command = Command(
        id=index,
        kind="warm_up",
        desired_return=0.0,
        desired_horizon=0,
        environment_seed=TRAINING_SEEDS[0] + index,
        stream_key=stream_key(0, Purpose.PROBE, 1, index),
        weights_version=0,
        max_steps=steps,
        random_steps=steps,
    )
    return episode_digest(generate_episodes(generator, [command], None)[0])


def difference(config: Config, episode: Episode, seed: int, max_steps: int) -> str | None:
    """Replay an episode's actions and describe the first step that differs.

    Args:
        config: settings of the episode's run.
        episode: the recorded episode.
        seed: its environment seed.
        max_steps: its step limit.

    Returns:
        A description of the first difference; None: there is none.

    Raises:
        UnsupportedEnvironment: the environment can no longer be created.
        EnvironmentFault: it raised an exception, or returned an invalid value.
    """
    env = make_environment(config)
    try:
        limit_steps(env, max_steps)
        observation, _ = _called("reset", env.reset, seed=seed)
        for t in range(episode.length):
            if not np.array_equal(observation, episode.observations[t]):
                return f"the observation of step {t} differs"
            taken = _called("step", env.step, episode.actions[t])
            observation, reward, terminated, truncated, _ = taken
            if np.float32(reward) != episode.rewards[t]:
                return f"the reward of step {t} is {reward:g}, it was {episode.rewards[t]:g}"
            ends = t == episode.length - 1
            expected = (episode.terminated and ends, episode.truncated and ends)
            if (terminated, truncated) != expected:
                return f"step {t} differs in terminated or truncated"
        return None
    finally:
        env.close()


def _called(where: str, method: Callable[..., Result], *args: Any, **kwargs: Any) -> Result:
    """Call a method of the environment; turn its exceptions into :class:`EnvironmentFault`."""
    try:
        return method(*args, **kwargs)
    except Exception as error:
        raise EnvironmentFault(raised(where, error)) from error
