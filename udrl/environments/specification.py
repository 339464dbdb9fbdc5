"""Specification of an environment: what the algorithm must know about it."""

import math
from typing import Annotated

import msgspec
from msgspec import Meta

from udrl.actions import ActionSpace
from udrl.config import Config
from udrl.environments.adapter import Environment
from udrl.environments.conversions import describe
from udrl.environments.masking import MASK, below_observation
from udrl.environments.step_limits import MAX_STEP_LIMIT, step_limit
from udrl.errors import UnsupportedEnvironment
from udrl.spaces import MAX_LEAVES, Bits, ObservationSpace, Vector, leaves_of


class EnvironmentSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Specification of an environment.

    Attributes:
        observation_space: space of single observations.
        action_space: space of actions.
        max_episode_steps: step limit of episodes in steps.
        max_return: the highest possible return, if declared; caps evaluation commands (2.3.2).
        action_mask: number of the observation's leaf with the action mask: 1 for allowed actions,
            otherwise 0, for each of the ``n_parameters``. None: all actions are allowed.
    """

    observation_space: ObservationSpace
    action_space: ActionSpace
    max_episode_steps: Annotated[int, Meta(ge=1, le=MAX_STEP_LIMIT)]
    max_return: float | None = None
    action_mask: Annotated[int, Meta(ge=0, le=MAX_LEAVES - 1)] | None = None

    @property
    def step_bytes(self) -> int:
        """Bytes of one observation, action and reward, as sent and stored."""
        return self.observation_space.n_bytes + self.action_space.n_bytes + 4


def specify(env: Environment, config: Config) -> EnvironmentSpec:
    """Return the specification of an environment.

    Args:
        env: an environment from :func:`~udrl.environments.making.make_environment`.
        config: the settings with which it was made.

    Raises:
        UnsupportedEnvironment: it declares an invalid ``max_return``, or has no such action mask.
    """
    longest = step_limit(env, config)
    assert longest is not None
    space, actions = (env.get_wrapper_attr(name).plain for name in ("observations", "actions"))
    return EnvironmentSpec(
        observation_space=space,
        action_space=actions,
        action_mask=_mask(config, space, actions),
        max_episode_steps=longest,
        max_return=_max_return(env, config),
    )


def _max_return(env: Environment, config: Config) -> float | None:
    """Return the highest possible return: the setting, or what the environment declares."""
    if config.max_return is not None:
        return config.max_return
    declared = getattr(env.unwrapped, "max_return", env.metadata.get("max_return"))
    if declared is None:
        return None
    try:
        number = math.nan if isinstance(declared, str | bytes) else float(declared)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise UnsupportedEnvironment(
            f"environment {config.environment!r} declares max_return = {describe(declared)}, "
            f"expected a finite number, or no declaration if there is no highest return; correct "
            f"it in the environment or its metadata, or override it, e.g. --set max_return=500"
        )
    return number


def _mask(config: Config, space: ObservationSpace, actions: ActionSpace) -> int | None:
    """Return the number of the leaf with the action mask."""
    name = config.actions.action_mask
    if name is None:
        return None
    leaves = [leaf.path for leaf in leaves_of(space)]
    keys = [below_observation(path) for path in leaves]
    if name == "info":  # the outermost wrapper has added it; another entry may have its name
        found = [k for k, path in enumerate(leaves) if path == (MASK,)]
    else:
        found = [k for k, key in enumerate(keys) if key == (name,)]
    if not found:
        entries = ", ".join(repr(k[0]) for k in keys if len(k) == 1 and isinstance(k[0], str))
        raise UnsupportedEnvironment(
            f"action_mask = {name!r}: environment {config.environment!r} has no such entry; "
            f"expected 'info'{f', or one of {entries}' if entries else ''}"
        )
    leaf = leaves_of(space)[found[0]].space
    if not isinstance(leaf, Bits | Vector) or leaf.size != actions.n_parameters:
        raise UnsupportedEnvironment(
            f"action_mask = {name!r}: it is {leaf}, expected {actions.n_parameters} numbers, 0 or "
            f"1, one for each output of {actions}"
        )
    return found[0]
