"""The previous action and reward as a part of the observation."""

import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.algorithm1 import algorithm1
from udrl.commands import CommandSampler
from udrl.config import Budget, Config, build, refuse_ineffective
from udrl.datasets import read_dataset
from udrl.digests import arrays_digest
from udrl.environments import make_environment
from udrl.environments.making import adapt
from udrl.environments.previous import PREVIOUS, ObservePrevious, null_action
from udrl.environments.specification import specify
from udrl.episode import Episode
from udrl.errors import ConfigError, EnvironmentFault, UnsupportedEnvironment
from udrl.experience import Experience
from udrl.spaces import Record, Vector
from udrl.training import train, untrained

NESTED = "kinds_of_spaces:Nested-v0"


def config(**values: Any) -> Config:
    small = {
        "environment": "CartPole-v1", "observe_previous": True, "hidden": [8, 8],
        "convolutions": [4], "n_warm_up_episodes": 4, "batch_size": 16, "n_updates_per_iter": 5,
        "n_episodes_per_iter": 3, "last_few": 2,
    }  # fmt: skip
    return build(Config, small | values)


def warm_up(settings: Config) -> list[Episode]:
    generator = EpisodeGenerator(settings, 2)
    commands = CommandSampler(settings, generator.spec).warm_up()
    return generate_episodes(generator, commands, None)


@pytest.mark.parametrize("environment", ["CartPole-v1", NESTED])
def test_previous_action_and_reward_are_observed(environment: str) -> None:
    env = ObservePrevious(gym.make(environment))
    space = env.env.action_space
    space.seed(1)
    shown, _ = env.reset(seed=1)
    assert env.observation_space.contains(shown)
    assert not shown["has_previous"].any()
    assert shown["previous_reward"] == 0
    assert space.contains(shown["previous_action"]) or environment == "CartPole-v1"
    for _ in range(5):
        action = space.sample()
        shown, reward, *_ = env.step(action)
        assert env.observation_space.contains(shown)
        assert shown["previous_action"] is action
        assert shown["previous_reward"] == np.float32(reward)
        assert shown["has_previous"].all()


@pytest.mark.parametrize(
    ("space", "expected"),
    [
        (spaces.Discrete(3, start=2), 2),
        (spaces.MultiDiscrete(np.array([3, 2]), start=np.array([1, 0])), [1, 0]),
        (spaces.MultiBinary(2), [0, 0]),
        (spaces.Box(-1, 1, (2,)), [0, 0]),
        (spaces.Tuple((spaces.Discrete(2), spaces.MultiBinary(1))), (0, [0])),
    ],
    ids=str,
)
def test_first_previous_action_is_null(space: Any, expected: Any) -> None:
    found = null_action(space)
    if isinstance(expected, tuple):
        assert all(map(np.array_equal, found, expected))
    else:
        assert np.array_equal(found, expected)


def test_episodes_store_previous_action_and_reward() -> None:
    for episode in warm_up(config()):
        seen = episode.observations
        assert seen["['has_previous']"].ravel().tolist() == [0] + [1] * (episode.length - 1)
        assert seen["['previous_action']"].tolist() == [0, *episode.actions[:-1].tolist()]
        assert seen["['previous_reward']"].ravel().tolist() == [0, *episode.rewards[:-1].tolist()]


class Paid(gym.RewardWrapper[Any, Any]):
    """Pays the given reward."""

    def __init__(self, env: gym.Env[Any, Any], reward: Any) -> None:
        super().__init__(env)
        self._reward = reward

    def reward(self, reward: Any) -> Any:
        return self._reward


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        ("x", r"returned 'x' \(str\) as reward, expected a number"),
        (np.zeros(2), r"an array of float64, shape \(2,\) as reward"),
        (10**400, "the reward inf, expected a finite number"),
        (-(10**400), "the reward -inf, expected a finite number"),
    ],
    ids=["text", "array", "huge", "huge negative"],
)
@pytest.mark.parametrize("observes", [True, False])
def test_invalid_reward_is_named(reward: Any, message: str, observes: bool) -> None:
    settings = config(observe_previous=observes)
    env = Paid(gym.make(settings.environment), reward)
    adapted = adapt(ObservePrevious(env) if observes else env, "Paid-v0", settings.actions)
    adapted.reset(seed=1)
    with pytest.raises(EnvironmentFault, match=message):
        adapted.step(0)


def test_training_masks_them_in_a_share_of_the_examples() -> None:
    always, never, half = (config(previous_dropout=share) for share in (1.0, 0.0, 0.5))
    spec = specify(make_environment(always), always)
    episodes = warm_up(always)
    hidden = warm_up(always)
    for episode in hidden:
        for key in PREVIOUS:
            episode.observations[f"['{key}']"] = 0

    def weights(settings: Config, shown: list[Episode]) -> str:
        experience, state = Experience(settings, spec), untrained(settings, spec)
        for episode in shown:
            experience.add(episode)
        train(state, experience.by_rank([e.command_id for e in shown]), settings)
        return arrays_digest(state.weights).hex()

    assert weights(always, episodes) == weights(never, hidden)
    assert len({weights(s, episodes) for s in (always, never, half)}) == 3


