"""Making an environment from a run's settings, and saying what it looks like to the algorithm.

However an environment presents itself, the algorithm sees observations of the kinds in
:mod:`udrl.spaces` and actions of those in :mod:`udrl.actions`: an image's channels are moved to the
front, a ``Discrete`` space with an offset is shifted to 0. Everything else is refused, with what is
supported.
"""

from typing import Annotated, Any

import gymnasium as gym
import msgspec
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from msgspec import Meta

from udrl.actions import ActionSpace, Categorical
from udrl.config import Config
from udrl.errors import UnsupportedEnvironment
from udrl.spaces import MOST_CATEGORIES, ObservationSpace, observation_space

Environment = gym.Env[Any, Any]

_EXTRAS = {"Box2D": "box2d", "pygame": "box2d", "matplotlib": "plot", "vizdoom": "doom"}


class EnvironmentSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the algorithm knows of an environment.

    Attributes:
        observation_space: what it shows.
        action_space: what can be done.
        max_episode_steps: steps after which an episode is truncated.
        max_return: the greatest return possible, if declared (caps evaluation commands, 2.3.2).
    """

    observation_space: ObservationSpace
    action_space: ActionSpace
    max_episode_steps: Annotated[int, Meta(ge=1, le=2**31)]
    max_return: float | None = None

    @property
    def step_bytes(self) -> int:
        """Bytes of one observation, action and reward, as they are sent and stored."""
        return self.observation_space.n_bytes + self.action_space.n_bytes + 4


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
    return _with_plain_actions(_with_plain_observations(env, name), name)


def _remedy(error: Exception) -> str:
    for package, extra in _EXTRAS.items():
        if package.lower() in str(error).lower():
            return f'install it with: pip install "udrl[{extra}]"'
    return "install the package that provides it"


def _with_plain_observations(env: Environment, name: str) -> Environment:
    space = env.observation_space
    if isinstance(space, spaces.Discrete):
        if space.n > MOST_CATEGORIES:
            env.close()
            raise UnsupportedEnvironment(
                f"environment {name!r} has {space.n:,} states, and the network would learn a "
                f"vector for each; at most {MOST_CATEGORIES:,} are supported; wrap it, so that it "
                f"shows numbers that describe a state"
            )
        return env if space.start == 0 else _with_indices_from_0(env, space)
    if isinstance(space, spaces.Box) and min(space.shape, default=0) > 0:
        if len(space.shape) == 1:
            return env
        if len(space.shape) in (2, 3) and space.dtype == np.uint8:
            return _with_channels_first(env, space)
    env.close()
    raise UnsupportedEnvironment(
        f"environment {name!r} has observations {space}; supported are Box vectors (one "
        f"dimension), Box images of uint8 (two or three dimensions) and Discrete; wrap it, e.g. "
        f"in gymnasium.wrappers.FlattenObservation"
    )


def _with_indices_from_0(env: Environment, space: "spaces.Discrete[Any]") -> Environment:
    start = int(space.start)
    return gym.wrappers.TransformObservation(
        env, lambda observation: observation - start, spaces.Discrete(int(space.n))
    )


def _with_channels_first(env: Environment, space: spaces.Box) -> Environment:
    """Return an environment of images as [channels, height, width].

    Which dimension holds the channels, nobody declares; as everywhere, it is the smallest.
    """
    shape = space.shape
    if len(shape) == 3 and shape[0] <= min(shape):
        return env

    def move(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        return image[None] if image.ndim == 2 else np.moveaxis(image, -1, 0)

    channels = 1 if len(shape) == 2 else shape[-1]
    moved = spaces.Box(0, 255, (channels, *shape[:2]), np.uint8)
    return gym.wrappers.TransformObservation(env, move, moved)


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
    assert isinstance(env.action_space, spaces.Discrete)
    assert env.spec is not None
    assert env.spec.max_episode_steps is not None
    declared = getattr(env.unwrapped, "max_return", env.metadata.get("max_return"))
    max_return = config.max_return if config.max_return is not None else declared
    return EnvironmentSpec(
        observation_space=observation_space(env.observation_space),
        action_space=Categorical(n=int(env.action_space.n)),
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
