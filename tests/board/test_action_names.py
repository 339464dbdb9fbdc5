"""Names of actions: of known environments, declared ones, and those of every kind of space."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from kinds_of_spaces import STEPS
from udrl.environments.making import adapt
from udrl.setting_groups import ActionSettings
from udrl_board.action_names import action_components


class Acting(gym.Env[Any, Any]):
    """An environment with any action space."""

    def __init__(self, space: spaces.Space[Any]) -> None:
        self.observation_space = spaces.Box(-1, 1, (2,), np.float32)
        self.action_space = space


def names(env: gym.Env[Any, Any], **settings: Any) -> list[tuple[str, list[str]]]:
    if env.spec is None:
        env.spec = gym.envs.registration.EnvSpec("Acting-v0", max_episode_steps=STEPS)
    found = action_components(adapt(env, "Acting-v0", ActionSettings(**settings)))
    return [(one.name, one.values) for one in found]


@pytest.mark.parametrize(
    ("environment", "first", "n"),
    [("LunarLander-v3", "no engine", 4), ("CartPole-v1", "push left", 2),
     ("FrozenLake-v1", "left", 4), ("Taxi-v4", "south", 6), ("Acrobot-v1", "torque -1", 3),
     ("MountainCar-v0", "push left", 3), ("CliffWalking-v1", "up", 4),
     ("Blackjack-v1", "stick", 2)],
)  # fmt: skip
def test_known_environments(environment: str, first: str, n: int) -> None:
    env: gym.Env[Any, Any] = gym.make(environment, disable_env_checker=True)
    if env.spec is not None and env.spec.max_episode_steps is None:
        env = gym.wrappers.TimeLimit(env, 10)
    ((name, values),) = names(env)
    assert (name, values[0], len(values)) == ("", first, n)
    env.close()


def test_actions_without_names_are_numbered() -> None:
    assert names(Acting(spaces.Discrete(3, start=5))) == [("", ["5", "6", "7"])]


def test_declared_names_are_used() -> None:
    env = Acting(spaces.Discrete(2))
    env.metadata = {"action_names": ["Stay", "Go"]}
    assert names(env) == [("", ["stay", "go"])]
    env.metadata = {"action_names": ["too", "many", "names"]}
    assert names(env) == [("", ["0", "1"])]
    env.metadata = {}
    env.get_action_meanings = lambda: ["NOOP", "FIRE_LEFT"]  # type: ignore[attr-defined]
    assert names(env) == [("", ["noop", "fire left"])]
    env.get_action_meanings = lambda: 1 / 0  # type: ignore[attr-defined]
    assert names(env) == [("", ["0", "1"])]


def test_several_components() -> None:
    assert names(Acting(spaces.MultiDiscrete([2, 3]))) == [
        ("component 0", ["0", "1"]), ("component 1", ["0", "1", "2"]),
    ]  # fmt: skip
    assert names(Acting(spaces.MultiBinary(2)))[1] == ("component 1", ["off", "on"])


def test_bins_are_named_by_their_values() -> None:
    assert names(Acting(spaces.Box(-2, 2, (1,), np.float32)), action_bins=5) == [
        ("", ["-2", "-1", "0", "1", "2"])
    ]
    two = spaces.Box(np.array([0, -1]), np.array([1, 1]), dtype=np.float64)
    assert names(Acting(two), action_bins=3) == [
        ("component 0", ["0", "0.5", "1"]), ("component 1", ["-1", "0", "1"]),
    ]  # fmt: skip


def test_leaves_of_dictionaries_and_tuples() -> None:
    space = spaces.Dict(
        door=spaces.Discrete(2, start=1),
        legs=spaces.Tuple((spaces.Box(0, 4, (2,), np.int64), spaces.MultiBinary(1))),
    )
    assert names(Acting(space), action_bins=3) == [
        ("door", ["1", "2"]),
        ("legs.0[0]", ["0", "2", "4"]), ("legs.0[1]", ["0", "2", "4"]),
        ("legs.1", ["off", "on"]),
    ]  # fmt: skip
