"""The acting graph: the behavior function as an ONNX model (sections 2.3.2 and 3.2).

Everything that acts computes this graph in ONNX Runtime; :mod:`udrl.behavior` is the same function
in torch, for training. A graph without values belongs to a run and says what its weights are; with
the weights of one version it becomes an :class:`ActingFunction`.

Inputs: ``observation``, what the network sees ([batch, *stacked_shape], float32 vectors or uint8
images), and ``command``, desired return and desired horizon, neither bounded nor scaled (float64
[batch, 2]). Output: ``logits`` of P(a | s, c), float32 [batch, n_actions].
"""

import functools
import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import onnx
import onnxruntime
from google.protobuf.message import DecodeError
from onnx import TensorProto, helper, numpy_helper

from udrl.architecture import (
    DEVIATIONS,
    FILTER,
    LEAST_DEVIATION,
    PADDING,
    SQUAREPLUS,
    STRIDE,
    VALUE_WIDTH,
    image_features,
    stacked_shape,
)
from udrl.config import Config
from udrl.environments.making import EnvironmentSpec
from udrl.errors import InvalidWeights
from udrl.streams import Purpose, Stream, stream_key

#: The tensors of a weights version by name, float32.
Weights = Mapping[str, npt.NDArray[np.float32]]

Observations = npt.NDArray[np.generic]
Commands = npt.NDArray[np.float64]
Logits = npt.NDArray[np.float32]

# As old as the operators below allow, so that old runtimes can read an exported agent.
_OPSET, _IR_VERSION = 13, 7

_OPERATORS = {"relu": "Relu", "tanh": "Tanh"}


def acting_graph(config: Config, spec: EnvironmentSpec) -> bytes:
    """Return the graph of a run, an ONNX model whose weights have no values yet."""
    graph = _Builder(config, spec)
    graph.logits()
    return graph.model()


def weight_shapes(graph: bytes) -> dict[str, tuple[int, ...]]:
    """Return the shape of each tensor of a weights version, by name.

    Raises:
        InvalidWeights: the bytes are no graph.
    """
    return {t.name: tuple(t.dims) for t in _parse(graph).graph.initializer if not t.raw_data}


