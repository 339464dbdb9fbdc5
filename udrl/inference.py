"""The behavior function for acting: a run's graph with a version's weights, in ONNX Runtime."""

import functools
import math
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import onnxruntime

from udrl.errors import InvalidWeights
from udrl.frame_stack import Seen
from udrl.graph import Weights, weight_shapes, with_weights
from udrl.spaces import noise
from udrl.streams import Purpose, Stream, stream_key

#: Dtypes of observations by ONNX Runtime's names.
_DTYPES: dict[str, np.dtype[Any]] = {
    "tensor(float)": np.dtype(np.float32),
    "tensor(uint8)": np.dtype(np.uint8),
    "tensor(int32)": np.dtype(np.int32),
}

Commands = npt.NDArray[np.float64]
Logits = npt.NDArray[np.float32]
MemoryState = npt.NDArray[np.float32]


_COMMAND, _STATE = "command", "state"


class Call(Protocol):
    """Arrays of one call, which can be reused: fill in the inputs, run, read the outputs.

    Attributes:
        seen: observations as the networks see them (:mod:`udrl.frame_stack`), [n, *shape] each.
        command: desired return and desired horizon, float64 [n, 2].
        state: state of the memory, float32 [n, size], zeros at an episode's first step; without a
            memory the size is 0.
        logits: output of the last run, float32 [n, n_parameters].
        next_state: output of the last run, the state at the next step, float32 [n, size].
    """

    seen: Seen
    command: Commands
    state: MemoryState
    logits: Logits
    next_state: MemoryState

    def run(self) -> None:
        """Compute the logits."""
        ...


class Acting(Protocol):
    """What :mod:`udrl.acting` needs of a behavior function: :class:`ActingFunction`, or a fake."""

    def call(self, n: int) -> Call:
        """Return a call of ``n`` rows."""
        ...


class ActingFunction:
    """B(s, c; theta) of one weights version, for acting.

    A row's logits are defined as those of a call with this row alone. Rows are computed in one
    batch only if that gives the same bits, which is tested once per process, graph and number of
    rows.

    Args:
        graph: acting graph of the run (:func:`udrl.graph.acting_graph`).
        weights: weights of the version.

    Attributes:
        graph: as given.
        weights: as given.

    Raises:
        InvalidWeights: the graph is invalid, or the weights do not belong to it.
    """

    def __init__(self, graph: bytes, weights: Weights) -> None:
        self.graph = graph
        self.weights = weights
        self._session = _session(self.model)
        self._calls: dict[int, Call] = {}

    @property
    def model(self) -> bytes:
        """The graph with the weights: a complete ONNX model."""
        return with_weights(self.graph, self.weights)

    def call(self, n: int) -> Call:
        """Return the call for ``n`` rows, always the same. Not thread-safe."""
        if n not in self._calls:
            exact = n == 1 or is_exact_in_batch(self.graph, n)
            kind = _BatchCall if exact else _RowByRowCall
            self._calls[n] = kind(self._session, n)
        return self._calls[n]

    @property
    def state_size(self) -> int:
        """Size of the memory's state per episode; 0 without a memory."""
        last = self._session.get_inputs()[-1]
        return int(last.shape[1]) if last.name == _STATE else 0

    def logits(self, seen: Seen, command: Commands, state: MemoryState | None = None) -> Logits:
        """Return the logits of rows, float32 [n, n_parameters]. Thread-safe.

        Args:
            seen: observations as the networks see them.
            command: desired return and desired horizon, float64 [n, 2].
            state: state of the memory; None: empty, as at an episode's first step.
        """
        return self.advance(seen, command, state)[0]

    def advance(
        self, seen: Seen, command: Commands, state: MemoryState | None = None
    ) -> tuple[Logits, MemoryState]:
        """Return the logits of rows, like :meth:`logits`, and the states at the next step."""
        names = [one.name for one in self._session.get_inputs()]
        given: list[npt.NDArray[Any]] = [*seen, command]
        if self.state_size:
            empty = np.zeros((len(command), self.state_size), np.float32)
            given.append(empty if state is None else state)
        rows = [
            self._session.run(None, {n: a[k : k + 1] for n, a in zip(names, given, strict=True)})
            for k in range(len(command))
        ]
        logits, *after = (np.concatenate(parts) for parts in zip(*rows, strict=True))
        return logits, after[0] if after else np.zeros((len(command), 0), np.float32)


