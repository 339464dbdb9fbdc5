"""Makes environments from a run's settings.

All environments are adapted to the observation spaces of :mod:`udrl.spaces` and the action spaces
of :mod:`udrl.actions`. Errors for unsupported spaces list the supported ones.
"""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import find_highest_version, get_env_id, parse_env_id

from udrl.config import Config
from udrl.environments.action_conversions import action_conversion
from udrl.environments.adapter import Adapter, Environment, close
from udrl.environments.creation_remedies import remedy, sentence
from udrl.environments.masking import CheckMask, ObserveMask
from udrl.environments.observation_conversions import observation_conversion
from udrl.environments.previous import ObservePrevious
from udrl.environments.step_limits import MAX_STEP_LIMIT, limit_steps, step_limit
from udrl.environments.time_left import ObserveTime
from udrl.environments.wrapping import wrapped
from udrl.errors import UnsupportedEnvironment
from udrl.setting_groups import ActionSettings

#: Environment variable with an environment's index while it is made, which is unique among the
#: environments of a run on one machine.
INDEX = "UDRL_ENVIRONMENT_INDEX"

_making = threading.RLock()


@contextmanager
def indexed(number: int) -> Iterator[None]:
    """Set :data:`INDEX` while an environment is made, which may need it, e.g. to choose a port."""
    with _making:
        before = os.environ.get(INDEX)
        os.environ[INDEX] = str(number)
        try:
            yield
        finally:
            if before is None:
                del os.environ[INDEX]
            else:
                os.environ[INDEX] = before


def make_environment(config: Config) -> Adapter:
    """Return the environment of a run, adapted to the algorithm's spaces.

    Raises:
        UnsupportedEnvironment: it does not exist, cannot be created, has no step limit, or has
            unsupported spaces. The message lists all problems with limit and spaces.
    """
    name = config.environment
    try:
        env = _created(config)
    except UnsupportedEnvironment:
        raise
    except (Exception, SystemExit) as error:
        raise UnsupportedEnvironment(
            f"environment {name!r} cannot be created: {type(error).__name__}: {sentence(error)}; "
            f"{remedy(error, config)}"
        ) from error
    try:
        _check_spaces(env, name)
        for wrapper in config.wrappers:
            env = wrapped(env, wrapper)
        longest = step_limit(env, config)
        if longest is not None:
            limit_steps(env, longest)
            if config.observe_time:
                env = ObserveTime(env, longest)
        if config.observe_previous:
            env = ObservePrevious(env)
        return adapt(env, name, config.actions)
    except Exception:
        close(env)
        raise


def _created(config: Config) -> Environment:
    """Return the environment as Gymnasium makes it."""
    module, _, _ = config.environment.rpartition(":")
    if module:
        import_module(module)  # registers its environments
    _check_version(config.environment)
    # Passed only if it is set: None would mean "no limit" to Gymnasium.
    limit: dict[str, Any] = {}
    if config.max_episode_steps is not None:
        limit["max_episode_steps"] = config.max_episode_steps
    with indexed(int(os.environ.get(INDEX, "0"))):
        env: Environment = gym.make(
            config.environment, disable_env_checker=True, **(limit | config.environment_kwargs)
        )
    return env


def _check_version(name: str) -> None:
    """Require the version of a registered environment."""
    module, colon, base = name.rpartition(":")
    try:
        namespace, family, version = parse_env_id(base)
    except gym.error.Error:
        return
    latest = find_highest_version(namespace, family)
    if base not in gym.registry and version is None and latest is not None:
        versioned = module + colon + get_env_id(namespace, family, latest)
        raise UnsupportedEnvironment(
            f"environment {name!r} has no version, and the latest one depends on what is "
            f"installed; did you mean {versioned!r}?"
        )


def _check_spaces(env: Environment, name: str) -> None:
    for space in ("observation_space", "action_space"):
        if not isinstance(getattr(env, space, None), gym.Space):
            raise UnsupportedEnvironment(
                f"environment {name!r} has no {space}; set self.{space} to a space of "
                f"gymnasium.spaces when it is created"
            )


def adapt(env: Environment, name: str, settings: ActionSettings) -> Adapter:
    """Return an environment adapted to the algorithm's spaces, which checks all values.

    Args:
        env: an environment with a step limit.
        name: its name in messages.
        settings: settings of its action space.

    Raises:
        UnsupportedEnvironment: it has no step limit, or unsupported spaces. The message lists all
            problems.
    """
    observations = actions = None
    problems = []
    try:
        actions = action_conversion(env.action_space, settings)
    except UnsupportedEnvironment as error:
        problems.append(str(error))
    if actions is not None and settings.action_mask is not None:
        env = _with_checked_mask(env, settings.action_mask, actions.plain.components)
    try:
        observations = observation_conversion(env.observation_space)
    except UnsupportedEnvironment as error:
        problems.insert(0, str(error))
    if env.spec is None or env.spec.max_episode_steps is None:
        problems.append(
            "it has no step limit, so an episode might never end; set one, e.g. "
            "--set max_episode_steps=1000"
        )
    elif env.spec.max_episode_steps > MAX_STEP_LIMIT:
        problems.append(
            f"its step limit is {env.spec.max_episode_steps:,}, at most {MAX_STEP_LIMIT:,} is "
            f"supported; set a lower one, e.g. --set max_episode_steps=1000"
        )
    if observations is None or actions is None or problems:
        raise UnsupportedEnvironment(f"environment {name!r}: {'; also, '.join(problems)}")
    return Adapter(env, observations, actions)


def _with_checked_mask(
    env: Environment, action_mask: str, components: tuple[int, ...]
) -> Environment:
    if action_mask == "info":
        return ObserveMask(env, components)
    return CheckMask(env, action_mask, components)