@pytest.mark.parametrize("baseline", ["none", "value", "action_value"])
def test_run_is_independent_of_the_number_of_environments(baseline: str) -> None:
    settings = config(baseline=baseline, frame_stack=2)
    budget = Budget(max_env_steps=400)
    runs = [algorithm1(settings, budget, n) for n in (1, 5)]
    assert len({(run.weights_sha256, run.replay_sha256) for run in runs}) == 1


def stacked(elements: list[Any]) -> Any:
    """Stack elements as Minari does: one list per leaf."""
    if isinstance(elements[0], dict):
        return {k: stacked([e[k] for e in elements]) for k in elements[0]}
    if isinstance(elements[0], tuple):
        return tuple(stacked([e[k] for e in elements]) for k in range(len(elements[0])))
    return elements


@pytest.mark.filterwarnings("ignore::UserWarning:minari")
@pytest.mark.parametrize("time", [False, True])
@pytest.mark.parametrize("environment", ["CartPole-v1", NESTED])
def test_dataset_without_them_is_completed(
    environment: str, time: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    minari = pytest.importorskip("minari")
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    raw = gym.make(environment)
    raw.action_space.seed(3)
    settings = config(environment=environment, observe_time=time)
    own = make_environment(settings)
    expected, buffers = [], []
    for seed in (0, 1):
        seen, done, earned = [raw.reset(seed=seed)[0]], [], []
        observation, _ = own.reset(seed=seed)
        over = False
        while not over:
            expected.append(observation.copy())
            done.append(raw.action_space.sample())
            shown, reward, terminated, truncated, _ = raw.step(done[-1])
            seen.append(shown)
            earned.append(reward)
            observation, *_ = own.step(own.actions.one(done[-1]).tolist())
            over = terminated or truncated
        ends = [False] * (len(done) - 1)
        buffers.append(
            EpisodeBuffer(
                id=seed,
                observations=stacked(seen),
                actions=stacked(done),
                rewards=earned,
                terminations=[*ends, terminated],
                truncations=[*ends, truncated],
            )
        )
    minari.create_dataset_from_buffers("some/raw-v0", buffers, env=raw)
    episodes = read_dataset("some/raw-v0", settings, specify(own, settings))
    found = np.concatenate([e.observations for e in episodes])
    for name in found.dtype.names or ():
        # The nearest bin of a Box differs between this environment and the dataset.
        if not name.startswith("['previous_action']['legs']") and "reward" not in name:
            assert np.array_equal(found[name], np.array(expected)[name]), name


def test_wrappers_are_applied_in_order() -> None:
    settings = config(
        observe_previous=False,
        wrappers=[
            "gymnasium.wrappers:FlattenObservation",
            "udrl.environments.previous:ObservePrevious",
        ],
    )
    space = specify(make_environment(settings), settings).observation_space
    assert isinstance(space, Record)
    assert [leaf.name for leaf in space.leaves][:2] == ["['observation']", "['previous_action']"]
    limited = config(wrappers=settings.wrappers[:1], max_episode_steps=5)
    assert all(e.length <= 5 for e in warm_up(limited))


def test_wrappers_take_literal_arguments() -> None:
    settings = config(
        observe_previous=False,
        wrappers=["gymnasium.wrappers:FrameStackObservation(stack_size=3, padding_type='zero')"],
    )
    space = specify(make_environment(settings), settings).observation_space
    assert space == Vector(size=12)


@pytest.mark.parametrize(
    ("wrapper", "message"),
    [
        ("FlattenObservation", "there is no colon"),
        ("gymnasium.wrappers:FrameStackObservation(3)", "arguments need names"),
        ("gymnasium.wrappers:FrameStackObservation(stack_size=open('x'))", "ValueError"),
        ("gymnasium.wrappers:a.b(c=1)", "no class name"),
        ("gymnasium.wrappers:", "SyntaxError"),
        ("gymnasium.wrappers:NoSuchWrapper", "AttributeError"),
        ("no_such_package:Wrapper", "ModuleNotFoundError"),
        ("gymnasium.wrappers:TransformObservation", "TypeError"),
    ],
)
def test_inapplicable_wrapper_is_rejected(wrapper: str, message: str) -> None:
    with pytest.raises(
        UnsupportedEnvironment, match=f"{re.escape(wrapper)}.*{message}.*package.module:Wrapper"
    ):
        make_environment(config(wrappers=[wrapper]))


def test_drop_previous_without_observe_previous_is_rejected() -> None:
    with pytest.raises(ConfigError, match=r"previous_dropout = 0.25 .* needs observe_p"):
        refuse_ineffective(config(observe_previous=False), ["previous_dropout"])