class _Builder:
    """Appends nodes; each method returns the name of a result."""

    def __init__(self, config: Config, spec: EnvironmentSpec) -> None:
        self._config = config
        self._spec = spec
        self._shape = stacked_shape(spec, config)
        self._nodes: list[onnx.NodeProto] = []
        self._tensors: list[onnx.TensorProto] = []

    def model(self) -> bytes:
        """Return the model, with what was appended last as its output."""
        seen = TensorProto.UINT8 if self._spec.is_image else TensorProto.FLOAT
        self._nodes[-1].output[0] = "logits"
        graph = helper.make_graph(
            self._nodes,
            "behavior_function",
            [
                helper.make_tensor_value_info("observation", seen, ["batch", *self._shape]),
                helper.make_tensor_value_info("command", TensorProto.DOUBLE, ["batch", 2]),
            ],
            [
                helper.make_tensor_value_info(
                    "logits", TensorProto.FLOAT, ["batch", self._spec.n_actions]
                )
            ],
            self._tensors,
        )
        model = helper.make_model(
            graph,
            producer_name="udrl",
            ir_version=_IR_VERSION,
            opset_imports=[helper.make_opsetid("", _OPSET)],
        )
        serialised: bytes = model.SerializeToString(deterministic=True)
        return serialised

    def logits(self) -> str:
        """Append the network of section 3.2; see :class:`udrl.behavior.BehaviorFunction`."""
        config, spec = self._config, self._spec
        activation = _OPERATORS[config.activation]
        command = self._command()
        if config.baseline == "value":
            command = self._relative(command)
        if spec.is_image:
            features = self._convolutions("convolutions", activation)
            first = image_features(self._shape, config.convolutions)
            widths = (first, *config.hidden)
        else:
            first, *_ = widths = config.hidden
            features = self._append(
                activation, self._layer("observation", "observation", self._shape[0], first)
            )
        gate = self._append("Sigmoid", self._layer("command", command, 2, first))
        features = self._append("Mul", features, gate)
        for k, (n_in, n_out) in enumerate(pairwise(widths)):
            features = self._append(activation, self._layer(f"layers.{k}", features, n_in, n_out))
        return self._layer("action", features, widths[-1], spec.n_actions)

    def _command(self) -> str:
        """Append what is read of a command: bounded and scaled (sections 2.3.2 and 3.1)."""
        command, least = "command", [-math.inf, 1.0]
        if self._config.desired_horizon == "return":
            desired_return = self._column(command, 0)
            horizon = self._append("Floor", desired_return)
            command, least = self._append("Concat", desired_return, horizon, axis=1), [1.0, 1.0]
        scales = [self._config.return_scale, self._config.horizon_scale]
        bounded = self._append("Max", command, self._constant(np.array([least])))
        scaled = self._append("Mul", bounded, self._constant(np.array([scales])))
        return self._append("Cast", scaled, to=TensorProto.FLOAT)

    def _relative(self, command: str) -> str:
        """Append the desired return relative to V(s) and D(s); see :mod:`udrl.value`."""
        if self._spec.is_image:
            features = self._convolutions("value.encoder", "Tanh")
            n_features = image_features(self._shape, self._config.convolutions)
        else:
            n_features = VALUE_WIDTH
            features = self._append(
                "Tanh",
                self._layer("value.encoder.0", "observation", self._shape[0], n_features),
            )
        features = self._append(
            "Tanh", self._layer("value.hidden", features, n_features, VALUE_WIDTH)
        )
        expected = self._layer("value.expected", features, VALUE_WIDTH, 2)
        d = self._column(expected, 1)
        root = self._append("Mul", d, d)
        root = self._append("Sqrt", self._append("Add", root, self._number(SQUAREPLUS)))
        deviation = self._append("Mul", self._append("Add", d, root), self._number(0.5))
        deviation = self._append("Add", deviation, self._number(LEAST_DEVIATION))
        above = self._append("Sub", self._column(command, 0), self._column(expected, 0))
        bounded = self._append(
            "Clip",
            self._append("Div", above, deviation),
            self._number(-DEVIATIONS),
            self._number(DEVIATIONS),
        )
        return self._append("Concat", bounded, self._column(command, 1), axis=1)

    def _convolutions(self, name: str, activation: str) -> str:
        """Append an image encoder; see :func:`udrl.encoders.encode`."""
        features = self._append("Cast", "observation", to=TensorProto.FLOAT)
        features = self._append("Mul", features, self._number(1 / 255))
        channels = pairwise((self._shape[0], *self._config.convolutions))
        for k, (n_in, n_out) in enumerate(channels):
            weight = self._weight(f"{name}.{k}.weight", n_out, n_in, FILTER, FILTER)
            bias = self._weight(f"{name}.{k}.bias", n_out)
            features = self._append(
                "Conv", features, weight, bias,
                kernel_shape=[FILTER] * 2, strides=[STRIDE] * 2, pads=[PADDING] * 4,
            )  # fmt: skip
            features = self._append(activation, features)
        return self._append("Flatten", features)

    def _layer(self, name: str, features: str, n_in: int, n_out: int) -> str:
        """Append a fully connected layer, its weight stored as torch does."""
        weight = self._weight(f"{name}.weight", n_out, n_in)
        bias = self._weight(f"{name}.bias", n_out)
        return self._append("Gemm", features, weight, bias, transB=1)

    def _column(self, matrix: str, index: int) -> str:
        """Append the selection of one column, [batch, 1]."""
        first, last, axis = (self._constant(np.array([n])) for n in (index, index + 1, 1))
        return self._append("Slice", matrix, first, last, axis)

    def _weight(self, name: str, *shape: int) -> str:
        self._tensors.append(onnx.TensorProto(name=name, dims=shape, data_type=TensorProto.FLOAT))
        return name

    def _number(self, value: float) -> str:
        return self._constant(np.array(value, np.float32))

    def _constant(self, value: npt.NDArray[np.generic]) -> str:
        name = f"constant.{len(self._tensors)}"
        self._tensors.append(numpy_helper.from_array(value, name))
        return name

    def _append(self, operator: str, *inputs: str, **attributes: Any) -> str:
        output = f"{operator.lower()}.{len(self._nodes)}"
        self._nodes.append(helper.make_node(operator, inputs, [output], **attributes))
        return output


class Call(Protocol):
    """The rows of one call: fill in the inputs, run, read the logits; again and again.

    Attributes:
        observation: [n, *stacked_shape].
        command: desired return and desired horizon, float64 [n, 2].
        logits: float32 [n, n_actions], what the last run returned.
    """

    observation: Observations
    command: Commands
    logits: Logits

    def run(self) -> None:
        """Compute the logits."""
        ...


class Acting(Protocol):
    """What :mod:`udrl.acting` asks for actions: an :class:`ActingFunction`, or a stand-in."""

    def call(self, n: int) -> Call:
        """Return a call of ``n`` rows."""
        ...


class ActingFunction:
    """B(s, c; theta) of one weights version, ready to act.

    A row's logits are by definition those of a call with this row alone. Several rows go in one
    call where that gives the same bits, which is tried out once per process and number of rows.

    Args:
        graph: of the run (:func:`acting_graph`).
        weights: of the version.

    Raises:
        InvalidWeights: the bytes are no graph, or the weights are not those of the graph.
    """

    def __init__(self, graph: bytes, weights: Weights) -> None:
        self._graph = graph
        self.weights = weights
        self.model = _with_weights(graph, weights)
        self._session = _session(self.model)
        self._calls: dict[int, Call] = {}

    def call(self, n: int) -> Call:
        """Return a call of ``n`` rows. It is not for several threads at once."""
        if n not in self._calls:
            together = n == 1 or is_exact_together(self._graph, n)
            rows = _Together if together else _OneByOne
            self._calls[n] = rows(self._session, n)
        return self._calls[n]

    def logits(self, observation: Observations, command: Commands) -> Logits:
        """Return the logits of rows, float32 [n, n_actions]; for any thread."""
        rows = [
            self._session.run(None, {"observation": s[None], "command": c[None]})[0]
            for s, c in zip(observation, command, strict=True)
        ]
        return np.concatenate(rows)


