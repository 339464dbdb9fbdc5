"""Episodes of others: Minari datasets, to learn from and to hand on.

A run that names a ``dataset`` begins with its episodes where others begin with random ones: they
are its warm-up (section 2.3.1). A dataset has one observation more than steps, on the last of which
nobody acted. Episodes here have none, so in what is written the last one is there twice.
"""

import re
import warnings
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from udrl.config import Config, change
from udrl.digests import episode_digest, replay_digest
from udrl.environments.making import EnvironmentSpec
from udrl.episode import Episode, fault
from udrl.errors import ConfigError
from udrl.spaces import Space


def _minari() -> Any:
    try:
        import minari
    except ModuleNotFoundError as error:
        raise ConfigError(
            f'datasets need {error.name}; install it with: pip install "udrl[minari]"'
        ) from error
    return minari


def read_dataset(name: str, config: Config, spec: EnvironmentSpec) -> list[Episode]:
    """Return a dataset's episodes, numbered as those of a warm-up.

    Args:
        name: of a dataset that Minari finds on this machine.
        config: ``max_train_steps``.
        spec: what the run's environment looks like.

    Raises:
        ConfigError: there is no such dataset, it is empty, or its episodes are none of this
            environment.
    """
    minari = _minari()
    try:
        dataset = minari.load_dataset(name)
        episodes = [_episode(i, data, name, spec) for i, data in enumerate(dataset)]
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(
            f"dataset {name!r}: {error}; name one that `minari list local` shows"
        ) from error
    if not episodes:
        raise ConfigError(f"dataset {name!r} has no episodes; there is nothing to begin with")
    longest = max(e.length for e in episodes)
    limit = min(spec.max_episode_steps, config.max_train_steps or spec.max_episode_steps)
    if longest > limit:
        raise ConfigError(
            f"dataset {name!r} has an episode of {longest} steps, training episodes have at most "
            f"{limit}; raise max_train_steps or max_episode_steps"
        )
    return episodes


def settle_dataset(config: Config, spec: EnvironmentSpec) -> tuple[Config, list[Episode] | None]:
    """Return the settings of a new run with what its dataset decides, and the dataset's episodes.

    Raises:
        ConfigError: the dataset cannot be used, or is another one than the settings say.
    """
    name, known = config.commands.dataset, config.commands.dataset_sha256
    if name is None:
        return config, None
    episodes = read_dataset(name, config, spec)
    digest = dataset_digest(episodes)
    if known not in ("", digest):
        raise ConfigError(
            f"dataset {name!r} has the digest {digest}, the settings name {known}; it is another "
            f"one than the run began with"
        )
    return change(config, dataset_sha256=digest, n_warm_up_episodes=len(episodes)), episodes


def _episode(number: int, data: Any, name: str, spec: EnvironmentSpec) -> Episode:
    if not (isinstance(data.observations, np.ndarray) and isinstance(data.actions, np.ndarray)):
        raise ConfigError(
            f"dataset {name!r} has observations or actions of several parts; supported are those "
            f"that are one array"
        )
    rewards = np.asarray(data.rewards, np.float32)
    terminated = bool(data.terminations[-1])
    episode = Episode(
        command_id=number,
        observations=_as(spec.observation_space, data.observations[: len(rewards)]),
        actions=_as(spec.action_space, data.actions),
        rewards=rewards,
        terminated=terminated,
        truncated=not terminated,
    )
    if found := fault(episode, spec):
        raise ConfigError(
            f"dataset {name!r}, episode {number}: {found}; name a dataset of the run's environment"
        )
    return episode


def _as(space: Space, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return values in the dtype of a space, if none changes by more than rounding."""
    if values.dtype.kind not in "biuf":
        return values
    converted = values.astype(space.dtype)
    whole = values.dtype.kind in "iu" and bool((converted == values).all())
    return converted if whole or space.dtype.kind == "f" else values


def dataset_digest(episodes: Sequence[Episode]) -> str:
    """Return the SHA-256 of a dataset's episodes, in hexadecimal."""
    return replay_digest(map(episode_digest, episodes)).hex()


def write_dataset(
    name: str, episodes: Iterable[Episode], config: Config, spec: EnvironmentSpec
) -> None:
    """Write episodes as a Minari dataset, every bit of them.

    Args:
        name: of the dataset, as Minari has them, e.g. ``LunarLander/udrl-v0``.
        episodes: of the environment.
        config: the settings that they were made with.
        spec: what the environment looks like.

    Raises:
        ConfigError: the name is taken or impossible, or it cannot be written.
    """
    if not re.fullmatch(r"(?:\w[\w-]*/)*\w[\w-]*-v\d+", name, re.ASCII):
        raise ConfigError(
            f"dataset {name!r}: expected a name with a version, of letters, digits, _ and -, e.g. "
            f"{config.environment.split('-')[0].split(':')[-1]}/mine-v0"
        )
    minari = _minari()
    from minari.data_collector import EpisodeBuffer

    buffers = [
        EpisodeBuffer(
            id=number,
            observations=list(np.concatenate([e.observations, e.observations[-1:]])),
            actions=list(e.actions.astype(np.int64)),
            rewards=list(e.rewards),
            terminations=[False] * (e.length - 1) + [e.terminated],
            truncations=[False] * (e.length - 1) + [e.truncated],
        )
        for number, e in enumerate(episodes)
    ]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of what only its author can tell
            minari.create_dataset_from_buffers(
                name,
                buffers,
                observation_space=spec.observation_space.gymnasium,
                action_space=spec.action_space.gymnasium,
                algorithm_name="Upside-Down Reinforcement Learning",
                description=f"Episodes of a udrl run on {config.environment}, seed {config.seed}; "
                f"the last observation of each is there twice.",
                jpeg_encoding=False,  # which would change the images
            )
    except (OSError, ValueError, AssertionError) as error:
        raise ConfigError(
            f"dataset {name!r}: {error}; choose another name, or a version that is not there yet"
        ) from error
