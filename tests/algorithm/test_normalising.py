"""Vectors are normalised by their mean and deviation in the warm-up."""

from typing import Any

import numpy as np
import pytest
import torch

from udrl.actions import Categorical
from udrl.checkpoint import decode_state, encode_optimizer
from udrl.config import Config, build
from udrl.digests import arrays_digest
from udrl.encoders import Normaliser
from udrl.environments import EnvironmentSpec
from udrl.episode import Episode
from udrl.experience import Experience, RankedExperience
from udrl.graph import acting_graph, weight_shapes
from udrl.inference import ActingFunction
from udrl.spaces import Image, Leaf, ObservationSpace, Record, Vector, parts_of
from udrl.training import TrainingState, train, untrained
from udrl.weights import encode_weights

RECORD = Record(
    (
        Leaf(("near",), Vector(size=2)),
        Leaf(("map",), Image(channels=1, height=8, width=8)),
        Leaf(("far",), Vector(size=1)),
    )
)
VECTOR = Vector(size=3)


def spec(space: ObservationSpace) -> EnvironmentSpec:
    return EnvironmentSpec(
        observation_space=space, action_space=Categorical(n=2), max_episode_steps=40
    )


def settings(**values: Any) -> Config:
    small = {
        "environment": "CartPole-v1", "normalise_observations": True, "baseline": "action_value",
        "hidden": [8, 8], "convolutions": [4], "batch_size": 16, "n_updates_per_iter": 4,
    }  # fmt: skip
    return build(Config, small | values)


def episode(space: ObservationSpace, number: int, shift: float = 0.0) -> Episode:
    """Numbers around 100 + shift with deviations of 1 to 3; the last number of each is constant."""
    rng = np.random.default_rng(number)
    observations = np.empty((30, *space.shape), space.dtype)
    for part in parts_of(observations):
        if part.dtype == np.uint8:
            part[:] = rng.integers(256, size=part.shape)
            continue
        part[:] = 100 + shift + rng.standard_normal(part.shape) * (1 + number)
        part[..., -1] = 7
    return Episode(
        command_id=number,
        observations=observations,
        actions=rng.integers(2, size=30, dtype=np.uint8),
        rewards=rng.standard_normal(30, np.float32),
        terminated=True,
        truncated=False,
    )


def ranked(config: Config, space: ObservationSpace, shift: float = 0.0) -> RankedExperience:
    held = Experience(config, spec(space))
    for number in range(3):
        held.add(episode(space, number, shift))
    return held.by_rank([0, 1, 2])


@pytest.mark.parametrize("space", [VECTOR, RECORD], ids=["vector", "record"])
@pytest.mark.parametrize("frame_stack", [1, 2])
def test_normalisation_is_set_by_version_1_and_kept(
    space: ObservationSpace, frame_stack: int
) -> None:
    config = settings(frame_stack=frame_stack)
    state, experience = untrained(config, spec(space)), ranked(config, space)
    train(state, experience, config)
    networks = {"behavior": state.behavior, "value": state.behavior.value, "critic": state.critic}
    seen = [
        np.concatenate(parts) for parts in zip(*(s for s, _ in experience.steps()), strict=True)
    ]
    vectors = [one.astype(np.float64) for one in seen if one.dtype == np.float32]
    for network in networks.values():
        assert network is not None
        found = [m for m in network.encoder.modules() if isinstance(m, Normaliser)]
        for one, values in zip(found, vectors, strict=True):
            deviation = values.std(0)
            assert one.mean.tolist() == values.mean(0).astype(np.float32).tolist()
            expected = 1 / np.where(deviation > 0, deviation, 1)
            assert one.scale.tolist() == expected.astype(np.float32).tolist()
    before = {n: t for n, t in state.weights.items() if "normaliser" in n}
    train(state, ranked(config, space, shift=50.0), config)
    assert before
    for name, tensor in before.items():
        assert np.array_equal(state.weights[name], tensor), name


@pytest.mark.parametrize("space", [VECTOR, RECORD], ids=["vector", "record"])
def test_graph_normalises_as_in_training(space: ObservationSpace) -> None:
    config = settings()
    state, experience = untrained(config, spec(space)), ranked(config, space)
    train(state, experience, config)
    graph = acting_graph(config.network, spec(space))
    assert weight_shapes(graph) == {n: t.shape for n, t in state.weights.items()}
    seen, _ = next(experience.steps())
    seen[-1][0] = 1e6  # bounded
    command = np.tile([[5.0, 9.0]], (len(seen[0]), 1))
    found = ActingFunction(graph, state.weights).logits(seen, command)
    scaled = torch.from_numpy(command * [config.network.return_scale, config.network.horizon_scale])
    with torch.inference_mode():
        expected = state.behavior(
            tuple(torch.from_numpy(np.ascontiguousarray(one)) for one in seen), scaled.float()
        )
    np.testing.assert_allclose(found, expected.numpy(), rtol=1e-4, atol=1e-4)
    assert np.ptp(found, axis=0).min() > 1e-3


def test_training_resumes_with_identical_results() -> None:
    config = settings()

    def advance(state: TrainingState) -> TrainingState:
        train(state, ranked(config, RECORD), config)
        return state

    straight = advance(advance(untrained(config, spec(RECORD))))
    first = advance(untrained(config, spec(RECORD)))
    weights, optimizer = encode_weights(first.weights), encode_optimizer(first)
    resumed = advance(decode_state(1, weights, optimizer, config, spec(RECORD)))
    assert arrays_digest(resumed.weights) == arrays_digest(straight.weights)
    assert encode_optimizer(resumed) == encode_optimizer(straight)


def test_training_is_invariant_to_units() -> None:
    """An environment in other units gives the same agent, up to rounding."""
    config = settings(baseline="none", n_updates_per_iter=20)
    losses = []
    for unit in (1.0, 1000.0):
        held = Experience(config, spec(VECTOR))
        for number in range(3):
            one = episode(VECTOR, number)
            one.observations[:] *= unit
            held.add(one)
        state = untrained(config, spec(VECTOR))
        train(state, held.by_rank([0, 1, 2]), config)
        losses.append(state.loss)
    assert losses[0] == pytest.approx(losses[1], rel=1e-3)
