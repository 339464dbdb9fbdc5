import contextlib
import math
from typing import Any

import numpy as np
import pytest
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array

from udrl.actions import Categorical, choose
from udrl.config import Config, build
from udrl.environments import EnvironmentSpec, make_environment, specify
from udrl.errors import InvalidData
from udrl.graph import acting_graph
from udrl.inference import ActingFunction, probe_weights
from udrl.policy import Policy
from udrl.spaces import Bits, Category, Image, ObservationSpace


def policy(environment: str = "CartPole-v1", seed: int = 1, **values: Any) -> Policy:
    config = build(Config, {"environment": environment, "hidden": [16, 16]} | values)
    with contextlib.closing(make_environment(config)) as env:
        return policy_of(config, specify(env, config), seed)


def policy_of(config: Config, spec: EnvironmentSpec, seed: int = 1) -> Policy:
    graph = acting_graph(config.network, spec)
    behavior = ActingFunction(graph, probe_weights(graph))
    return Policy(behavior, config, spec, np.random.default_rng(seed))


SEEN = [0.1, -0.2, 0.03, 0.4]


def test_logits_equal_those_of_the_behavior_function() -> None:
    agent = policy(return_scale=0.02, horizon_scale=0.01)
    expected = agent.behavior.logits((np.array([SEEN], np.float32),), np.array([[100.0, 50.0]]))
    assert agent.logits(SEEN, 100.0, 50).tolist() == expected[0].tolist()


def test_horizon_is_at_least_one_step() -> None:
    agent = policy()
    assert agent.logits(SEEN, 10.0, -7).tolist() == agent.logits(SEEN, 10.0, 1).tolist()


def test_given_horizon_is_ignored_where_horizons_follow_from_returns() -> None:
    agent = policy(horizon_equals_return=True)
    found = agent.logits(SEEN, 100.5, 3).tolist()
    assert found == agent.logits(SEEN, 100.5, 77).tolist()
    assert found != policy().logits(SEEN, 100.5, 3).tolist()


@pytest.mark.parametrize("temperature", [0.3, 1.0, 4.0])
def test_action_frequencies_match_the_probabilities(temperature: float) -> None:
    agent = policy()
    expected = agent.probabilities(SEEN, 60.0, 60, temperature)
    n = 4000
    drawn = [agent.predict(SEEN, 60.0, 60, temperature=temperature) for _ in range(n)]
    share = np.bincount(drawn, minlength=2) / n
    assert expected.sum() == pytest.approx(1.0)
    assert abs(share - expected).max() < 5 * math.sqrt(0.25 / n)


def test_deterministic_action_is_the_mode() -> None:
    agent = policy()
    mode = int(agent.probabilities(SEEN, 60.0, 60).argmax())
    assert {agent.predict(SEEN, 60.0, 60, deterministic=True) for _ in range(50)} == {mode}
    assert agent.probabilities(SEEN, 60.0, 60, temperature=0).tolist() == [
        float(a == mode) for a in range(2)
    ]


def test_actions_repeat_under_the_same_seed() -> None:
    one, other = policy(seed=5), policy(seed=5)
    assert [one.predict(SEEN, 20.0, 20) for _ in range(60)] == [
        other.predict(SEEN, 20.0, 20) for _ in range(60)
    ]


@pytest.mark.parametrize(
    ("seen", "desired", "message"),
    [
        (SEEN[:3], (1.0, 1.0), r"an observation of shape \(3,\): expected \(4,\).*CartPole-v1"),
        (SEEN, (math.nan, 1.0), "desired return nan.*finite"),
        (SEEN, (1.0, math.inf), "desired horizon inf.*finite"),
        ([math.nan, *SEEN[1:]], (1.0, 1.0), "observation.*not all finite numbers"),
        ([1e39, *SEEN[1:]], (1.0, 1.0), "observation.*not all finite numbers"),
        (list("abcd"), (1.0, 1.0), "observation: an array of <U1, expected numbers"),
        ([[1], [1, 2]], (1.0, 1.0), "observation a list of 2: "),
    ],
)
def test_invalid_input_is_rejected(seen: Any, desired: tuple[float, float], message: str) -> None:
    with pytest.raises(InvalidData, match=message):
        policy().predict(seen, *desired)


