"""Whether an environment does again what it did: here, elsewhere, and at another time.

A run is exact only if it does. That is another question than whether machines round alike
(:mod:`udrl.numerics`), with another remedy.
"""

import numpy as np

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.commands import TRAINING_SEEDS, Command
from udrl.config import Config
from udrl.digests import episode_digest
from udrl.environments.making import limit_steps, make_environment
from udrl.episode import Episode
from udrl.streams import Purpose, stream_key

#: Steps of an episode of the probe.
PROBE_STEPS = 64


def environment_digest(generator: EpisodeGenerator) -> str:
    """Return the digest of a short episode of random actions, 16 hexadecimal digits.

    Raises:
        EnvironmentFault: the environment raised, or returned what it may not.
    """
    return _short_episode(generator, index=0).hex()[:16]


def repeated_digest(generator: EpisodeGenerator) -> str:
    """Return :func:`environment_digest`, or "" if it is another after an episode in between.

    Raises:
        EnvironmentFault: the environment raised, or returned what it may not.
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
    """Say where an environment does not repeat an episode when its actions are taken again.

    Args:
        config: the settings that the episode was made with.
        episode: as it was.
        seed: what its environment was reset with.
        max_steps: after which it was truncated.

    Returns:
        The first step that differs, in words; None: there is none.

    Raises:
        UnsupportedEnvironment: the environment can no longer be made.
        EnvironmentFault: it returned what it may not.
    """
    env = make_environment(config)
    try:
        limit_steps(env, max_steps)
        observation, _ = env.reset(seed=seed)
        for t in range(episode.length):
            if not np.array_equal(observation, episode.observations[t]):
                return f"step {t} shows another observation"
            observation, reward, terminated, truncated, _ = env.step(episode.actions[t])
            if np.float32(reward) != episode.rewards[t]:
                return f"step {t} gives the reward {reward:g}, it gave {episode.rewards[t]:g}"
            ends = t == episode.length - 1
            expected = (episode.terminated and ends, episode.truncated and ends)
            if (terminated, truncated) != expected:
                return f"step {t} ends the episode otherwise"
        return None
    finally:
        env.close()
