"""The acting graph: equality with torch, independence of the batch, and rejected graphs."""

from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from udrl import inference as module
from udrl.actions import Categorical, Product
from udrl.architecture import state_sizes
from udrl.behavior import BehaviorFunction, initialise
from udrl.config import Config, build
from udrl.environments.specification import EnvironmentSpec
from udrl.errors import InvalidWeights
from udrl.frame_stack import Seen
from udrl.graph import acting_graph, weight_shapes
from udrl.inference import ActingFunction, Call, is_exact_in_batch, probe_rows, probe_weights
from udrl.spaces import (
    Bits,
    Categories,
    Category,
    Image,
    Leaf,
    Record,
    Vector,
    leaves_of,
)
from udrl.training import weights_of

VECTOR = EnvironmentSpec(
    observation_space=Vector(size=4), action_space=Categorical(n=3), max_episode_steps=500
)
IMAGE = EnvironmentSpec(
    observation_space=Image(channels=1, height=16, width=16),
    action_space=Categorical(n=3),
    max_episode_steps=500,
)
RECORD = EnvironmentSpec(
    observation_space=Record(
        (
            Leaf(("bag", 0), Vector(size=3)),
            Leaf(("bag", 1), Bits(size=5)),
            Leaf(("here",), Category(n=7)),
            Leaf(("map",), Image(channels=3, height=9, width=8)),
            Leaf(("tools",), Categories(ns=(2, 5))),
        )
    ),
    action_space=Product(ns=(3, 2, 4)),
    max_episode_steps=500,
)
MASKED = EnvironmentSpec(
    observation_space=Record((Leaf(("a",), Vector(size=3)), Leaf(("may",), Bits(size=5)))),
    action_space=Product(ns=(3, 2)),
    max_episode_steps=500,
    action_mask=1,
)
CATEGORY = EnvironmentSpec(
    observation_space=Category(n=7), action_space=Categorical(n=3), max_episode_steps=500
)
KINDS: list[tuple[EnvironmentSpec, dict[str, Any]]] = [
    (VECTOR, {}),
    (VECTOR, {"hidden": [32]}),
    (VECTOR, {"horizon_equals_return": True, "activation": "tanh"}),
    (VECTOR, {"frame_stack": 3}),
    (VECTOR, {"baseline": "value"}),
    (VECTOR, {"baseline": "value", "advantage_bound": 6.0}),
    (VECTOR, {"baseline": "value", "horizon_equals_return": True}),
    (VECTOR, {"baseline": "action_value"}),
    (CATEGORY, {}),
    (CATEGORY, {"frame_stack": 3, "baseline": "value"}),
    (IMAGE, {}),
    (IMAGE, {"frame_stack": 4, "activation": "tanh"}),
    (IMAGE, {"frame_stack": 4, "baseline": "value"}),
    (RECORD, {}),
    (RECORD, {"frame_stack": 3, "baseline": "value", "activation": "tanh"}),
    (VECTOR, {"memory": "gru", "memory_size": 12}),
    (VECTOR, {"memory": "gru", "baseline": "value", "frame_stack": 2}),
    (IMAGE, {"memory": "gru", "baseline": "action_value"}),
    (MASKED, {"frame_stack": 2, "baseline": "value"}),
    (MASKED, {"memory": "gru"}),
    (RECORD, {"memory": "gru", "baseline": "value", "observe_previous": True}),
    (RECORD, {"baseline": "action_value", "normalise_observations": True}),
    (VECTOR, {"baseline": "value", "normalise_observations": True, "frame_stack": 2}),
    (VECTOR, {"baseline": "value", "guidance_kl": 0.03}),
    (VECTOR, {"guidance_kl": 0.03}),
    (RECORD, {"baseline": "action_value", "guidance_kl": 0.03, "memory": "gru"}),
    (MASKED, {"baseline": "value", "guidance_kl": 0.03, "frame_stack": 2}),
]
each_kind = pytest.mark.parametrize(("spec", "values"), KINDS)


def settings(**values: Any) -> Config:
    small = {"environment": "Any-v0", "hidden": [16, 32], "convolutions": [4, 8]}
    return build(Config, small | {"return_scale": 0.02} | values)


def acting(config: Config, behavior: BehaviorFunction, spec: EnvironmentSpec) -> ActingFunction:
    return ActingFunction(acting_graph(config.network, spec), weights_of(behavior))


def read(config: Config, command: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """The network's inputs for a command (2.3.2, 3.1), one number at a time."""
    rows = []
    for desired_return, desired_horizon in command.tolist():
        if config.network.horizon_equals_return:
            horizon, least = float(np.floor(desired_return)), 1.0
        else:
            horizon, least = desired_horizon, -np.inf
        rows.append(
            [
                max(desired_return, least) * config.network.return_scale,
                max(horizon, 1.0) * config.network.horizon_scale,
            ]
        )
    return np.array(rows, np.float32)


def picked(seen: Seen, rows: Any) -> Seen:
    return tuple(one[rows] for one in seen)


def fill(call: Call, seen: Seen, command: np.ndarray[Any, Any]) -> None:
    for target, one in zip(call.seen, seen, strict=True):
        target[:] = one
    call.command[:] = command


@pytest.mark.parametrize("weights", ["initial", "far from it"])
@each_kind
def test_graph_equals_the_trained_network(
    spec: EnvironmentSpec, values: dict[str, Any], weights: str
) -> None:
    config = settings(**values)
    behavior = initialise(config, spec)
    if weights == "far from it":
        torch.manual_seed(1)
        with torch.no_grad():
            for parameter in behavior.parameters():
                parameter.add_(0.3 * torch.randn_like(parameter))
            if behavior.guidance is not None:
                behavior.guidance.copy_(torch.tensor([[1.5, -1.0]]))
    function = acting(config, behavior, spec)
    seen, command, state = probe_rows(function, 64)
    if spec.action_mask is not None:
        seen[spec.action_mask][:] = seen[spec.action_mask] % 2
    if isinstance(spec.observation_space, Category):
        seen = (np.arange(seen[0].size, dtype=np.int32).reshape(seen[0].shape) % 7,)
    found = function.logits(seen, command, state)
    with torch.inference_mode():
        shown = tuple(map(torch.tensor, seen))
        states = torch.tensor(state).split(state_sizes(config.network), dim=1)
        expected = behavior(shown, torch.tensor(read(config, command)), states).numpy()
    assert found.dtype == np.float32
    size = max(1.0, float(np.abs(expected).max()))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * size)
    assert np.ptp(found, axis=0).min() > 0.01, (
        "rows must differ for the comparison to mean anything"
    )


