"""Acting functions: a run's graph with the weights of a version, in ONNX Runtime."""

import functools
import math
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import onnxruntime

from udrl.errors import InvalidWeights
from udrl.graph import Weights, weight_shapes, with_weights
from udrl.memory import Seen
from udrl.spaces import noise
from udrl.streams import Purpose, Stream, stream_key

#: Of what can be observed, by ONNX Runtime's names.
_DTYPES: dict[str, np.dtype[Any]] = {
    "tensor(float)": np.dtype(np.float32),
    "tensor(uint8)": np.dtype(np.uint8),
    "tensor(int32)": np.dtype(np.int32),
}

Commands = npt.NDArray[np.float64]
Logits = npt.NDArray[np.float32]
State = npt.NDArray[np.float32]


_COMMAND, _STATE = "command", "state"


class Call(Protocol):
    """The rows of one call: fill in the inputs, run, read the logits; again and again.

    Attributes:
        seen: observations as the networks see them (:mod:`udrl.memory`), [n, *shape] each.
        command: desired return and desired horizon, float64 [n, 2].
        state: what is remembered of the episodes so far, float32 [n, size], zeros at their first
            step; without a memory the size is 0.
        logits: float32 [n, n_parameters], what the last run returned.
        next_state: likewise, the state at the next step.
    """

    seen: Seen
    command: Commands
    state: State
    logits: Logits
    next_state: State

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
        graph: of the run (:func:`udrl.graph.acting_graph`).
        weights: of the version.

    Attributes:
        graph: the same.
        weights: the same.

    Raises:
        InvalidWeights: the bytes are no graph, or the weights are not those of the graph.
    """

    def __init__(self, graph: bytes, weights: Weights) -> None:
        self.graph = graph
        self.weights = weights
        self._session = _session(self.model)
        self._calls: dict[int, Call] = {}

    @property
    def model(self) -> bytes:
        """The graph with the weights: an ONNX model of its own."""
        return with_weights(self.graph, self.weights)

    def call(self, n: int) -> Call:
        """Return a call of ``n`` rows. It is not for several threads at once."""
        if n not in self._calls:
            together = n == 1 or is_exact_together(self.graph, n)
            rows = _Together if together else _OneByOne
            self._calls[n] = rows(self._session, n)
        return self._calls[n]

    @property
    def state_size(self) -> int:
        """Numbers that are remembered of an episode."""
        last = self._session.get_inputs()[-1]
        return int(last.shape[1]) if last.name == _STATE else 0

    def logits(self, seen: Seen, command: Commands, state: State | None = None) -> Logits:
        """Return the logits of rows, float32 [n, n_parameters]; for any thread.

        Args:
            seen: observations as the networks see them.
            command: desired return and desired horizon, float64 [n, 2].
            state: what is remembered; None: nothing, as at an episode's first step.
        """
        return self.advance(seen, command, state)[0]

    def advance(
        self, seen: Seen, command: Commands, state: State | None = None
    ) -> tuple[Logits, State]:
        """Return the logits of rows, as :meth:`logits`, and the states at the next step."""
        names = [one.name for one in self._session.get_inputs()]
        given: list[npt.NDArray[Any]] = [*seen, command]
        if self.state_size:
            nothing = np.zeros((len(command), self.state_size), np.float32)
            given.append(nothing if state is None else state)
        rows = [
            self._session.run(None, {n: a[k : k + 1] for n, a in zip(names, given, strict=True)})
            for k in range(len(command))
        ]
        logits, *after = (np.concatenate(parts) for parts in zip(*rows, strict=True))
        return logits, after[0] if after else np.zeros((len(command), 0), np.float32)


class _Together:
    """All rows in one run of the session, with inputs and output bound to arrays."""

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


class _OneByOne:
    """A run of the session for each row, on machines where company changes a row's bits."""

    def __init__(self, session: onnxruntime.InferenceSession, n: int) -> None:
        self._one = one = _Together(session, 1)
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
def is_exact_together(graph: bytes, n: int) -> bool:
    """Say whether a call of ``n`` rows gives each the bits that a call for it alone gives."""
    function = _probe(graph)
    rows = _Together(function._session, n)
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


def probe_rows(function: ActingFunction, n: int) -> tuple[Seen, Commands, State]:
    """Return observations of noise, commands in [-100, 100), and states in [-1, 1)."""
    stream = Stream(stream_key(0, Purpose.PROBE, 2, 0))
    like = function.call(1).seen
    seen = tuple(noise(stream, one.dtype, (n, *one.shape[1:])) for one in like)
    command = stream.uniforms(2 * n).reshape(n, 2) * 200 - 100
    size = function.state_size
    state = (stream.uniforms(n * size).reshape(n, size) * 2 - 1).astype(np.float32)
    return seen, command, state


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
    known = (
        names[0][-1] == _COMMAND and names[1] == ["logits"],
        names[0][-2:] == [_COMMAND, _STATE] and names[1] == ["logits", "next_state"],
    )
    if not any(known):
        raise InvalidWeights(
            f"acting graph: from {names[0]} to {names[1]}, expected from observations and command "
            f"to logits; the run was created by another version of udrl"
        )
    return session