class _Together:
    """All rows in one run of the session, with inputs and output bound to arrays."""

    def __init__(self, session: onnxruntime.InferenceSession, n: int) -> None:
        observation, command = session.get_inputs()
        (logits,) = session.get_outputs()
        seen = np.uint8 if observation.type == "tensor(uint8)" else np.float32
        self.observation: Observations = np.zeros((n, *observation.shape[1:]), seen)
        self.command = np.zeros((n, *command.shape[1:]))
        self.logits = np.zeros((n, *logits.shape[1:]), np.float32)
        self._session = session
        self._binding = session.io_binding()
        self._binding.bind_cpu_input("observation", self.observation)
        self._binding.bind_cpu_input("command", self.command)
        self._binding.bind_output(
            "logits", "cpu", 0, np.float32, self.logits.shape, self.logits.ctypes.data
        )

    def run(self) -> None:
        self._session.run_with_iobinding(self._binding)


class _OneByOne:
    """A run of the session for each row, on machines where company changes a row's bits."""

    def __init__(self, session: onnxruntime.InferenceSession, n: int) -> None:
        self._one = one = _Together(session, 1)
        self.observation = np.repeat(one.observation, n, axis=0)
        self.command = np.repeat(one.command, n, axis=0)
        self.logits = np.repeat(one.logits, n, axis=0)

    def run(self) -> None:
        one = self._one
        for row in range(len(self.logits)):
            one.observation[0], one.command[0] = self.observation[row], self.command[row]
            one.run()
            self.logits[row] = one.logits[0]


@functools.cache
def is_exact_together(graph: bytes, n: int) -> bool:
    """Say whether a call of ``n`` rows gives each the bits that a call for it alone gives."""
    function = _probe(graph)
    rows = _Together(function._session, n)
    rows.observation[:], rows.command[:] = probe_rows(function, n)
    rows.run()
    return np.array_equal(rows.logits, function.logits(rows.observation, rows.command))


@functools.lru_cache(maxsize=1)
def _probe(graph: bytes) -> ActingFunction:
    return ActingFunction(graph, probe_weights(graph))


def probe_weights(graph: bytes) -> Weights:
    """Return weights to try a machine's arithmetic with, which need no torch to be made.

    Tensor k, in the order of names, has the numbers of stream (0, probe, 0, k), mapped to +-1 /
    sqrt(inputs of a unit) and rounded to float32.
    """
    weights = {}
    for k, (name, shape) in enumerate(sorted(weight_shapes(graph).items())):
        numbers = Stream(stream_key(0, Purpose.PROBE, 0, k)).uniforms(math.prod(shape))
        bound = 1 / math.sqrt(math.prod(shape[1:]))  # rounded alike everywhere, as a power is not
        weights[name] = ((numbers * 2 - 1) * bound).astype(np.float32).reshape(shape)
    return weights


def probe_rows(function: ActingFunction, n: int) -> tuple[Observations, Commands]:
    """Return noise to look at: observations in [-2, 2) or bytes, commands in [-100, 100)."""
    like = function.call(1).observation
    stream = Stream(stream_key(0, Purpose.PROBE, 2, 0))
    numbers = stream.uniforms(n * like[0].size).reshape(n, *like.shape[1:])
    is_image = like.dtype == np.uint8
    seen = (numbers * 256 if is_image else numbers * 4 - 2).astype(like.dtype)
    command = stream.uniforms(2 * n).reshape(n, 2) * 200 - 100
    return seen, command


def _parse(graph: bytes) -> onnx.ModelProto:
    try:
        model: onnx.ModelProto = onnx.ModelProto.FromString(graph)
    except DecodeError as error:
        raise InvalidWeights(f"acting graph: not an ONNX model: {error}") from error
    return model


def _with_weights(graph: bytes, weights: Weights) -> bytes:
    """Return a graph with values."""
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


def _session(model: bytes) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    # More threads would only wait for each other in calls this small, and might sum otherwise.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # what it would print is in the error
    try:
        session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its errors have no base of their own
        raise InvalidWeights(
            f"acting graph: ONNX Runtime cannot read it: {error}; install the versions of onnx "
            f"and onnxruntime that the run was created with"
        ) from error
    names = [[one.name for one in ends] for ends in (session.get_inputs(), session.get_outputs())]
    if names != [["observation", "command"], ["logits"]]:
        raise InvalidWeights(
            f"acting graph: from {names[0]} to {names[1]}, expected from observation and command "
            f"to logits; the run was created by another version of udrl"
        )
    return session
