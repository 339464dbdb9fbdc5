import math
from typing import Any

import gymnasium as gym
import msgspec
import numpy as np
import pytest

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.commands import Command
from udrl.config import Config, build
from udrl.environments import Environment, make_environment, specify
from udrl.errors import EnvironmentFault, UnsupportedEnvironment
from udrl.graph import acting_graph
from udrl.inference import ActingFunction
from udrl.policy import Policy
from udrl.rollout import Rollout
from udrl.streams import Purpose, stream_key
from udrl.training import untrained


def command(**values: Any) -> Command:
    usual: dict[str, Any] = {
        "id": 7,
        "kind": "evaluate",
        "desired_return": 80.0,
        "desired_horizon": 60,
        "environment_seed": 11,
        "stream_key": stream_key(1, Purpose.EPISODE, 1, 7),
        "weights_version": 1,
        "max_steps": 300,
    }
    return Command(**(usual | values))


def agent(environment: str = "CartPole-v1", **values: Any) -> tuple[Policy, Environment]:
    config = build(Config, {"environment": environment, "hidden": [16, 16]} | values)
    env = make_environment(config)
    spec = specify(env, config)
    return Policy(
        ActingFunction(acting_graph(config.network, spec), untrained(config, spec).weights),
        config,
        spec,
    ), env


@pytest.mark.parametrize(
    ("given", "settings"),
    [
        ({}, {}),
        ({"temperature": 0.0}, {}),
        ({"temperature": 0.4, "cap": 20.0}, {}),
        ({"max_steps": 12}, {"frame_stack": 4}),
        ({"random_from": 5, "random_steps": 4, "random_hold": 4}, {}),
        ({"random_rate": 0.3, "random_hold": 2}, {}),
        ({"random_steps": 1000, "random_hold": 7, "temperature": 0.0}, {}),
        ({"desired_return": 40.7}, {"horizon_equals_return": True}),
        ({"desired_return": 500.0}, {"max_return": 20.0}),
    ],
)
def test_rollout_makes_the_episode_of_its_command(
    given: dict[str, Any], settings: dict[str, Any]
) -> None:
    policy, env = agent(**settings)
    order = command(**given)
    (expected,) = generate_episodes(EpisodeGenerator(policy.config, 3), [order], policy.behavior)
    rollout = Rollout(policy, env, order)
    actions, rewards = [], []
    while not rollout.over:
        rewards.append(rollout.step())
        actions.append(rollout.action)
    assert actions == expected.actions.tolist()
    assert rewards == expected.rewards.tolist()
    assert rollout.episode_return == expected.episode_return
    assert (rollout.terminated, rollout.truncated) == (expected.terminated, expected.truncated)
    assert rollout.steps == expected.length


def test_command_counts_down() -> None:
    policy, env = agent()
    rollout = Rollout(policy, env, command())
    for _ in range(3):
        rollout.step()
    assert (rollout.desired_return, rollout.desired_horizon) == (77.0, 57)


def test_changed_command_applies_to_the_next_action() -> None:
    policy, env = agent()
    rollout = Rollout(policy, env, command())
    rollout.step()
    observation = rollout._recent[-1]
    rollout.set_command(500.0, 9)
    rollout.temperature = 0.5
    assert rollout.probabilities.tolist() == (
        policy.probabilities(observation, 500.0, 9, temperature=0.5).tolist()
    )
    rollout.step()
    assert (rollout.desired_return, rollout.desired_horizon) == (499.0, 8)


def test_command_is_bounded_as_in_evaluations() -> None:
    policy, env = agent()
    rollout = Rollout(policy, env, command(desired_return=300.0, cap=100.0))
    assert rollout.desired_return == 100.0
    policy, env = agent(horizon_equals_return=True)
    rollout = Rollout(policy, env, command(desired_return=33.9))
    assert rollout.desired_horizon == math.floor(33.9)


def test_frame_is_the_environments_rendering() -> None:
    policy, _ = agent()
    kwargs = {"render_mode": "rgb_array"}
    env = make_environment(msgspec.structs.replace(policy.config, environment_kwargs=kwargs))
    rollout = Rollout(policy, env, command())
    before = rollout.picture()
    for _ in range(5):
        rollout.step()
    assert before.dtype == np.uint8
    assert before.shape == rollout.picture().shape
    assert (before != rollout.picture()).any()
    env.close()


def test_environment_without_rendering_is_reported() -> None:
    policy, env = agent()
    with (
        pytest.warns(UserWarning, match="render"),
        pytest.raises(UnsupportedEnvironment, match=r"'CartPole-v1' renders no image.*rgb_array"),
    ):
        Rollout(policy, env, command()).picture()


class Empty(gym.Wrapper[Any, Any, Any, Any]):
    def render(self) -> Any:
        return np.zeros((0, 0, 3), np.uint8)


def test_empty_picture_is_rejected() -> None:
    policy, env = agent()
    with pytest.raises(UnsupportedEnvironment, match="renders no image"):
        Rollout(policy, Empty(env), command()).picture()


class Broken(gym.Wrapper[Any, Any, Any, Any]):
    def step(self, action: Any) -> Any:
        raise RuntimeError("the wheels came off")


def test_failing_environment_is_reported() -> None:
    policy, env = agent()
    rollout = Rollout(policy, Broken(env), command())
    with pytest.raises(EnvironmentFault, match=r"0 steps.*seed 11: step\(\) .*wheels came off"):
        rollout.step()