@each_kind
def test_graph_weights_are_those_of_the_network(
    spec: EnvironmentSpec, values: dict[str, Any]
) -> None:
    config = settings(**values)
    expected = {n: t.shape for n, t in weights_of(initialise(config, spec)).items()}
    assert weight_shapes(acting_graph(config.network, spec)) == expected


@each_kind
def test_model_is_valid_onnx_and_equals_the_reference_evaluator(
    spec: EnvironmentSpec, values: dict[str, Any]
) -> None:
    config = settings(**values)
    function = acting(config, initialise(config, spec), spec)
    model = onnx.load_from_string(function.model)
    onnx.checker.check_model(model, full_check=True)
    assert (model.ir_version, model.opset_import[0].version) == (7, 13)
    seen, command, state = probe_rows(function, 5)
    names = [f"observation{leaf.name}" for leaf in leaves_of(spec.observation_space)]
    given = {**dict(zip(names, seen, strict=True)), "command": command}
    if state.size:
        given["state"] = state
    found, *after = onnxruntime.InferenceSession(function.model).run(None, given)
    logits, next_state = function.advance(seen, command, state)
    np.testing.assert_allclose(found, logits, rtol=1e-5, atol=1e-6)
    for one in after:
        np.testing.assert_allclose(one, next_state, rtol=1e-5, atol=1e-6)
    assert bool(after) == bool(state.size)


@each_kind
def test_row_is_bit_identical_in_any_batch(spec: EnvironmentSpec, values: dict[str, Any]) -> None:
    config = settings(**values)
    function = acting(config, initialise(config, spec), spec)
    seen, command, state = probe_rows(function, 40)
    alone, after = function.advance(seen, command, state)
    rng = np.random.default_rng(1)
    for n in (1, 2, 3, 7, 16, 33, 40):
        rows = rng.permutation(40)[:n]
        call = function.call(n)
        fill(call, picked(seen, rows), command[rows])
        call.state[:] = state[rows]
        call.run()
        assert np.array_equal(call.logits, alone[rows]), n
        assert np.array_equal(call.next_state, after[rows]), n


def test_rows_are_computed_one_by_one_where_batches_change_bits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = settings()
    graph = acting_graph(config.network, VECTOR)
    sizes = []

    def never(graph: bytes, n: int) -> bool:
        sizes.append(n)
        return False

    monkeypatch.setattr(module, "is_exact_in_batch", never)
    function = ActingFunction(graph, probe_weights(graph))
    seen, command, _ = probe_rows(function, 6)
    call = function.call(6)
    assert isinstance(call, module._RowByRowCall)
    for rows in ([0, 1, 2, 3, 4, 5], [5, 4, 3, 2, 1, 0]):
        fill(call, picked(seen, rows), command[rows])
        call.run()
        assert np.array_equal(call.logits, function.logits(picked(seen, rows), command[rows]))
    assert sizes == [6]


def test_batch_dependent_rounding_is_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    config = settings(seed=3, hidden=[48])
    graph = acting_graph(config.network, VECTOR)
    run = module._BatchCall.run

    def last_differs(self: module._BatchCall) -> None:
        run(self)
        if len(self.logits) > 1:
            self.logits[-1] = np.nextafter(self.logits[-1], np.float32(np.inf))

    is_exact_in_batch.cache_clear()
    with monkeypatch.context() as patch:
        patch.setattr(module._BatchCall, "run", last_differs)
        assert not is_exact_in_batch(graph, 4)
    is_exact_in_batch.cache_clear()
    assert is_exact_in_batch(graph, 4)


def test_graph_is_a_function_of_settings_and_spaces() -> None:
    assert acting_graph(settings().network, VECTOR) == acting_graph(settings().network, VECTOR)
    assert acting_graph(settings().network, VECTOR) != acting_graph(
        settings(hidden=[8]).network, VECTOR
    )


def test_probe_weights_are_bounded_by_the_inputs_of_a_unit() -> None:
    weights = probe_weights(acting_graph(settings().network, VECTOR))
    assert np.abs(weights["layers.0.weight"]).max() <= 0.25
    assert np.abs(weights["layers.0.weight"]).max() > 0.2
    assert {w.dtype for w in weights.values()} == {np.dtype(np.float32)}


@given(st.binary(min_size=1, max_size=200))
def test_garbage_is_rejected(garbage: bytes) -> None:
    with pytest.raises(InvalidWeights, match="acting graph"):
        ActingFunction(garbage, {})


def test_graph_with_missing_weights_is_rejected() -> None:
    graph = acting_graph(settings().network, VECTOR)
    weights = dict(probe_weights(graph))
    del weights["action.bias"]
    with pytest.raises(InvalidWeights, match=r"action\.bias"):
        ActingFunction(graph, weights)