@pytest.mark.parametrize(
    ("space", "seen", "message"),
    [
        (Category(n=4), 4, "observation: from 4 to 4, expected 0 to 3; pass observations like"),
        (Category(n=4), -1, "observation: from -1 to -1, expected 0 to 3"),
        (Category(n=4), 1.7, "observation: not all whole numbers from -2147483648 to 2147483647"),
        (Image(1, 8, 8), np.full((1, 8, 8), 0.5), "not all whole numbers from 0 to 255"),
        (Image(1, 8, 8), np.full((1, 8, 8), 300), "not all whole numbers from 0 to 255"),
        (Bits(3), [0, 7, 0], "observation: not all 0 or 1"),
    ],
)
def test_observation_that_is_impossible_in_training_is_rejected(
    space: ObservationSpace, seen: Any, message: str
) -> None:
    config = build(Config, {"environment": "Any-v0"})
    spec = EnvironmentSpec(
        observation_space=space, action_space=Categorical(n=2), max_episode_steps=9
    )
    with pytest.raises(InvalidData, match=message):
        policy_of(config, spec).predict(seen, 1.0, 1)


@pytest.mark.parametrize("desired", ["much", [1.0, [2.0]], 1j, 10**400])
def test_command_that_is_no_number_is_rejected(desired: Any) -> None:
    for command in ((desired, 1), (1.0, desired)):
        with pytest.raises(InvalidData, match=r"desired return .*; pass numbers, or one for each"):
            policy().predict(SEEN, *command)


@pytest.mark.parametrize("temperature", [-1.0, math.nan, math.inf])
def test_temperature_is_a_finite_nonnegative_number(temperature: float) -> None:
    with pytest.raises(InvalidData, match="temperature"):
        policy().predict(SEEN, 1.0, 1, temperature=temperature)
    with pytest.raises(InvalidData, match="temperature"):
        policy().probabilities(SEEN, 1.0, 1, temperature)


def test_stacked_observations_may_have_their_own_dimension() -> None:
    agent = policy(frame_stack=3)
    stack = np.arange(12, dtype=np.float32).reshape(3, 4) / 10
    assert agent.logits(stack, 9.0, 9).tolist() == agent.logits(stack.ravel(), 9.0, 9).tolist()
    with pytest.raises(InvalidData, match=r"shape \(4,\): expected \(12,\)"):
        agent.logits(SEEN, 9.0, 9)


@pytest.mark.parametrize("uniform", [0.0, 0.25, 0.5, 0.999999])
def test_actions_are_sampled_by_inverse_cdf(uniform: float) -> None:
    logits, space = np.log([0.2, 0.3, 0.5]), Categorical(n=3)
    expected = next(a for a, edge in enumerate([0.2, 0.5, 1.0]) if uniform < edge)
    for temperature, action in (1.0, expected), (0.0, 2):
        assert choose(space, logits[None], temperature, np.array([uniform])).tolist() == [action]
    assert space.probabilities(logits, 1.0) == pytest.approx([0.2, 0.3, 0.5])


BATCHED: list[dict[str, Any]] = [
    {},
    {"memory": "gru"},
    {"frame_stack": 3},
    {"environment": "Figure2-v0"},  # an index
    {"environment": "Taxi-v4", "action_mask": "info"},  # a record
    {"environment": "Pendulum-v1"},  # several components
]


