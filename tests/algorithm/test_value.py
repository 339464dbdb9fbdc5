"""The value function, and desired returns relative to it (udrl.value)."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from udrl.actions import Categorical
from udrl.checkpoint import decode_state, encode_optimizer
from udrl.config import Config, build
from udrl.digests import arrays_digest
from udrl.environments import EnvironmentSpec
from udrl.episode import Episode
from udrl.errors import ConfigError
from udrl.experience import Experience, RankedExperience
from udrl.segments import Segments
from udrl.spaces import Image, Vector
from udrl.training import train, untrained
from udrl.value import relative
from udrl.weights import encode_weights

SPEC = EnvironmentSpec(
    observation_space=Vector(size=3), action_space=Categorical(n=4), max_episode_steps=90
)
IMAGES = EnvironmentSpec(
    observation_space=Image(channels=1, height=16, width=16),
    action_space=Categorical(n=2),
    max_episode_steps=20,
)


def settings(**values: Any) -> Config:
    small = {
        "environment": "Figure2-v0",
        "baseline": "value",
        "hidden": [16, 16],
        "convolutions": [4, 8],
        "batch_size": 32,
        "n_updates_per_iter": 6,
        "learning_rate": 1e-2,
        "return_scale": 0.5,
    }
    return build(Config, small | values)


def episode(
    number: int, rewards: list[float], *, truncated: bool = False, spec: EnvironmentSpec = SPEC
) -> Episode:
    rng = np.random.default_rng(number)
    shape = (len(rewards), *spec.observation_space.shape)
    observations = (
        rng.integers(256, size=shape, dtype=np.uint8)
        if isinstance(spec.observation_space, Image)
        else rng.standard_normal(shape, np.float32)
    )
    return Episode(
        command_id=number,
        observations=observations,
        actions=rng.integers(spec.action_space.n_parameters, size=len(rewards)).astype(np.uint8),
        rewards=np.array(rewards, np.float32),
        terminated=not truncated,
        truncated=truncated,
    )


def ranked(
    episodes: list[Episode], config: Config | None = None, spec: EnvironmentSpec = SPEC
) -> RankedExperience:
    held = Experience(config or settings(), spec)
    for one in episodes:
        held.add(one)
    return held.by_rank([one.command_id for one in episodes])


def lambda_return(rewards: list[float], values: list[float], end: float, lam: float) -> float:
    """The definition: a mean of n-step returns, of which the last has the remaining weight."""
    n_step, earned = [], 0.0
    for n, reward in enumerate(rewards, start=1):
        earned += reward
        n_step.append(earned + (values[n] if n < len(values) else end))
    weights = [(1 - lam) * lam**n for n in range(len(rewards) - 1)] + [lam ** (len(rewards) - 1)]
    return sum(w * g for w, g in zip(weights, n_step, strict=True))


numbers = st.floats(-100, 100, width=32)


@given(
    st.lists(
        st.tuples(st.lists(numbers, min_size=1, max_size=70), st.booleans()),
        min_size=1,
        max_size=4,
    ),
    st.floats(0, 1),
    st.randoms(use_true_random=False),
)
def test_labels_are_lambda_returns(
    drawn: list[tuple[list[float], bool]], lam: float, random: Any
) -> None:
    experience = ranked(
        [episode(i, rewards, truncated=cut) for i, (rewards, cut) in enumerate(drawn)]
    )
    values = [[random.uniform(-50, 50) for _ in rewards] for rewards, _ in drawn]
    experience.label(np.concatenate(values), lam)
    for rank, (rewards, cut) in enumerate(drawn):
        n = len(rewards)
        segments = Segments(np.full(n, rank), np.arange(n), np.full(n, n))
        end = values[rank][-1] if cut else 0.0
        expected = [lambda_return(rewards[t:], values[rank][t:], end, lam) for t in range(n)]
        got = experience.examples(segments).command[:, 0]
        np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-6)


def test_terminal_state_at_the_step_limit_has_no_value() -> None:
    at_limit = dataclasses.replace(episode(0, [1.0, 2.0]), truncated=True)
    assert at_limit.terminated
    experience = ranked([at_limit])
    experience.label(np.array([50.0, 100.0]), 0.5)
    segments = Segments(np.zeros(2, int), np.arange(2), np.full(2, 2))
    labels = experience.examples(segments).command[:, 0]
    assert labels.tolist() == [0.5 * (1 + 100) + 0.5 * (1 + 2), 2.0]


def test_labels_with_lambda_1_are_observed_returns() -> None:
    experience = ranked([episode(0, [1.0, 2.0, 4.0]), episode(1, [-1.0])])
    segments = Segments(np.array([0, 0, 0, 1]), np.array([0, 1, 2, 0]), np.array([3, 3, 3, 1]))
    before = experience.examples(segments).command[:, 0]
    experience.label(np.array([9.0, 9.0, 9.0, 9.0]), 1.0)
    assert experience.examples(segments).command[:, 0].tolist() == before.tolist()


def test_steps_are_iterated_in_parts() -> None:
    episodes = [episode(0, [0.0] * 70), episode(1, [0.0] * 3)]
    parts = [(seen, done) for (seen,), done in ranked(episodes).steps(at_once=50)]
    assert [(len(seen), len(done)) for seen, done in parts] == [(50, 50), (23, 23)]
    for k, name in enumerate(["observations", "actions"]):
        expected = np.concatenate([getattr(e, name) for e in episodes])
        np.testing.assert_array_equal(np.concatenate([part[k] for part in parts]), expected)


def test_relative_return_is_in_deviations_and_bounded() -> None:
    command = torch.tensor([[3.0, 0.1], [1.0, 0.2], [90.0, 0.3], [-90.0, 0.4]])
    got = relative(command, torch.tensor([[1.0, 2.0]] * 4), 2.0)
    torch.testing.assert_close(got, torch.tensor([[1.0, 0.1], [0.0, 0.2], [2.0, 0.3], [-2.0, 0.4]]))


def test_value_function_learns_expected_returns() -> None:
    config = settings(n_updates_per_iter=100, learning_rate=3e-3, return_lambda=0.9)
    # The observation encodes the return that follows.
    episodes = [episode(i, [1.0] * 40) for i in range(8)]
    for one in episodes:
        one.observations[:, 0] = np.arange(40, 0, -1) / 40
    state = untrained(config, SPEC)
    experience = ranked(episodes, config)
    for _ in range(20):
        train(state, experience, config)
    value = state.behavior.value
    assert value is not None
    observation = torch.zeros(3, 3)
    observation[:, 0] = torch.tensor([1.0, 0.5, 0.1])
    expected, deviation = (value((observation,)) / config.network.return_scale).unbind(1)
    torch.testing.assert_close(expected, torch.tensor([40.0, 20.0, 4.0]), atol=3.0, rtol=0)
    assert (deviation < 3.0).all()


def test_critic_learns_expected_returns_of_actions() -> None:
    config = settings(
        baseline="action_value", n_updates_per_iter=100, learning_rate=3e-3, return_lambda=1.0
    )
    # Action a pays a with probability 1/2, otherwise nothing.
    episodes = [episode(i, [float(4 * (i % 2))]) for i in range(64)]
    for i, one in enumerate(episodes):
        one.observations[:] = 0
        one.actions[:] = i // 2 % 4
        one.rewards[:] *= one.actions[0] / 4
    state = untrained(config, SPEC)
    experience = ranked(episodes, config)
    for _ in range(10):
        train(state, experience, config)
    assert state.critic is not None
    observation, actions = torch.zeros(4, 3), torch.arange(4)
    expected = state.critic((observation,), actions) / config.network.return_scale
    torch.testing.assert_close(expected, torch.tensor([0.0, 0.5, 1.0, 1.5]), atol=0.3, rtol=0)
    # All examples agree, independent of these episodes' returns.
    labels = experience.labels
    assert labels is not None
    np.testing.assert_allclose(labels, [0.5 * (i // 2 % 4) for i in range(64)], atol=0.3)


@pytest.mark.parametrize("baseline", ["value", "action_value"])
def test_restored_state_trains_on_with_identical_results(baseline: str) -> None:
    config = settings(baseline=baseline)
    experience = ranked([episode(i, [1.0, 0.0, float(i)]) for i in range(4)], config)
    state = untrained(config, SPEC)
    train(state, experience, config)
    restored = decode_state(1, encode_weights(state.weights), encode_optimizer(state), config, SPEC)
    for one in (state, restored):
        train(one, experience, config)
    assert arrays_digest(state.weights) == arrays_digest(restored.weights)
    assert encode_optimizer(state) == encode_optimizer(restored)


def test_baseline_changes_the_trained_weights() -> None:
    episodes = [episode(i, [1.0, 0.0, float(i)]) for i in range(4)]
    digests = set()
    for lam in (0.5, 1.0):
        config = settings(return_lambda=lam)
        state = untrained(config, SPEC)
        train(state, ranked(episodes, config), config)
        digests.add(arrays_digest(state.weights))
    assert len(digests) == 2


def test_baseline_requires_trailing_segments() -> None:
    with pytest.raises(ConfigError, match="segments = 'all' with baseline = 'value'"):
        settings(segments="all")
