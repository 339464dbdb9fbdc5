import math
from typing import Any

import numpy as np
import pytest

from udrl.actions import Categorical
from udrl.config import Config, build
from udrl.environments import make_environment, specify
from udrl.errors import InvalidData
from udrl.graph import acting_graph
from udrl.inference import ActingFunction, probe_weights
from udrl.policy import Policy


def policy(environment: str = "CartPole-v1", seed: int = 1, **values: Any) -> Policy:
    config = build(Config, {"environment": environment, "hidden": [16, 16]} | values)
    env = make_environment(config)
    spec = specify(env, config)
    env.close()
    graph = acting_graph(config.network, spec)
    behavior = ActingFunction(graph, probe_weights(graph))
    return Policy(behavior, config, spec, np.random.default_rng(seed))


SEEN = [0.1, -0.2, 0.03, 0.4]


def test_logits_are_those_of_the_behavior_function() -> None:
    agent = policy(return_scale=0.02, horizon_scale=0.01)
    expected = agent.behavior.logits((np.array([SEEN], np.float32),), np.array([[100.0, 50.0]]))
    assert agent.logits(SEEN, 100.0, 50).tolist() == expected[0].tolist()


def test_a_horizon_counts_as_one_step_at_least() -> None:
    agent = policy()
    assert agent.logits(SEEN, 10.0, -7).tolist() == agent.logits(SEEN, 10.0, 1).tolist()


def test_where_horizons_follow_from_returns_a_given_one_is_not_read() -> None:
    agent = policy(desired_horizon="return")
    told = agent.logits(SEEN, 100.5, 3).tolist()
    assert told == agent.logits(SEEN, 100.5, 77).tolist()
    assert told != policy().logits(SEEN, 100.5, 3).tolist()


@pytest.mark.parametrize("temperature", [0.3, 1.0, 4.0])
def test_actions_have_the_frequencies_that_the_probabilities_say(temperature: float) -> None:
    agent = policy()
    expected = agent.probabilities(SEEN, 60.0, 60, temperature)
    n = 4000
    drawn = [agent.predict(SEEN, 60.0, 60, temperature=temperature) for _ in range(n)]
    share = np.bincount(drawn, minlength=2) / n
    assert expected.sum() == pytest.approx(1.0)
    assert abs(share - expected).max() < 5 * math.sqrt(0.25 / n)


def test_a_deterministic_action_is_the_mode() -> None:
    agent = policy()
    mode = int(agent.probabilities(SEEN, 60.0, 60).argmax())
    assert {agent.predict(SEEN, 60.0, 60, deterministic=True) for _ in range(50)} == {mode}
    assert agent.probabilities(SEEN, 60.0, 60, temperature=0).tolist() == [
        float(a == mode) for a in range(2)
    ]


def test_a_policy_repeats_itself_under_a_seed() -> None:
    one, other = policy(seed=5), policy(seed=5)
    assert [one.predict(SEEN, 20.0, 20) for _ in range(60)] == [
        other.predict(SEEN, 20.0, 20) for _ in range(60)
    ]


@pytest.mark.parametrize(
    ("seen", "desired", "says"),
    [
        (SEEN[:3], (1.0, 1.0), r"an observation of shape \(3,\): expected \(4,\).*CartPole-v1"),
        (SEEN, (math.nan, 1.0), "desired return nan.*finite"),
        (SEEN, (1.0, math.inf), "desired horizon inf.*finite"),
        ([math.nan, *SEEN[1:]], (1.0, 1.0), "observation.*expected finite numbers"),
    ],
)
def test_what_it_cannot_be_asked(seen: Any, desired: tuple[float, float], says: str) -> None:
    with pytest.raises(InvalidData, match=says):
        policy().predict(seen, *desired)


@pytest.mark.parametrize("temperature", [-1.0, math.nan, math.inf])
def test_a_temperature_is_a_finite_number_from_0_on(temperature: float) -> None:
    with pytest.raises(InvalidData, match="temperature"):
        policy().predict(SEEN, 1.0, 1, temperature=temperature)
    with pytest.raises(InvalidData, match="temperature"):
        policy().probabilities(SEEN, 1.0, 1, temperature)


def test_stacked_observations_may_have_a_dimension_of_their_own() -> None:
    agent = policy(frame_stack=3)
    stack = np.arange(12, dtype=np.float32).reshape(3, 4) / 10
    assert agent.logits(stack, 9.0, 9).tolist() == agent.logits(stack.ravel(), 9.0, 9).tolist()
    with pytest.raises(InvalidData, match=r"shape \(4,\): expected \(12,\)"):
        agent.logits(SEEN, 9.0, 9)


@pytest.mark.parametrize("uniform", [0.0, 0.25, 0.5, 0.999999])
def test_choosing_is_by_inverse_cdf(uniform: float) -> None:
    logits, space = np.log([0.2, 0.3, 0.5]), Categorical(n=3)
    expected = next(a for a, edge in enumerate([0.2, 0.5, 1.0]) if uniform < edge)
    assert space.choose(logits, 1.0, uniform) == expected
    assert space.choose(logits, 0.0, uniform) == 2
    assert space.probabilities(logits, 1.0) == pytest.approx([0.2, 0.3, 0.5])
