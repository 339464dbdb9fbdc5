"""Step limits of episodes, in actions of the agent."""

import sys
from numbers import Integral
from typing import Any

import gymnasium as gym

from udrl.config import Config
from udrl.errors import UnsupportedEnvironment

#: Maximum step limit.
MAX_STEP_LIMIT = 2**31

#: Attribute of wrappers that repeat actions, such as Gymnasium's ``RepeatAction``.
_REPEATS = "num_repeats"
#: Attribute of Gymnasium's ``TimeLimit``.
_LIMIT = "_max_episode_steps"


def step_limit(env: gym.Env[Any, Any], config: Config) -> int | None:
    """Return the step limit of an environment's episodes, in actions; None if it has none."""
    if env.spec is None or env.spec.max_episode_steps is None:
        return None
    if config.max_episode_steps is not None:
        return config.max_episode_steps
    return max(1, env.spec.max_episode_steps // _steps_per_action(env))


def limit_steps(env: gym.Env[Any, Any], max_steps: int) -> None:
    """Set the step limit of the environment's next episodes, in actions.

    This changes Gymnasium's ``TimeLimit`` wrapper instead of counting steps outside, because the
    wrappers outside it must see the truncation (:class:`~udrl.environments.sparse.RewardAtEnd`).

    Raises:
        UnsupportedEnvironment: it has no ``TimeLimit``.
    """
    steps = max_steps * _steps_per_action(env)
    if not env.set_wrapper_attr(_LIMIT, steps, force=False):
        raise UnsupportedEnvironment(
            f"environment {env} has no gymnasium.wrappers.TimeLimit to set to {max_steps} steps; "
            f"make it with make_environment"
        )


def most_actions(env: gym.Env[Any, Any]) -> int:
    """Return after how many actions Gymnasium's ``TimeLimit`` ends an episode at the latest."""
    if not env.has_wrapper_attr(_LIMIT):
        return sys.maxsize
    return -(-int(env.get_wrapper_attr(_LIMIT)) // _steps_per_action(env))


def _steps_per_action(env: gym.Env[Any, Any]) -> int:
    """Return how many steps of Gymnasium's ``TimeLimit`` an action takes."""
    steps = 1
    while isinstance(env, gym.Wrapper) and _LIMIT not in vars(env):
        repeats = vars(env).get(_REPEATS)
        if isinstance(repeats, Integral):
            steps *= max(1, int(repeats))
        env = env.env
    return steps
