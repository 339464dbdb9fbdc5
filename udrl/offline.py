"""Episodes of others: Minari datasets, to learn from and to hand on.

A run that names a ``dataset`` begins with its episodes where others begin with random ones: they
are its warm-up (section 2.3.1). A dataset has one observation more than steps, on the last of which
nobody acted. Episodes here have none, so in what is written the last one is there twice.
"""

import logging
import re
import warnings
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium.envs.registration import EnvSpec

from udrl.config import Config, change
from udrl.digests import episode_digest, replay_digest
from udrl.environments import previous, time_left
from udrl.environments.action_conversions import action_conversion
from udrl.environments.conversions import Conversion, observation_conversion
from udrl.environments.making import EnvironmentSpec, make_environment
from udrl.episode import Episode, fault
from udrl.errors import ConfigError, InvalidData, UnsupportedEnvironment

log = logging.getLogger("udrl")


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
        reader = _Reader(name, dataset, config, spec)
        episodes = [reader.episode(i, data) for i, data in enumerate(dataset)]
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


class _Reader:
    """Makes episodes of a dataset's, whose spaces become plain as an environment's do.

    What the run's environment shows besides is added, if it follows from what the dataset has.
    """

    def __init__(self, name: str, dataset: Any, config: Config, spec: EnvironmentSpec) -> None:
        self._name = name
        self._spec = spec
        self._adds_time = self._adds_previous = False
        seen, done = dataset.observation_space, dataset.action_space
        try:
            actions = action_conversion(done, config.actions)
            observations = observation_conversion(seen)
            if observations.plain != spec.observation_space:
                self._adds_time = config.observe_time
                self._adds_previous = config.observe_previous
                shown = time_left.observation_space(seen) if self._adds_time else seen
                if self._adds_previous:
                    shown = previous.observation_space(shown, done)
                observations = observation_conversion(shown)
        except UnsupportedEnvironment as error:
            raise ConfigError(
                f"dataset {name!r}: {error}; name a dataset of the run's environment"
            ) from error
        if (observations.plain, actions.plain) != (spec.observation_space, spec.action_space):
            raise ConfigError(
                f"dataset {name!r} has observations {seen} and actions {done}, the run's "
                f"environment has {spec.observation_space} and {spec.action_space}; name a "
                f"dataset of the run's environment"
            )
        self._observations, self._actions = observations, actions

    def _shown(self, data: Any) -> Any:
        """Return the observations of a dataset's episode as those of the run's environment."""
        shown, n = data.observations, len(data.rewards) + 1
        if self._adds_time:
            shown = time_left.shown_in_all_steps(shown, n, self._spec.max_episode_steps)
        if self._adds_previous:
            done = self._actions.declared
            shown = previous.shown_in_all_steps(done, shown, data.actions, data.rewards)
        return shown

    def episode(self, number: int, data: Any) -> Episode:
        rewards = np.asarray(data.rewards, np.float32)
        n, terminated = len(rewards), bool(data.terminations[-1])
        try:
            episode = Episode(
                command_id=number,
                # One more than steps: nothing was done after the last.
                observations=self._observations.convert(self._shown(data), (n + 1,))[:-1],
                actions=self._actions.convert(data.actions, (n,)),
                rewards=rewards,
                terminated=terminated,
                truncated=not terminated,
            )
            found = fault(episode, self._spec)
        except InvalidData as error:
            found = str(error)
        if found:
            raise ConfigError(
                f"dataset {self._name!r}, episode {number}: {found}; name a dataset of the run's "
                f"environment"
            )
        return episode


def dataset_digest(episodes: Sequence[Episode]) -> str:
    """Return the SHA-256 of a dataset's episodes, in hexadecimal."""
    return replay_digest(map(episode_digest, episodes)).hex()


def write_dataset(
    name: str, episodes: Iterable[Episode], config: Config, spec: EnvironmentSpec
) -> None:
    """Write episodes as a Minari dataset, every bit of them, as their environment shows them.

    Where the environment cannot be made, they are written as the algorithm sees them, and the
    dataset does not name it.

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

    form = _form(config, spec)
    buffers = [
        EpisodeBuffer(
            id=number,
            observations=_lists(
                form.observations.back(np.concatenate([e.observations, e.observations[-1:]]))
            ),
            actions=_lists(form.actions.back(e.actions)),
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
                env=form.env,
                observation_space=form.observations.declared,
                action_space=form.actions.declared,
                algorithm_name="Upside-Down Reinforcement Learning",
                description=f"Episodes of a udrl run on {config.environment}, seed {config.seed}; "
                f"the last observation of each is there twice.",
                jpeg_encoding=False,  # which would change the images
            )
    except (OSError, ValueError, AssertionError) as error:
        raise ConfigError(
            f"dataset {name!r}: {error}; choose another name, or a version that is not there yet"
        ) from error


def _lists(arrays: Any) -> Any:
    """Return arrays, in whatever dictionaries and tuples, as lists of their rows."""
    if isinstance(arrays, dict):
        return {key: _lists(inner) for key, inner in arrays.items()}
    return tuple(map(_lists, arrays)) if isinstance(arrays, tuple) else list(arrays)


class _Form(NamedTuple):
    """How episodes are written: as what, and of which environment, if one can be named."""

    observations: Conversion
    actions: Conversion
    env: EnvSpec | None


def _form(config: Config, spec: EnvironmentSpec) -> _Form:
    try:
        env = make_environment(config)
    except UnsupportedEnvironment as error:
        log.warning("the dataset will not name its environment: %s", error)
    else:
        named, observations, actions = env.env.spec, env.observations, env.actions
        env.close()
        if (observations.plain, actions.plain) == (spec.observation_space, spec.action_space):
            return _Form(observations, actions, named if _can_be_written(named) else None)
    return _Form(
        observation_conversion(spec.observation_space.gymnasium),
        action_conversion(spec.action_space.gymnasium, config.actions),
        None,
    )


def _can_be_written(spec: EnvSpec | None) -> bool:
    """Say whether Gymnasium can write down how an environment is made: not with a callable."""
    try:
        return spec is not None and bool(spec.to_json())
    except (ValueError, TypeError) as error:
        log.warning("the dataset will not name its environment: %s", error)
        return False
