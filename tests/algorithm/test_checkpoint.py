import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from udrl.actions import Categorical
from udrl.checkpoint import decode_state, encode_optimizer
from udrl.config import Config, build
from udrl.digests import arrays_digest
from udrl.environments import EnvironmentSpec
from udrl.episode import Episode
from udrl.errors import InvalidWeights
from udrl.experience import Experience, RankedExperience
from udrl.graph import acting_graph, weight_shapes
from udrl.spaces import Vector
from udrl.training import TrainingState, train, untrained
from udrl.weights import decode_weights, encode_weights

CONFIG = build(
    Config,
    {
        "environment": "CartPole-v1",
        "hidden": [8, 8],
        "batch_size": 16,
        "n_updates_per_iter": 5,
        "learning_rate": 1e-2,
    },
)
SPEC = EnvironmentSpec(
    observation_space=Vector(size=3), action_space=Categorical(n=2), max_episode_steps=20
)
SHAPES = weight_shapes(acting_graph(CONFIG.network, SPEC))


def experience() -> RankedExperience:
    rng = np.random.default_rng(1)
    held = Experience(CONFIG, SPEC)
    held.add(
        Episode(
            command_id=0,
            observations=rng.standard_normal((20, 3), np.float32),
            actions=rng.integers(2, size=20, dtype=np.uint8),
            rewards=rng.standard_normal(20, np.float32),
            terminated=True,
            truncated=False,
        )
    )
    return held.by_rank([0])


def trained(versions: int, config: Config = CONFIG) -> TrainingState:
    state = untrained(config, SPEC)
    for _ in range(versions):
        train(state, experience(), config)
    return state


def digest(state: TrainingState) -> bytes:
    return arrays_digest(state.weights)


def restored(state: TrainingState, config: Config = CONFIG) -> TrainingState:
    weights, optimizer = encode_weights(state.weights), encode_optimizer(state)
    return decode_state(state.version, weights, optimizer, config, SPEC)


def test_weights_round_trip_bit_identically() -> None:
    state = trained(1)
    assert arrays_digest(decode_weights(encode_weights(state.weights), SHAPES)) == digest(state)


def test_training_resumes_from_a_checkpoint_with_identical_results() -> None:
    straight, resumed = trained(3), restored(trained(1))
    assert resumed.version == 1
    for _ in range(2):
        train(resumed, experience(), CONFIG)
        resumed = restored(resumed)
    assert resumed.version == straight.version
    assert digest(resumed) == digest(straight)
    assert encode_optimizer(resumed) == encode_optimizer(straight)


def test_optimizer_state_affects_later_training() -> None:
    straight, forgetful = trained(2), untrained(CONFIG, SPEC)
    forgetful.behavior.load_state_dict(trained(1).behavior.state_dict())
    forgetful.version = 1
    train(forgetful, experience(), CONFIG)
    assert digest(forgetful) != digest(straight)


def test_checkpoint_is_a_copy() -> None:
    state = trained(1)
    copy = restored(state)
    before = digest(copy)
    train(state, experience(), CONFIG)
    assert digest(copy) == before


def test_equal_states_have_equal_encodings() -> None:
    assert encode_weights(trained(1).weights) == encode_weights(trained(1).weights)
    assert encode_optimizer(trained(1)) == encode_optimizer(trained(1))


def test_version_0_has_no_optimizer_state_and_cannot_be_restored_as_trained() -> None:
    state = untrained(CONFIG, SPEC)
    assert safetensors.torch.load(encode_optimizer(state)) == {}
    with pytest.raises(InvalidWeights, match="missing or surplus"):
        restored(state)


Change = Callable[[dict[str, Tensor]], Any]

CHANGES: dict[str, tuple[Change, str]] = {
    "a tensor is missing": (
        lambda t: t.pop("command.bias"),
        r"tensors \['command.bias'\] are missing or surplus",
    ),
    "a tensor is surplus": (
        lambda t: t.update(extra=torch.zeros(1)),
        r"tensors \['extra'\] are missing or surplus",
    ),
    "a shape is wrong": (
        lambda t: t.update({"command.bias": torch.zeros(9)}),
        r"'command.bias' is float32 \(9,\), expected float32 \(8,\)",
    ),
    "a tensor is transposed": (
        lambda t: t.update({"command.weight": torch.zeros(2, 8)}),
        r"\(2, 8\), expected float32 \(8, 2\)",
    ),
    "a type is wrong": (
        lambda t: t.update({"command.bias": torch.zeros(8, dtype=torch.float64)}),
        r"'command.bias' is float64 \(8,\), expected float32",
    ),
    "a value is NaN": (
        lambda t: t["action.weight"].fill_(torch.nan),
        "'action.weight' has values that are not finite",
    ),
    "a value is infinite": (
        lambda t: t["action.bias"][0].fill_(-torch.inf),
        "'action.bias' has values that are not finite",
    ),
}


@pytest.mark.parametrize("what", CHANGES)
def test_mismatched_weights_are_rejected(what: str) -> None:
    change, complaint = CHANGES[what]
    tensors = {n: t.clone() for n, t in untrained(CONFIG, SPEC).behavior.state_dict().items()}
    change(tensors)
    with pytest.raises(InvalidWeights, match=complaint):
        decode_weights(safetensors.torch.save(tensors), SHAPES)


@pytest.mark.parametrize("what", CHANGES)
def test_mismatched_optimizer_state_is_rejected(what: str) -> None:
    state = trained(1)
    tensors = safetensors.torch.load(encode_optimizer(state))
    moments = {n[8:]: t for n, t in tensors.items() if n.startswith("exp_avg.")}
    rest = {n: t for n, t in tensors.items() if not n.startswith("exp_avg.")}
    change, complaint = CHANGES[what]
    change(moments)
    optimizer = safetensors.torch.save(rest | {f"exp_avg.{n}": t for n, t in moments.items()})
    with pytest.raises(InvalidWeights, match=re.sub("'(?=[a-z])", "'exp_avg.", complaint)):
        decode_state(1, encode_weights(state.weights), optimizer, CONFIG, SPEC)


def test_weights_of_another_architecture_are_rejected() -> None:
    other = untrained(build(Config, {"environment": "CartPole-v1", "hidden": [8]}), SPEC)
    with pytest.raises(InvalidWeights, match="the weights belong to another architecture"):
        decode_weights(encode_weights(other.weights), SHAPES)


@given(st.binary(max_size=200))
def test_garbage_is_rejected(garbage: bytes) -> None:
    with pytest.raises(InvalidWeights, match=r"not safetensors|missing or surplus"):
        decode_weights(garbage, SHAPES)


GOOD = encode_weights(untrained(CONFIG, SPEC).weights)


@given(st.integers(0, len(GOOD) - 1))
def test_truncated_checkpoint_is_rejected(length: int) -> None:
    with pytest.raises(InvalidWeights):
        decode_weights(GOOD[:length], SHAPES)


@given(st.integers(0, len(GOOD) - 1), st.integers(0, 255))
def test_changed_byte_is_rejected_or_decoded(place: int, value: int) -> None:
    damaged = bytearray(GOOD)
    damaged[place] = value
    try:
        weights = decode_weights(bytes(damaged), SHAPES)
    except InvalidWeights:
        return
    assert all(np.isfinite(tensor).all() for tensor in weights.values())
