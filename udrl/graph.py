"""The acting graph: the behavior function as an ONNX model (sections 2.3.2 and 3.2).

Acting always computes this graph in ONNX Runtime; :mod:`udrl.behavior` is the same function in
torch, for training. A graph without values belongs to a run and defines names and shapes of its
weights. With the weights of a version it becomes an :class:`udrl.inference.ActingFunction`.

Inputs: ``observation``, the stacked observations ([batch, *shape], :mod:`udrl.frame_stack`); for a
record one input for each leaf, with its path in the name, e.g. ``observation['inventory'][2]``; and
``command``, desired return and desired horizon, neither bounded nor scaled (float64 [batch, 2]).
Output: ``logits``, the parameters of P(a | s, c), float32 [batch, n_parameters]. With a memory,
there is another input, ``state``, float32 [batch, size], zeros at an episode's first step, and
another output, ``next_state``, the state at the next step.
"""

from collections.abc import Mapping
from functools import partial
from importlib import import_module
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import onnx
from google.protobuf.message import DecodeError
from onnx import TensorProto, helper, numpy_helper

from udrl.architecture import (
    CUSTOM,
    FILTER,
    FORBIDDEN,
    GUIDANCE,
    MIN_DEVIATION,
    NORMAL_BOUND,
    NORMALISER,
    PADDING,
    SQUAREPLUS,
    STRIDE,
    VALUE_WIDTH,
    layer_widths,
    n_features,
    state_sizes,
)
from udrl.environments.specification import EnvironmentSpec
from udrl.errors import ConfigError, InvalidWeights
from udrl.frame_stack import FrameStack
from udrl.onnx_nodes import OPSET, Nodes
from udrl.setting_groups import NetworkSettings
from udrl.spaces import Bits, Categories, Category, Image, Record, leaves_of
from udrl.targets import ReturnInTime

#: The tensors of a weights version by name, float32.
Weights = Mapping[str, npt.NDArray[np.float32]]

# The oldest version that the operator set allows, so that old runtimes can read exported agents.
_IR_VERSION = 7

_OPERATORS = {"relu": "Relu", "tanh": "Tanh"}


def acting_graph(network: NetworkSettings, spec: EnvironmentSpec) -> bytes:
    """Return the graph of a run: an ONNX model whose weights have no values.

    Raises:
        ConfigError: a custom behavior function cannot be created or exported.
    """
    graph = _Builder(network, spec)
    graph.logits()
    return graph.model()


def weight_shapes(graph: bytes) -> dict[str, tuple[int, ...]]:
    """Return the shape of each tensor of a weights version, by name.

    Raises:
        InvalidWeights: the graph is invalid.
    """
    return {t.name: tuple(t.dims) for t in _parse(graph).graph.initializer if not t.raw_data}


def critic_shapes(network: NetworkSettings, spec: EnvironmentSpec) -> dict[str, tuple[int, ...]]:
    """Return the shape of each tensor of a run's critic (:mod:`udrl.value`), if it has one."""
    if network.baseline != "action_value":
        return {}
    graph = _Builder(network, spec)
    graph.action_values()
    return weight_shapes(graph.model())


