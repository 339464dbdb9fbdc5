"""Section 2.3.3: a fixed number of Adam updates turns weights version v-1 into version v."""

import contextlib
import math
import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from udrl.behavior import BehaviorFunction, initialise
from udrl.config import Config
from udrl.environments.making import EnvironmentSpec
from udrl.graph import Weights
from udrl.segments import RankedExperience, Segments, draw_segments
from udrl.setting_groups import TrainingSettings
from udrl.streams import Purpose, Stream, stream_key
from udrl.targets import ReturnInTime
from udrl.value import ValueFunction, relative, value_loss

#: Bytes of observations that are gathered at once for the next updates.
_GATHERED_BYTES = 16 << 20


@dataclass
class TrainingState:
    """All that training changes: version v of the behavior function and its optimizer.

    Attributes:
        version: v; 0 is untrained.
        loss: mean cross-entropy, in nats, over the updates that made this version; NaN at 0.
    """

    version: int
    behavior: BehaviorFunction
    optimizer: torch.optim.Adam
    loss: float = float("nan")

    @property
    def weights(self) -> Weights:
        """The weights that act."""
        return weights_of(self.behavior)


#: What those who compute exactly found, in the order in which they began.
_before: list[tuple[bool, bool, str | None]] = []
_exactly = threading.Lock()
#: What CUDA's matrix products need to be deterministic.
_WORKSPACE = "CUBLAS_WORKSPACE_CONFIG"


def weights_of(behavior: BehaviorFunction) -> Weights:
    """Return a behavior function's parameters as arrays of their own."""
    return {n: t.detach().cpu().numpy().copy() for n, t in behavior.state_dict().items()}


def use_one_thread() -> None:
    """Let torch compute deterministically in one thread."""
    if torch.get_num_threads() != 1:
        torch.set_num_threads(1)
    os.environ.setdefault(_WORKSPACE, ":4096:8")  # CUDA's matrix products too
    torch.use_deterministic_algorithms(mode=True)


@contextlib.contextmanager
def exact_arithmetic() -> Iterator[None]:
    """Let torch compute deterministically in one thread, and leave it as it was.

    Others may do so at the same time, in threads of this process; the last one restores.
    """
    threads = torch.get_num_threads()  # which torch keeps for each thread apart
    with _exactly:
        found = (
            torch.are_deterministic_algorithms_enabled(),
            torch.is_deterministic_algorithms_warn_only_enabled(),
            os.environ.get(_WORKSPACE),
        )
        _before.append(found)
        use_one_thread()
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        with _exactly:
            # All but the first began within another; what the first found goes last.
            deterministic, warns_only, workspace = _before.pop()
            torch.use_deterministic_algorithms(deterministic, warn_only=warns_only)
            if workspace is None:
                os.environ.pop(_WORKSPACE, None)


def untrained(config: Config, spec: EnvironmentSpec) -> TrainingState:
    """Return version 0, a function of the seed."""
    behavior = initialise(config, spec).to(config.arithmetic.device)
    return TrainingState(0, behavior, make_optimizer(behavior, config.training))


def make_optimizer(behavior: BehaviorFunction, training: TrainingSettings) -> torch.optim.Adam:
    """Return a new Adam for a behavior function."""
    return torch.optim.Adam(behavior.parameters(), lr=training.learning_rate, fused=True)


def train(state: TrainingState, experience: RankedExperience, config: Config) -> None:
    """Advance ``state`` by one version, on the buffer after iteration ``state.version``.

    The numbers that choose the examples come from the stream (seed, training, new version).
    """
    training, version = config.training, state.version + 1
    stream = Stream(stream_key(config.seed, Purpose.TRAINING, version))
    uniforms = stream.uniforms(3 * training.n_updates_per_iter * training.batch_size)
    segments = draw_segments(
        uniforms.reshape(3, training.n_updates_per_iter, training.batch_size),
        experience.lengths,
        training.segments,
    )
    with _threads(config.arithmetic.training_threads):
        losses = _update(state, experience, segments, config)
    state.version = version
    state.loss = losses / training.n_updates_per_iter


