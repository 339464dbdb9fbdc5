"""Making an environment from a run's settings, and saying what it looks like to the algorithm.

However an environment presents itself, the algorithm sees observations that are float32 vectors
and actions 0..n-1: a ``Discrete`` observation becomes one-hot, a ``Discrete`` action space with an
offset is shifted to 0. Everything else is refused, with what is supported.
"""

from typing import Any

import gymnasium as gym
import msgspec
import numpy as np
from gymnasium import spaces

from udrl.config import Config
from udrl.errors import UnsupportedEnvironment

Environment = gym.Env[Any, Any]

_EXTRAS = {"Box2D": "box2d", "pygame": "box2d", "matplotlib": "plot"}


class EnvironmentSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the algorithm knows of an environment.

    Attributes:
        observation_size: length of the float32 observation vector.
        n_actions: actions are 0..n_actions-1.
        max_episode_steps: steps after which an episode is truncated.
        max_return: the greatest return possible, if declared (caps evaluation commands, 2.3.2).
    """

    observation_size: int
    n_actions: int
    max_episode_steps: int
    max_return: float | None = None


def make_environment(config: Config) -> Environment:
    """Return the environment of a run, with observations and actions as the algorithm sees them.

    Raises:
        UnsupportedEnvironment: it does not exist, cannot be made, has no time limit, or has spaces
            that are not supported.
    """
    name = config.environment
    # The limit is handed over only when it is set: None would mean "no limit" to Gymnasium.
    limit: dict[str, Any] = {}
    if config.max_episode_steps is not None:
        limit["max_episode_steps"] = config.max_episode_steps
    try:
        env: Environment = gym.make(
            name, disable_env_checker=True, **(limit | config.environment_kwargs)
        )
    except (gym.error.DependencyNotInstalled, ImportError) as error:
        raise UnsupportedEnvironment(f"environment {name!r}: {error}; {_remedy(error)}") from error
    except Exception as error:
        raise UnsupportedEnvironment(
            f"environment {name!r} cannot be made: {type(error).__name__}: {error}; name an id "
            f"registered with Gymnasium, or an importable one as package.module:Env-v0"
        ) from error
    if env.spec is None or env.spec.max_episode_steps is None:
        env.close()
        raise UnsupportedEnvironment(
            f"environment {name!r} has no step limit, so an episode might never end; "
            f"set max_episode_steps, e.g. --set max_episode_steps=1000"
        )
    return _with_plain_actions(_with_vector_observations(env, name), name)


def _remedy(error: Exception) -> str:
    for package, extra in _EXTRAS.items():
        if package.lower() in str(error).lower():
            return f'install it with: pip install "udrl[{extra}]"'
    return "install the package that provides it"


def _with_vector_observations(env: Environment, name: str) -> Environment:
    space = env.observation_space
    if isinstance(space, spaces.Discrete):
        return gym.wrappers.FlattenObservation(env)
    if isinstance(space, spaces.Box) and len(space.shape) == 1 and space.shape[0] > 0:
        return env
    env.close()
    raise UnsupportedEnvironment(
        f"environment {name!r} has observations {space}; supported are Box vectors "
        f"(one dimension) and Discrete; wrap it, e.g. in gymnasium.wrappers.FlattenObservation"
    )


def _with_plain_actions(env: Environment, name: str) -> Environment:
    space = env.action_space
    if not isinstance(space, spaces.Discrete):
        env.close()
        raise UnsupportedEnvironment(
            f"environment {name!r} has actions {space}; supported is Discrete"
        )
    if space.start == 0:
        return env
    start = int(space.start)
    return gym.wrappers.TransformAction(
        env, lambda action: action + start, spaces.Discrete(int(space.n))
    )


def specify(env: Environment, config: Config) -> EnvironmentSpec:
    """Return the spec of an environment that :func:`make_environment` made."""
    assert isinstance(env.observation_space, spaces.Box)
    assert isinstance(env.action_space, spaces.Discrete)
    assert env.spec is not None
    assert env.spec.max_episode_steps is not None
    declared = getattr(env.unwrapped, "max_return", env.metadata.get("max_return"))
    max_return = config.max_return if config.max_return is not None else declared
    return EnvironmentSpec(
        observation_size=int(np.prod(env.observation_space.shape)),
        n_actions=int(env.action_space.n),
        max_episode_steps=env.spec.max_episode_steps,
        max_return=None if max_return is None else float(max_return),
    )


def limit_steps(env: Environment, max_steps: int) -> None:
    """Set the time limit of the environment's next episodes, in steps.

    The limit that ``gymnasium.make`` put there is moved instead of counting steps outside, because
    what stands outside it (:class:`~udrl.environments.sparse.RewardAtEnd`) must see the cut.
    """
    if not env.set_wrapper_attr("_max_episode_steps", max_steps, force=False):
        raise UnsupportedEnvironment(
            f"environment {env} has no gymnasium.wrappers.TimeLimit to set to {max_steps} steps; "
            f"make it with make_environment"
        )
