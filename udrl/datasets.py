"""Minari datasets: episodes for the warm-up, and export of a run's episodes.

In a run with a ``dataset``, its episodes replace the warm-up (section 2.3.1). An episode of a
dataset ends with an observation after the last step. Episodes of this project do not have it, so
exports contain the last observation twice.
"""

import logging
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from shutil import rmtree
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from udrl.config import Config, change
from udrl.digests import episode_digest, replay_digest
from udrl.environments import previous, time_left
from udrl.environments.action_conversions import action_conversion
from udrl.environments.conversions import Conversion, leaves_within, with_keys_ordered
from udrl.environments.making import make_environment
from udrl.environments.masking import MASK, OBSERVATION
from udrl.environments.observation_conversions import observation_conversion
from udrl.environments.specification import EnvironmentSpec
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
        name: name of a dataset that Minari finds on this machine.
        config: the run's settings.
        spec: specification of the run's environment.

    Raises:
        ConfigError: there is no such dataset, it is empty, or its episodes do not fit the
            environment or its step limit.
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
        raise ConfigError(f"dataset {name!r} has no episodes, expected at least 1; name another")
    return episodes


def resolve_dataset(config: Config, spec: EnvironmentSpec) -> tuple[Config, list[Episode] | None]:
    """Return the settings of a new run, completed from its dataset, and the dataset's episodes.

    Raises:
        ConfigError: the dataset cannot be used, or its digest differs from ``dataset_sha256``.
    """
    name, known = config.commands.dataset, config.commands.dataset_sha256
    if name is None:
        return config, None
    episodes = read_dataset(name, config, spec)
    digest = dataset_digest(episodes)
    if known not in ("", digest):
        raise ConfigError(
            f"dataset {name!r} has the digest {digest}, expected {known}; restore the dataset that "
            f"the run started with"
        )
    return change(config, dataset_sha256=digest, n_warm_up_episodes=len(episodes)), episodes