class _BatchCall:
    """All rows in one run of the session, with inputs and outputs bound to arrays."""

    def __init__(self, session: onnxruntime.InferenceSession, n: int) -> None:
        inputs = {one.name: one for one in session.get_inputs()}
        logits, *after = session.get_outputs()
        observed = [one for name, one in inputs.items() if name not in (_COMMAND, _STATE)]
        command, size = inputs[_COMMAND], after[0].shape[1] if after else 0
        self.seen: Seen = tuple(np.zeros((n, *o.shape[1:]), _DTYPES[o.type]) for o in observed)
        self.state = np.zeros((n, size), np.float32)
        self.next_state = np.zeros((n, size), np.float32)
        self.command = np.zeros((n, *command.shape[1:]))
        self.logits = np.zeros((n, *logits.shape[1:]), np.float32)
        self._session = session
        self._binding = session.io_binding()
        for one, array in zip(observed, self.seen, strict=True):
            self._binding.bind_cpu_input(one.name, array)
        self._binding.bind_cpu_input(_COMMAND, self.command)
        if size:
            self._binding.bind_cpu_input(_STATE, self.state)
        for one, array in zip((logits, *after), (self.logits, self.next_state), strict=False):
            self._binding.bind_output(
                one.name, "cpu", 0, np.float32, array.shape, array.ctypes.data
            )

    def run(self) -> None:
        self._session.run_with_iobinding(self._binding)


class _RowByRowCall:
    """One run of the session per row, for machines on which batching changes a row's bits."""

    def __init__(self, session: onnxruntime.InferenceSession, n: int) -> None:
        self._one = one = _BatchCall(session, 1)
        self.seen: Seen = tuple(array.repeat(n, axis=0) for array in one.seen)
        self.command = one.command.repeat(n, axis=0)
        self.state = one.state.repeat(n, axis=0)
        self.logits = one.logits.repeat(n, axis=0)
        self.next_state = one.next_state.repeat(n, axis=0)

    def run(self) -> None:
        one = self._one
        for row in range(len(self.logits)):
            for mine, theirs in zip(one.seen, self.seen, strict=True):
                mine[0] = theirs[row]
            one.command[0], one.state[0] = self.command[row], self.state[row]
            one.run()
            self.logits[row], self.next_state[row] = one.logits[0], one.next_state[0]


@functools.cache
def is_exact_in_batch(graph: bytes, n: int) -> bool:
    """Return whether a batch of ``n`` rows gives the same bits as single calls, in a probe."""
    function = _probe(graph)
    rows = _BatchCall(function._session, n)
    seen, rows.command[:], rows.state[:] = probe_rows(function, n)
    for mine, probed in zip(rows.seen, seen, strict=True):
        mine[:] = probed
    rows.run()
    logits, after = function.advance(rows.seen, rows.command, rows.state)
    return np.array_equal(rows.logits, logits) and np.array_equal(rows.next_state, after)


@functools.lru_cache(maxsize=1)
def _probe(graph: bytes) -> ActingFunction:
    return ActingFunction(graph, probe_weights(graph))


def probe_weights(graph: bytes) -> Weights:
    """Return random weights for testing a machine's arithmetic. They do not require torch.

    Tensor k, in the order of names, has the numbers of stream (0, probe, 0, k), mapped to +-1 /
    sqrt(inputs of a unit) and rounded to float32.
    """
    weights = {}
    for k, (name, shape) in enumerate(sorted(weight_shapes(graph).items())):
        numbers = Stream(stream_key(0, Purpose.PROBE, 0, k)).uniforms(math.prod(shape))
        bound = 1 / math.sqrt(math.prod(shape[1:]))  # correctly rounded everywhere, unlike a power
        weights[name] = ((numbers * 2 - 1) * bound).astype(np.float32).reshape(shape)
    return weights


def probe_rows(function: ActingFunction, n: int) -> tuple[Seen, Commands, MemoryState]:
    """Return random observations, commands in [-100, 100), and states in [-1, 1)."""
    stream = Stream(stream_key(0, Purpose.PROBE, 2, 0))
    like = function.call(1).seen
    seen = tuple(noise(stream, one.dtype, (n, *one.shape[1:])) for one in like)
    command = stream.uniforms(2 * n).reshape(n, 2) * 200 - 100
    size = function.state_size
    state = (stream.uniforms(n * size).reshape(n, size) * 2 - 1).astype(np.float32)
    return seen, command, state


def _session(model: bytes) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    # More threads do not speed up calls this small, and could change the order of summation.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # the error contains what it would log
    try:
        session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its errors have no common base class
        raise InvalidWeights(
            f"acting graph: ONNX Runtime cannot read it: {error}; install the versions of onnx "
            f"and onnxruntime that the run was created with"
        ) from error
    names = [[one.name for one in ends] for ends in (session.get_inputs(), session.get_outputs())]
    known = (
        names[0][-1] == _COMMAND and names[1] == ["logits"],
        names[0][-2:] == [_COMMAND, _STATE] and names[1] == ["logits", "next_state"],
    )
    if not any(known):
        raise InvalidWeights(
            f"acting graph: inputs {names[0]}, outputs {names[1]}; expected observations and "
            f"command as inputs, logits as output; use the version of udrl that created the run"
        )
    return session
