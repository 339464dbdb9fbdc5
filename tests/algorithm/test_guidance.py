"""Guidance: acting goes further than the examples, by a chosen divergence."""

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from udrl.action_losses import kl_divergence
from udrl.actions import Categorical, Product
from udrl.algorithm1 import algorithm1
from udrl.batches import Batch
from udrl.behavior import BehaviorFunction, initialise
from udrl.config import Budget, Config, build
from udrl.environments import EnvironmentSpec
from udrl.guidance import choose_guidance
from udrl.spaces import Vector
from udrl.value import relative, with_return

SPEC = EnvironmentSpec(
    observation_space=Vector(size=4), action_space=Categorical(n=3), max_episode_steps=100
)


def behavior(response: float = 10.0, **values: object) -> BehaviorFunction:
    """An untrained network; ``response`` multiplies the weights that read the command."""
    settings = {"environment": "Any-v0", "baseline": "value", "guidance_kl": 0.05} | values
    network = initialise(build(Config, settings), SPEC)
    with torch.no_grad():
        network.command.weight.mul_(response)
    return network


def examples(n: int) -> Batch:
    generator = torch.Generator().manual_seed(1)
    seen = (torch.randn(n, 4, generator=generator),)
    return Batch(seen, torch.randn(n, 2, generator=generator), torch.zeros(n), None, None)


def mean_divergence(network: BehaviorFunction, batch: Batch, guidance: float) -> float:
    """The divergence of guided acting from the lowest response, in float64."""
    with torch.no_grad():
        highest, lowest = (
            network.forward_relative(batch.seen, with_return(batch.command, level)).double()
            for level in (2.0, -2.0)
        )
    p = (highest + guidance * (highest - lowest)).softmax(1).numpy()
    q = lowest.softmax(1).numpy()
    return float((p * np.log(p / q)).sum(axis=1).mean())


@pytest.mark.parametrize("minimum", [0.02, 0.05])
def test_guided_policy_diverges_by_the_minimum(minimum: float) -> None:
    network, batch = behavior(), examples(5000)
    assert mean_divergence(network, batch, 0.0) < minimum / 2
    guidance, lowest = choose_guidance(network, lambda: [(batch, None)], minimum)
    assert lowest == -2.0
    assert mean_divergence(network, batch, guidance) == pytest.approx(minimum, rel=0.2)


def test_strong_response_is_not_guided() -> None:
    network, batch = behavior(), examples(5000)
    assert mean_divergence(network, batch, 0.0) > 0.001
    assert choose_guidance(network, lambda: [(batch, None)], 0.001)[0] == 0.0


def test_guidance_is_bounded() -> None:
    assert choose_guidance(behavior(response=0.0), lambda: [(examples(10), None)], 0.05)[0] == 30.0


def test_padding_does_not_count() -> None:
    batch = examples(100)
    padded = batch._replace(valid=torch.arange(100) < 50)
    first = batch._replace(seen=(batch.seen[0][:50],), command=batch.command[:50])
    guidance = [
        choose_guidance(behavior(), partial(iter, [(b, None)]), 0.05)[0]
        for b in (padded, first, batch)
    ]
    assert guidance[0] == pytest.approx(guidance[1], rel=1e-5)
    assert guidance[0] != pytest.approx(guidance[2], rel=1e-5)


def test_acting_is_guided_and_training_is_not() -> None:
    network, batch = behavior(), examples(10)
    assert network.guidance is not None
    assert network.value is not None
    unguided = network(batch.seen, batch.command)
    network.guidance.copy_(torch.tensor([[2.0, -2.0]]))
    command = relative(batch.command, network.value(batch.seen), network.bound)
    trained = network.forward_relative(batch.seen, command)
    lowest = network.forward_relative(batch.seen, with_return(command, -2.0))
    assert torch.equal(unguided, trained)
    assert torch.allclose(network(batch.seen, batch.command), 3 * trained - 2 * lowest)


@pytest.mark.parametrize("valid", [None, torch.arange(10) < 5])
def test_without_a_baseline_the_returns_are_those_of_the_examples(valid: Any) -> None:
    network, batch = behavior(baseline="none"), examples(10)._replace(valid=valid)
    returns = batch.command[:, 0] if valid is None else batch.command[:5, 0]
    guidance, lowest = choose_guidance(network, lambda: [(batch, None)], 0.05)
    assert lowest == returns.min()
    assert network.guidance is not None
    network.guidance.copy_(torch.tensor([[guidance, lowest]]))
    trained = network.forward_relative(batch.seen, batch.command)
    away = network.forward_relative(batch.seen, with_return(batch.command, lowest))
    expected = trained + guidance * (trained - away)
    assert guidance > 0
    assert torch.allclose(network(batch.seen, batch.command), expected)


def test_without_divergence_there_is_no_guidance() -> None:
    network = behavior(guidance_kl=0.0)
    assert network.guidance is None
    assert "guidance" not in network.state_dict()


@pytest.mark.parametrize("values", [{}, {"memory": "gru", "memory_window": 8}])
def test_training_chooses_guidance(values: dict[str, Any]) -> None:
    small = {
        "environment": "CartPole-v1", "baseline": "value", "guidance_kl": 0.05, "lead": 0,
        "n_warm_up_episodes": 4, "n_episodes_per_iter": 2, "n_updates_per_iter": 2,
        "batch_size": 64,
    }  # fmt: skip
    config = build(Config, small | values)
    run = algorithm1(config, Budget(max_env_steps=300))
    ((guidance, lowest),) = run.state.weights["guidance"]
    assert 0 < guidance <= 30
    assert lowest < 0


@given(
    st.lists(st.floats(-5, 5), min_size=5, max_size=5),
    st.lists(st.floats(-5, 5), min_size=5, max_size=5),
)
def test_divergence_is_that_of_the_joint_distribution(p: list[float], q: list[float]) -> None:
    space = Product(ns=(3, 2))
    found = kl_divergence(space, torch.tensor([p]), torch.tensor([q]))
    joint = [
        np.outer(*(np.exp(part) / np.exp(part).sum() for part in np.split(np.array(x), [3])))
        for x in (p, q)
    ]
    expected = (joint[0] * np.log(joint[0] / joint[1])).sum()
    assert float(found[0]) == pytest.approx(expected, abs=1e-4)