@pytest.mark.parametrize("settings", BATCHED)
@pytest.mark.parametrize("temperature", [1.0, 0.0])
def test_batch_gets_the_actions_of_single_calls(
    settings: dict[str, Any], temperature: float
) -> None:
    agent, other = policy(**settings), policy(**settings)
    with contextlib.closing(agent.make_environment()) as env:
        env.observation_space.seed(3)
        single = [env.observation_space.sample() for _ in range(4)]
        space = batch_space(env.observation_space, 4)
        empty: Any = create_empty_array(env.observation_space, 4)
        batch: Any = concatenate(env.observation_space, single, empty)
        assert space.contains(batch)
    returns, horizons = np.array([0.5, 1.0, 1.5, 2.0]), np.array([1, 2, 3, 4])
    for _ in range(3 if agent.behavior.state_size else 1):
        states = [None if agent._state is None else agent._state[k : k + 1] for k in range(4)]
        logits, one_by_one = [], []
        for k in range(4):
            other._state = states[k]
            logits.append(other.logits(single[k], returns[k], horizons[k]).tolist())
            one_by_one.append(
                np.asarray(
                    other.predict(single[k], returns[k], horizons[k], temperature=temperature)
                ).tolist()
            )
        assert agent.logits(batch, returns, horizons).tolist() == logits
        shares = agent.probabilities(batch, returns, horizons, temperature)
        assert shares.shape == (4, agent.spec.action_space.n_parameters)
        actions = agent.predict(batch, returns, horizons, temperature=temperature)
        assert actions.tolist() == one_by_one


def test_scalar_applies_to_all_rows_of_a_batch() -> None:
    agent = policy()
    batch = np.array([SEEN, SEEN[::-1]])
    expected = agent.logits(batch, np.array([20.0, 20.0]), np.array([30, 30])).tolist()
    assert agent.logits(batch, np.array([20.0, 20.0]), 30).tolist() == expected
    assert agent.logits(batch, 20.0, np.array([30, 30])).tolist() == expected


def test_agent_without_a_memory_takes_batches_of_any_size() -> None:
    agent = policy()
    assert np.ndim(agent.predict(SEEN, 20.0, 30)) == 0
    for n in (3, 1, 2):
        assert agent.predict([SEEN] * n, [20.0] * n, 30).shape == (n,)


def test_rows_of_a_batch_are_reset_independently() -> None:
    agent = policy(memory="gru")
    batch, returns = np.array([SEEN, SEEN]), np.array([20.0, 20.0])
    first = agent.logits(batch, returns, 30).tolist()
    agent.predict(batch, returns, 30)
    later = agent.logits(batch, returns, 30).tolist()
    assert later != first
    agent.reset([True, False])
    assert agent.logits(batch, returns, 30).tolist() == [first[0], later[1]]
    with pytest.raises(InvalidData, match=r"rows of shape \(3,\): expected \(2,\)"):
        agent.reset([True, False, True])
    with pytest.raises(InvalidData, match="a batch of 1 observations, but the memory is that of 2"):
        agent.predict(batch[:1], returns[:1], 30)
    with pytest.raises(InvalidData, match="a single observation, but the memory is that of 2"):
        agent.predict(SEEN, 20.0, 30)
    agent.reset()
    assert agent.logits(batch, returns, 30).tolist() == first


@pytest.mark.parametrize(
    ("seen", "desired", "message"),
    [
        (SEEN, ([1.0, 2.0], 1), "a single observation, but 2 desired returns.*batch of 2"),
        ([SEEN, SEEN], (1.0, 1), "a batch of 2 observations, but one desired.*pass arrays of 2"),
        ([SEEN, SEEN], ([1.0] * 3, 1), "a batch of 2 observations, but 3 desired.*arrays of 2"),
        ([SEEN[:3]] * 2, ([1.0] * 2, 1), r"an observation of shape \(2, 3\): expected \(2, 4\)"),
        ([SEEN, SEEN], ([1.0, 2.0], [1, 2, 3]), r"returns of shape \(2,\) and .* of shape \(3,\)"),
        ([SEEN, SEEN], ([[1.0, 2.0]], 1), r"returns of shape \(1, 2\)"),
        ([SEEN, SEEN], ([1.0, math.nan], 1), "expected finite numbers"),
    ],
)
def test_mismatched_batch_is_rejected(seen: Any, desired: Any, message: str) -> None:
    with pytest.raises(InvalidData, match=message):
        policy().predict(seen, *desired)