class _Builder(Nodes):
    """Appends the networks of a run; each method returns the name of a result."""

    def __init__(self, network: NetworkSettings, spec: EnvironmentSpec) -> None:
        super().__init__()
        self._network = network
        self._spec = spec
        self._space = spec.observation_space
        self._leaves = [(f"observation{leaf.name}", leaf.space) for leaf in leaves_of(self._space)]
        self._shapes = FrameStack(self._space, network.frame_stack).shapes
        self._mask = spec.action_mask
        self._n_parameters = spec.action_space.n_parameters
        self._target = ReturnInTime(network)
        self._states: list[str] = []  # outputs with the memories' next states

    def model(self) -> bytes:
        """Return the model, whose output is that of the last node."""
        observed = [
            helper.make_tensor_value_info(
                name, helper.np_dtype_to_tensor_dtype(leaf.dtype), ["batch", *shape]
            )
            for (name, leaf), shape in zip(self._leaves, self._shapes, strict=True)
        ]
        self.nodes[-1].output[0] = "logits"
        outputs, states = [("logits", self._n_parameters)], []
        if self._states:
            size = sum(state_sizes(self._network))
            states = [helper.make_tensor_value_info("state", TensorProto.FLOAT, ["batch", size])]
            # Appended after the output of the last node is renamed to logits.
            self.nodes.append(helper.make_node("Concat", self._states, ["next_state"], axis=1))
            outputs.append(("next_state", size))
        graph = helper.make_graph(
            self.nodes,
            "behavior_function",
            [
                *observed,
                helper.make_tensor_value_info(
                    "command", TensorProto.DOUBLE, ["batch", self._target.size]
                ),
                *states,
            ],
            [
                helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])
                for name, size in outputs
            ],
            self.tensors,
        )
        model = helper.make_model(
            graph,
            producer_name="udrl",
            ir_version=_IR_VERSION,
            opset_imports=[helper.make_opsetid("", OPSET)],
        )
        serialised: bytes = model.SerializeToString(deterministic=True)
        return serialised

    def logits(self) -> str:
        """Append the network of section 3.2; see :class:`udrl.behavior.BehaviorFunction`."""
        network = self._network
        respond = self._custom
        if network.behavior is None:
            features = self._encode("encoder", _OPERATORS[network.activation], network.hidden[0])
            if network.memory != "none":
                n_in = n_features(self._space, network.convolutions, network.hidden[0])
                features = self._remember("memory", features, n_in, network.memory_size)
            respond = partial(self._respond, features)
        command = self._relative_command()
        logits = respond(command)
        if network.is_guided:
            logits = self._guided(logits, respond(self._lowest(command)))
        return logits if self._mask is None else self._masked(logits)

    def _respond(self, features: str, command: str) -> str:
        """Append the layers that read a command, given the features of the observation."""
        activation = _OPERATORS[self._network.activation]
        first, *_ = widths = layer_widths(self._space, self._network)
        gate = self.append("Sigmoid", self.layer("command", command, self._target.size, first))
        features = self.append("Mul", features, gate)
        for k, (n_in, n_out) in enumerate(pairwise(widths)):
            features = self.append(activation, self.layer(f"layers.{k}", features, n_in, n_out))
        return self.layer("action", features, widths[-1], self._n_parameters)

    def _lowest(self, command: str) -> str:
        """Append the command with the lowest return."""
        lowest = self.column(self.weight(GUIDANCE, 1, 2), 1)
        kept = self.append("Mul", command, self.constant(np.array([[0.0, 1.0]], np.float32)))
        placed = self.append("Mul", lowest, self.constant(np.array([[1.0, 0.0]], np.float32)))
        return self.append("Add", kept, placed)

    def _guided(self, logits: str, lowest: str) -> str:
        """Append the guided logits; see :mod:`udrl.guidance`."""
        above = self.append("Sub", logits, lowest)
        step = self.append("Mul", above, self.column(self.weight(GUIDANCE, 1, 2), 0))
        return self.append("Add", logits, step)

    def _custom(self, command: str) -> str:
        """Append a custom network, as exported by torch; see :mod:`udrl.custom_networks`."""
        # Imported here, because it imports torch, which no other graph needs.
        try:
            exported = import_module("udrl.custom_networks").exported
        except ModuleNotFoundError as error:
            raise ConfigError(
                f"behavior {self._network.behavior!r} needs {error.name} where its run is created; "
                f'install it with: pip install "udrl[train]"'
            ) from error
        model: onnx.ModelProto = exported(self._network, self._spec)
        given = [*(name for name, _ in self._leaves), command]
        names = dict(zip([one.name for one in model.graph.input], given, strict=True))
        for tensor in model.graph.initializer:
            if tensor.raw_data:
                names[tensor.name] = self.constant(numpy_helper.to_array(tensor))
            else:
                names[tensor.name] = self.weight(f"{CUSTOM}.{tensor.name}", *tensor.dims)
        for node in model.graph.node:
            copy = onnx.NodeProto()
            copy.CopyFrom(node)
            copy.name = ""
            copy.input[:] = [names[name] if name else "" for name in node.input]
            for name in node.output:
                names[name] = f"{CUSTOM}.{len(self.nodes)}.{name}"
            copy.output[:] = [names[name] for name in node.output]
            self.nodes.append(copy)
        # model() renames the output of the last node.
        return self.append("Identity", names[model.graph.output[0].name])

    def _relative_command(self) -> str:
        """Append the command as the behavior function reads it."""
        command = self._command()
        return command if self._network.baseline == "none" else self._relative(command)

    def _masked(self, logits: str) -> str:
        """Append the action mask: add a large negative number to logits of masked actions.

        Only the newest mask of the stack counts.
        """
        n = self._n_parameters
        length = self._network.frame_stack
        mask = self.columns(self._leaves[self._mask or 0][0], (length - 1) * n, length * n)
        allowed = self.append("Cast", mask, to=TensorProto.FLOAT)
        forbidden = self.append("Sub", allowed, self.number(1.0))
        return self.append("Sub", logits, self.append("Mul", forbidden, self.number(FORBIDDEN)))

    def action_values(self) -> str:
        """Append the critic; see :class:`udrl.value.Critic`."""
        return self._expected("critic", self._n_parameters)

    def _command(self) -> str:
        """Append the command, bounded and scaled (:mod:`udrl.targets`)."""
        command, target = "command", self._target
        if target.horizon_follows:
            desired_return = self.column(command, 0)
            horizon = self.append("Floor", desired_return)
            command = self.append("Concat", desired_return, horizon, axis=1)
        bounded = self.append("Max", command, self.constant(np.array([target.least])))
        scaled = self.append("Mul", bounded, self.constant(np.array([target.scales])))
        return self.append("Cast", scaled, to=TensorProto.FLOAT)

    def _relative(self, command: str) -> str:
        """Append the desired return relative to V(s) and D(s); see :mod:`udrl.value`."""
        expected = self._expected("value", 2)
        d = self.column(expected, 1)
        root = self.append("Mul", d, d)
        root = self.append("Sqrt", self.append("Add", root, self.number(SQUAREPLUS)))
        deviation = self.append("Mul", self.append("Add", d, root), self.number(0.5))
        deviation = self.append("Add", deviation, self.number(MIN_DEVIATION))
        above = self.append("Sub", self.column(command, 0), self.column(expected, 0))
        bound = self._network.advantage_bound
        bounded = self.append(
            "Clip", self.append("Div", above, deviation), self.number(-bound), self.number(bound)
        )
        return self.append("Concat", bounded, self.column(command, 1), axis=1)

    def _expected(self, name: str, n: int) -> str:
        """Append a network with ``n`` outputs, a value function or critic (:mod:`udrl.value`)."""
        features = self._encode(f"{name}.encoder", "Tanh", VALUE_WIDTH)
        width = n_features(self._space, self._network.convolutions, VALUE_WIDTH)
        if self._network.memory != "none":
            features = self._remember(f"{name}.memory", features, width, VALUE_WIDTH)
            width = VALUE_WIDTH
        features = self.append("Tanh", self.layer(f"{name}.hidden", features, width, VALUE_WIDTH))
        return self.layer(f"{name}.expected", features, VALUE_WIDTH, n)

    def _remember(self, name: str, features: str, n_in: int, size: int) -> str:
        """Append a gated recurrent unit; see :class:`udrl.recurrence.Memory`."""
        first = sum(state_sizes(self._network)[: len(self._states)])
        before = self.columns("state", first, first + size)
        gates = []
        for given, of, n in ((features, "ih", n_in), (before, "hh", size)):
            weight = self.weight(f"{name}.cell.weight_{of}_l0", 3 * size, n)
            bias = self.weight(f"{name}.cell.bias_{of}_l0", 3 * size)
            all_ = self.append("Gemm", given, weight, bias, transB=1)
            gates.append([self.columns(all_, k * size, (k + 1) * size) for k in range(3)])
        (r_in, z_in, new_in), (r_state, z_state, new_state) = gates
        r = self.append("Sigmoid", self.append("Add", r_in, r_state))
        z = self.append("Sigmoid", self.append("Add", z_in, z_state))
        new = self.append("Tanh", self.append("Add", new_in, self.append("Mul", r, new_state)))
        # (1 - z) new + z before
        kept = self.append("Mul", z, self.append("Sub", before, new))
        self._states.append(self.append("Add", new, kept))
        return self._states[-1]

    def _encode(self, name: str, activation: str, width: int) -> str:
        """Append an encoder; see :func:`udrl.encoders.make_encoder`."""
        if not isinstance(self._space, Record):
            return self._encode_leaf(0, name, activation, width)
        channels = self._network.convolutions
        features = [
            self._encode_leaf(k, f"{name}.leaves.{k}", activation, width)
            for k in range(len(self._leaves))
        ]
        together = sum(n_features(leaf, channels, width) for _, leaf in self._leaves)
        joined = self.append("Concat", *features, axis=1)
        return self.append(activation, self.layer(f"{name}.joined", joined, together, width))

    def _encode_leaf(self, number: int, name: str, activation: str, width: int) -> str:
        """Append the encoder of the leaf with index ``number``."""
        (observation, leaf), (first, *_) = self._leaves[number], self._shapes[number]
        match leaf:
            case Image():
                return self._convolutions(observation, first, f"{name}.layers", activation)
            case Category(n=n):
                features = self._embedding(observation, name, (n,), width)
            case Categories(ns=ns):
                features = self._embedding(observation, name, ns, width)
            case Bits():
                numbers = self.append("Cast", observation, to=TensorProto.FLOAT)
                features = self.layer(f"{name}.layer", numbers, first, width)
            case _:
                if self._network.normalise_observations:
                    observation = self._normalised(observation, f"{name}.{NORMALISER}", first)
                features = self.layer(f"{name}.layer", observation, first, width)
        return self.append(activation, features)

    def _normalised(self, observation: str, name: str, size: int) -> str:
        """Append a normalised vector; see :class:`udrl.encoders.Normaliser`."""
        above = self.append("Sub", observation, self.weight(f"{name}.mean", size))
        scaled = self.append("Mul", above, self.weight(f"{name}.scale", size))
        return self.append("Clip", scaled, self.number(-NORMAL_BOUND), self.number(NORMAL_BOUND))

    def _embedding(self, observation: str, name: str, ns: tuple[int, ...], width: int) -> str:
        """Append the sum of learned vectors; see :class:`udrl.encoders.CategoryEncoder`."""
        sizes = np.array(ns * self._network.frame_stack, np.int32)
        table = self.weight(f"{name}.embedding.weight", int(sizes.sum()), width)
        first = self.constant(np.cumsum(sizes, dtype=np.int32) - sizes)
        vectors = self.append("Gather", table, self.append("Add", observation, first))
        features = self.append("ReduceSum", vectors, self.constant(np.array([1])), keepdims=0)
        return self.append("Add", features, self.weight(f"{name}.bias", width))

    def _convolutions(self, observation: str, n_channels: int, name: str, activation: str) -> str:
        """Append the layers for an image; see :class:`udrl.encoders.ImageEncoder`."""
        features = self.append("Cast", observation, to=TensorProto.FLOAT)
        features = self.append("Mul", features, self.number(1 / 255))
        channels = pairwise((n_channels, *self._network.convolutions))
        for k, (n_in, n_out) in enumerate(channels):
            weight = self.weight(f"{name}.{k}.weight", n_out, n_in, FILTER, FILTER)
            bias = self.weight(f"{name}.{k}.bias", n_out)
            features = self.append(
                "Conv", features, weight, bias,
                kernel_shape=[FILTER] * 2, strides=[STRIDE] * 2, pads=[PADDING] * 4,
            )  # fmt: skip
            features = self.append(activation, features)
        return self.append("Flatten", features)


def _parse(graph: bytes) -> onnx.ModelProto:
    try:
        model: onnx.ModelProto = onnx.ModelProto.FromString(graph)
    except DecodeError as error:
        raise InvalidWeights(f"acting graph: not an ONNX model: {error}") from error
    return model


def with_weights(graph: bytes, weights: Weights) -> bytes:
    """Return a graph with the values of its weights.

    Raises:
        InvalidWeights: the graph is invalid, or the weights do not belong to it.
    """
    model = _parse(graph)
    for tensor in model.graph.initializer:
        if not tensor.raw_data:
            values = weights.get(tensor.name)
            if values is None or values.shape != tuple(tensor.dims):
                found = "missing" if values is None else f"of shape {values.shape}"
                raise InvalidWeights(
                    f"acting graph: tensor {tensor.name!r} is {found}, expected "
                    f"{tuple(tensor.dims)}; the weights belong to another architecture"
                )
            tensor.raw_data = np.ascontiguousarray(values, "<f4").tobytes()
    serialised: bytes = model.SerializeToString(deterministic=True)
    return serialised