class _Reader:
    """Converts a dataset's episodes, like those of an environment.

    If the dataset lacks what ``observe_time`` and ``observe_previous`` add, it is added here.
    """

    def __init__(self, name: str, dataset: Any, config: Config, spec: EnvironmentSpec) -> None:
        self._name = name
        self._spec = spec
        longest = spec.max_episode_steps
        self._max_steps = min(longest, config.max_train_steps or longest)
        self._adds_time = self._adds_previous = False
        observation_space, action_space = dataset.observation_space, dataset.action_space
        seen, taken = observation_space, action_space
        if any(path for space in (seen, taken) for path, _ in leaves_within(space)):
            # Minari sorts the keys of dictionaries; the environment's order counts.
            with closing(make_environment(config)) as env:
                seen, taken = env.observations.declared, env.actions.declared
        action_space = with_keys_ordered(action_space, taken)
        observation_space = with_keys_ordered(observation_space, seen)
        try:
            actions = action_conversion(action_space, config.actions)
            observations = observation_conversion(observation_space)
            if observations.plain != spec.observation_space:
                self._adds_time = config.observe_time
                self._adds_previous = config.observe_previous
                shown = observation_space
                if self._adds_time:
                    shown = time_left.space_with_time_left(shown)
                if self._adds_previous:
                    shown = previous.space_with_previous(shown, action_space)
                observations = observation_conversion(with_keys_ordered(shown, seen))
        except UnsupportedEnvironment as error:
            raise ConfigError(
                f"dataset {name!r}: {error}; name a dataset of the run's environment"
            ) from error
        if (observations.plain, actions.plain) != (spec.observation_space, spec.action_space):
            raise ConfigError(
                f"dataset {name!r} has observations {observation_space} and actions "
                f"{action_space}, the run's environment has {spec.observation_space} and "
                f"{spec.action_space}; {_remedy(observation_space, config)}"
            )
        self._observations, self._actions = observations, actions

    def _shown(self, data: Any) -> Any:
        """Return the observations of a dataset's episode as those of the run's environment."""
        shown, n = data.observations, len(data.rewards) + 1
        if self._adds_time:
            shown = time_left.add_time_left(shown, n, self._spec.max_episode_steps)
        if self._adds_previous:
            action_space = self._actions.declared
            shown = previous.add_previous(action_space, shown, data.actions, data.rewards)
        return shown

    def episode(self, number: int, data: Any) -> Episode:
        rewards = np.asarray(data.rewards, np.float32)
        n = len(rewards)
        if not 1 <= n <= self._max_steps:
            raise ConfigError(
                f"dataset {self._name!r}, episode {number}: it has {n:,} steps, expected 1 to "
                f"{self._max_steps:,}; leave it out, or raise max_train_steps or max_episode_steps"
            )
        terminated = bool(data.terminations[-1])
        try:
            episode = Episode(
                command_id=number,
                # Without the observation after the last step.
                observations=self._observations.convert(self._shown(data), (n + 1,))[:-1],
                actions=self._actions.convert(data.actions, (n,)),
                rewards=rewards,
                terminated=terminated,
                truncated=bool(data.truncations[-1]) or not terminated,
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


def _remedy(space: spaces.Space[Any], config: Config) -> str:
    """Return the remedy for a dataset whose observations are not those of the environment."""
    found = []
    while isinstance(space, spaces.Dict) and OBSERVATION in space.spaces:
        if previous.HAS_PREVIOUS in space.spaces and not config.observe_previous:
            found.append("observe_previous = true")
        if time_left.TIME_LEFT in space.spaces and not config.observe_time:
            found.append("observe_time = true")
        if MASK in space.spaces and config.actions.action_mask is None:
            found.append("action_mask = info")
        space = space[OBSERVATION]
    if not found:
        return "name a dataset of the run's environment"
    return f"set {', '.join(found)}, as in the run that exported it"


def dataset_digest(episodes: Sequence[Episode]) -> str:
    """Return the SHA-256 digest of a dataset's episodes, in hexadecimal."""
    return replay_digest(map(episode_digest, episodes)).hex()


def write_dataset(
    name: str, episodes: Iterable[Episode], config: Config, spec: EnvironmentSpec
) -> None:
    """Write episodes to a Minari dataset without loss, in the environment's own spaces.

    If the environment cannot be created, they are written in the algorithm's spaces, and the
    dataset does not name its environment.

    Args:
        name: name of the dataset, in Minari's form, e.g. ``LunarLander/udrl-v0``.
        episodes: the episodes.
        config: settings of their run.
        spec: specification of the environment.

    Raises:
        ConfigError: the name exists or is invalid, or the dataset cannot be written.
    """
    if not re.fullmatch(r"(?:\w[\w-]*/)*\w[\w-]*-v\d+", name, re.ASCII):
        raise ConfigError(
            f"dataset {name!r}: expected a name with a version, of letters, digits, _ and -, e.g. "
            f"{config.environment.split('-')[0].split(':')[-1]}/mine-v0"
        )
    minari = _minari()
    from minari.data_collector import EpisodeBuffer
    from minari.storage import get_dataset_path

    form = _form(config, spec)
    for conversion in (form.observations, form.actions):
        _check_keys(name, conversion.declared)
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
        with _removed_on_failure(get_dataset_path(name)), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about missing metadata, e.g. the author
            minari.create_dataset_from_buffers(
                name,
                buffers,
                env=form.env,
                observation_space=form.observations.declared,
                action_space=form.actions.declared,
                algorithm_name="Upside-Down Reinforcement Learning",
                description=f"Episodes of a udrl run on {config.environment}, seed {config.seed}; "
                f"the last observation of each is repeated.",
                jpeg_encoding=False,  # which would change the images
            )
    except (OSError, ValueError, AssertionError) as error:
        raise ConfigError(
            f"dataset {name!r}: {error}; choose another name, or a new version"
        ) from error


@contextmanager
def _removed_on_failure(folder: Path) -> Iterator[None]:
    """Remove a new folder if the block raises: an incomplete dataset would occupy the name."""
    is_new = not folder.exists()
    try:
        yield
    except BaseException:
        if is_new:
            rmtree(folder, ignore_errors=True)
        raise


def _check_keys(name: str, space: spaces.Space[Any]) -> None:
    """Raise :class:`ConfigError` for keys that HDF5 cannot store; it reads them as paths."""
    inner: Iterable[spaces.Space[Any]] = ()
    if isinstance(space, spaces.Dict):
        keys: Iterable[Any] = space.spaces  # not always strings
        for key in keys:
            if not isinstance(key, str) or key in ("", ".") or "/" in key:
                raise ConfigError(
                    f"dataset {name!r}: its files cannot store the key {key!r} of {space}; "
                    f"expected a string without /; rename it in the environment"
                )
        inner = space.spaces.values()
    elif isinstance(space, spaces.Tuple):
        inner = space.spaces
    for one in inner:
        _check_keys(name, one)


def _lists(arrays: Any) -> Any:
    """Return arrays, possibly in dictionaries and tuples, as lists of their rows."""
    if isinstance(arrays, dict):
        return {key: _lists(inner) for key, inner in arrays.items()}
    return tuple(map(_lists, arrays)) if isinstance(arrays, tuple) else list(arrays)


class _Form(NamedTuple):
    """Conversions of exported episodes, and their environment, if it can be named."""

    observations: Conversion
    actions: Conversion
    env: EnvSpec | None


def _form(config: Config, spec: EnvironmentSpec) -> _Form:
    """Return the environment's own spaces if it can be created, else the algorithm's."""
    try:
        env = make_environment(config)
    except UnsupportedEnvironment as error:
        log.warning("the dataset will not name its environment: %s", error)
    else:
        named, observations, actions = env.env.spec, env.observations, env.actions
        env.close()
        if (observations.plain, actions.plain) == (spec.observation_space, spec.action_space):
            return _Form(observations, actions, named if _is_serialisable(named) else None)
    return _Form(
        observation_conversion(spec.observation_space.gymnasium),
        action_conversion(spec.action_space.gymnasium, config.actions),
        None,
    )


def _is_serialisable(spec: EnvSpec | None) -> bool:
    """Return whether Gymnasium can serialise a specification: not if it contains a callable."""
    try:
        return spec is not None and bool(spec.to_json())
    except (ValueError, TypeError) as error:
        log.warning("the dataset will not name its environment: %s", error)
        return False