def _update(
    state: TrainingState, experience: RankedExperience, segments: Segments, config: Config
) -> float:
    """Make one Adam update for each row of ``segments``; return the sum of their losses."""
    batches = _Batches(config, experience)
    losses = torch.zeros((), dtype=torch.float64, device=config.arithmetic.device)
    one = torch.ones((), device=config.arithmetic.device)
    parameters = list(state.behavior.parameters())
    if state.behavior.value is not None:
        _learn_value(state, state.behavior.value, experience, segments, config, batches)
    for observation, command, action in batches.gather(segments):
        loss = state.behavior.loss(state.behavior.obey(observation, command), action)
        _step(state.optimizer, parameters, loss, one)
        losses += loss.detach()
    return float(losses)


def _learn_value(
    state: TrainingState,
    value: ValueFunction,
    experience: RankedExperience,
    segments: Segments,
    config: Config,
    batches: "_Batches",
) -> None:
    """Bring V to the lambda-returns, one update for each row, then label the examples anew.

    V and D do not change any more in this version, so the examples carry them from here on.
    """
    parameters = list(state.behavior.parameters())
    one = torch.ones((), device=config.arithmetic.device)
    experience.expected = None
    _label(value, experience, config)
    for observation, command, _ in batches.gather(segments):
        loss = value_loss(value(observation), command[:, 0])
        _step(state.optimizer, parameters, loss, one)
    experience.expected = _label(value, experience, config)


def _label(
    value: ValueFunction, experience: RankedExperience, config: Config
) -> npt.NDArray[np.float32]:
    """Label all steps of the buffer with lambda-returns; return V and D at each."""
    with torch.inference_mode():
        parts = [
            value(torch.from_numpy(part).clone().to(config.arithmetic.device)).cpu().numpy()
            for part in experience.observations()
        ]
    expected: npt.NDArray[np.float32] = np.concatenate(parts)
    experience.label(expected[:, 0] / config.network.scales[0], config.training.return_lambda)
    return expected


def _step(
    optimizer: torch.optim.Adam, parameters: list[nn.Parameter], loss: Tensor, one: Tensor
) -> None:
    """Make one update."""
    for parameter in parameters:
        parameter.grad = None  # Optimizer.zero_grad costs a fiftieth of an update
    loss.backward(one)
    optimizer.step()


@contextlib.contextmanager
def _threads(n: int) -> Iterator[None]:
    """Let this thread's tensors be computed by n; torch keeps the number for each thread apart."""
    before = torch.get_num_threads()
    torch.set_num_threads(n)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class _Batches:
    """The batches of a version's updates, gathered many at a time.

    The tensors are torch's own memory: it is aligned to 64 bytes, which numpy's is not, and the
    rounding of a matrix product may depend on alignment.
    """

    def __init__(self, config: Config, experience: RankedExperience) -> None:
        self._experience = experience
        training = config.training
        shape, dtype = experience.observation_shape, experience.observation_dtype
        bytes_each = training.batch_size * math.prod(shape) * dtype.itemsize
        self._at_once = max(1, min(training.n_updates_per_iter, _GATHERED_BYTES // bytes_each))
        n = self._at_once, training.batch_size
        self._tensors = (
            torch.empty(*n, *shape, dtype=getattr(torch, dtype.name)),
            torch.empty(*n, ReturnInTime.size),
            torch.empty(n, dtype=torch.int64),
        )
        self._device = config.arithmetic.device
        self._scales = np.array(ReturnInTime(config.network).scales)

    def gather(self, segments: Segments) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Yield observations, scaled commands and actions of each update, where the network is.

        Commands are relative to what is expected, once that is known.
        """
        n_updates = len(segments.rank)
        for first in range(0, n_updates, self._at_once):
            part = Segments(*(s[first : first + self._at_once] for s in segments))
            n = len(part.rank)
            observation, command, action = (t[:n].numpy() for t in self._tensors)
            flat = Segments(*(s.reshape(-1) for s in part))
            examples = self._experience.examples(flat)
            observation[:] = examples.observation.reshape(observation.shape)
            command[:] = (examples.command * self._scales).reshape(command.shape)
            if (expected := self._experience.expected_at(flat)) is not None:
                commands = self._tensors[1][:n]
                commands[:] = relative(commands, torch.from_numpy(expected).view(commands.shape))
            action[:] = examples.action.reshape(action.shape)
            for k in range(n):
                observed, commanded, acted = (t[k].to(self._device) for t in self._tensors)
                yield observed, commanded, acted
