"""Every kind of space with all services and commands."""

import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.actions import Product
from udrl.config import Budget, Config, build
from udrl.environments import make_environment
from udrl.rollout import Rollout
from udrl_inspect.agents import Agent, evaluation_commands, load_agent
from udrl_inspect.exporting import export_buffer
from udrl_launch.settings import Fleet, Settings
from udrl_launch.training_run import run_training
from udrl_proto.reports import Status
from whole_run import SMALL, digests, reference

Runner = Callable[..., Status]
SETTINGS: dict[str, Any] = SMALL | {
    "environment": "kinds_of_spaces:Nested-v0", "max_return": None, "lead": 0, "hidden": [32, 32],
    "convolutions": [4], "baseline": "action_value", "eval_every": 400, "return_scale": 0.05,
    "n_updates_per_iter": 20, "hold_steps": 3,
}  # fmt: skip


def nested(**changes: Any) -> Config:
    return build(Config, SETTINGS | changes)


@pytest.mark.slow
@pytest.mark.parametrize("frame_stack", [1, 2])
def test_run_with_composite_spaces_equals_the_reference(frame_stack: int, run: Runner) -> None:
    config = nested(frame_stack=frame_stack)
    expected = reference(config, 1500)
    status = run(config, 1500, actors=3, envs=2)
    assert digests(status) == digests(expected)
    assert status.exact
    # The observation allows 1.5 a step more than chance; a part of that is learned.
    evaluations = [expected.evaluations[i].mean for i in sorted(expected.evaluations)]
    assert max(evaluations[1:]) > evaluations[0]


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("nested") / "run"
    settings = Settings(nested(), Budget(max_env_steps=1000), Fleet(actors=1, envs_per_actor=16))
    run_training(settings, made, threading.Event(), in_process=True)
    return made


@pytest.fixture(scope="module")
def agent(run_dir: Path) -> Agent:
    return load_agent(run_dir)


def test_policy_accepts_the_environments_observations(agent: Agent) -> None:
    policy = agent.policy
    raw, plain = gym.make("kinds_of_spaces:Nested-v0"), policy.make_environment()
    seen, _ = raw.reset(seed=3)
    shown, _ = plain.reset(seed=3)
    assert isinstance(policy.spec.action_space, Product)
    logits = policy.logits(shown, 5.0, 8)
    assert logits.shape == (policy.spec.action_space.n_parameters,)
    action = policy.predict(shown, 5.0, 8)
    assert action.shape == policy.spec.action_space.shape
    plain.step(action)
    # Numeric arrays are accepted if they are arranged alike.
    assert np.array_equal(shown["speed"], seen["speed"].reshape(-1).astype(np.float32))


def test_rollout_makes_the_same_episode(agent: Agent) -> None:
    (command,) = evaluation_commands(agent, episodes=1)
    with closing(EpisodeGenerator(agent.config, 3)) as generator:
        (episode,) = generate_episodes(generator, [command], agent.behavior)
    space = agent.environment.action_space
    assert isinstance(space, Product)
    actions = []
    with closing(make_environment(agent.config)) as env:
        rollout = Rollout(agent.policy, env, command)
        while not rollout.over:
            assert np.isclose(rollout.probabilities.sum(), len(space.ns))
            rollout.step()
            actions.append(rollout.action)
    assert actions == episode.actions.tolist()
    assert rollout.episode_return == episode.episode_return


def test_episodes_are_exported_as_a_dataset_and_start_another_run(
    run_dir: Path, run: Runner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    n = export_buffer(run_dir, "nested/udrl-v0")
    dataset = minari.load_dataset("nested/udrl-v0")
    env = gym.make("kinds_of_spaces:Nested-v0")
    assert dataset.observation_space == env.observation_space
    assert dataset.action_space == env.action_space
    assert dataset.total_episodes == n
    again = run(nested(dataset="nested/udrl-v0"), 1000)
    assert again.env_steps >= 1000
