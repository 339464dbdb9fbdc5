"""Section 2.3.3: a fixed number of Adam updates turns weights version v-1 into version v."""

import contextlib
import math
import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from udrl.behavior import BehaviorFunction, initialise
from udrl.config import Config
from udrl.encoders import PRECISIONS
from udrl.environments.making import EnvironmentSpec
from udrl.environments.previous import PREVIOUS
from udrl.graph import Weights
from udrl.initialisation import draw_weights
from udrl.segments import RankedExperience, Segments, draw_segments
from udrl.spaces import Vector
from udrl.streams import Purpose, Stream, stream_key
from udrl.targets import ReturnInTime
from udrl.value import Critic, ValueFunction, relative, value_loss

#: Paths of what was before an observation.
_PREVIOUS = [(key,) for key in PREVIOUS]
#: Bytes of observations that are gathered at once for the next updates.
_GATHERED_BYTES = 16 << 20


@dataclass
class TrainingState:
    """All that training changes: version v of the behavior function and its optimizer.

    Attributes:
        version: v; 0 is untrained.
        behavior: B(s, c; theta).
        critic: where ``baseline`` is ``action_value``.
        optimizer: of both.
        loss: mean cross-entropy, in nats, over the updates that made this version; NaN at 0.
    """

    version: int
    behavior: BehaviorFunction
    critic: Critic | None
    optimizer: torch.optim.Adam
    loss: float = float("nan")

    @property
    def weights(self) -> Weights:
        """The weights that act."""
        return weights_of(self.behavior)

    def parameters(self) -> dict[str, nn.Parameter]:
        """Return all that is trained, by name."""
        return trained(self.behavior, self.critic)


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
    behavior, critic = initialise(config, spec), make_critic(config, spec)
    if critic is not None:
        draw_weights(critic, config, 1, ("expected",))
    return assemble(0, behavior, critic, config)


def make_critic(config: Config, spec: EnvironmentSpec) -> Critic | None:
    """Return a critic without weights, if the run has one."""
    if config.network.baseline != "action_value":
        return None
    return Critic(spec, config.network, PRECISIONS[config.arithmetic.precision])


def assemble(
    version: int, behavior: BehaviorFunction, critic: Critic | None, config: Config
) -> TrainingState:
    """Return the state of a version with a new Adam, on the device that trains."""
    behavior.to(config.arithmetic.device)
    if critic is not None:
        critic.to(config.arithmetic.device)
    parameters = trained(behavior, critic).values()
    adam = torch.optim.Adam(parameters, lr=config.training.learning_rate, fused=True)
    return TrainingState(version, behavior, critic, adam)


def trained(behavior: BehaviorFunction, critic: Critic | None) -> dict[str, nn.Parameter]:
    """Return the parameters of the networks by name; the critic's begin with ``critic``."""
    parameters = dict(behavior.named_parameters())
    if critic is not None:
        parameters |= {f"critic.{name}": p for name, p in critic.named_parameters()}
    return parameters


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
    if version == 1 and config.network.normalise_observations:
        _normalise(state, experience)
    hidden = None
    if config.observe_previous:
        numbers = stream.uniforms(segments.rank.size).reshape(segments.rank.shape)
        hidden = numbers < training.drop_previous
    with _threads(config.arithmetic.training_threads):
        losses = _update(state, experience, segments, hidden, config)
    state.version = version
    state.loss = losses / training.n_updates_per_iter


def _normalise(state: TrainingState, experience: RankedExperience) -> None:
    """Let all networks read numbers relative to their mean in the buffer."""
    vectors = [k for k, leaf in enumerate(experience.leaves) if isinstance(leaf.space, Vector)]
    parts = [[seen[k] for k in vectors] for seen, _ in experience.steps()]
    networks = [state.behavior, state.behavior.value, state.critic]
    for k, arrays in zip(vectors, zip(*parts, strict=True), strict=True):
        values = np.concatenate(arrays).astype(np.float64)
        mean, deviation = torch.from_numpy(values.mean(0)), torch.from_numpy(values.std(0))
        for network in networks:
            if network is not None:
                network.encoder.normalise(k, mean, deviation)


def _update(
    state: TrainingState,
    experience: RankedExperience,
    segments: Segments,
    hidden: npt.NDArray[np.bool_] | None,
    config: Config,
) -> float:
    """Make one Adam update for each row of ``segments``; return the sum of their losses.

    Args:
        state: to be advanced.
        experience: the buffer.
        segments: int64 [updates, batch_size].
        hidden: from which examples the previous action and reward are hidden, bool of that shape.
        config: the settings.
    """
    batches = _Batches(config, experience)
    losses = torch.zeros((), dtype=torch.float64, device=config.arithmetic.device)
    if state.behavior.value is not None:
        _learn_value(state, state.behavior.value, experience, segments, config, batches)
    step = _Stepper(state)
    for seen, command, action in batches.gather(segments, hidden):
        loss = state.behavior.loss(state.behavior.obey(seen, command), action)
        step(loss)
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
    """Bring V, and Q before it, to the lambda-returns; then label the examples anew.

    Each makes one update for each row. They do not change any more in this version, so the examples
    carry V and D from here on.
    """
    step, scale, lam = _Stepper(state), config.network.return_scale, config.training.return_lambda
    device = config.arithmetic.device
    experience.expected = None
    experience.label(_at_all_steps(value, experience, device)[:, 0] / scale, lam)
    if state.critic is not None:
        for seen, command, action in batches.gather(segments):
            step((state.critic(seen, action) - command[:, 0]).square().mean())
        experience.labels = _at_all_steps(state.critic, experience, device) / np.float64(scale)
    for seen, command, _ in batches.gather(segments):
        step(value_loss(value(seen), command[:, 0]))
    experience.expected = _at_all_steps(value, experience, device)
    if state.critic is None:
        experience.label(experience.expected[:, 0] / scale, lam)


def _at_all_steps(
    network: ValueFunction | Critic, experience: RankedExperience, device: str
) -> npt.NDArray[np.float32]:
    """Return what a network expects at every step of the buffer, float32 [steps, ...]."""
    parts = []
    with torch.inference_mode():
        for arrays, actions in experience.steps():
            seen = tuple(_own(one).to(device) for one in arrays)
            if isinstance(network, Critic):
                acted = torch.from_numpy(actions.astype(np.int64)).to(device)
                parts.append(network(seen, acted).cpu().numpy())
            else:
                parts.append(network(seen).cpu().numpy())
    expected: npt.NDArray[np.float32] = np.concatenate(parts)
    return expected


def _own(array: npt.NDArray[Any]) -> Tensor:
    """Return an array as a tensor in torch's own memory; a leaf of a record has odd strides."""
    return torch.from_numpy(np.ascontiguousarray(array)).clone()


class _Stepper:
    """Makes Adam's updates.

    Args:
        state: what it updates.
    """

    def __init__(self, state: TrainingState) -> None:
        self._parameters = list(state.parameters().values())
        self._optimizer = state.optimizer
        self._one = torch.ones((), device=self._parameters[0].device)

    def __call__(self, loss: Tensor) -> None:
        """Make one, of the parameters that a loss depends on."""
        for parameter in self._parameters:
            parameter.grad = None  # Optimizer.zero_grad costs a fiftieth of an update
        loss.backward(self._one)
        self._optimizer.step()


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
        leaves = experience.leaves
        kinds = [(s, leaf.space.dtype) for s, leaf in zip(experience.shapes, leaves, strict=True)]
        self._previous = [k for k, leaf in enumerate(leaves) if leaf.path[:1] in _PREVIOUS]
        bytes_each = training.batch_size * sum(math.prod(s) * d.itemsize for s, d in kinds)
        self._at_once = max(1, min(training.n_updates_per_iter, _GATHERED_BYTES // bytes_each))
        n = self._at_once, training.batch_size
        self._seen = [torch.empty(*n, *s, dtype=getattr(torch, d.name)) for s, d in kinds]
        self._commands = torch.empty(*n, ReturnInTime.size)
        self._actions = torch.empty(*n, *experience.action_shape, dtype=torch.int64)
        self._device = config.arithmetic.device
        self._scales = np.array(ReturnInTime(config.network).scales)

    def gather(
        self, segments: Segments, hidden: npt.NDArray[np.bool_] | None = None
    ) -> Iterator[tuple[tuple[Tensor, ...], Tensor, Tensor]]:
        """Yield what is seen, scaled commands and actions of each update, where the network is.

        Commands are relative to what is expected, once that is known.
        """
        n_updates = len(segments.rank)
        for first in range(0, n_updates, self._at_once):
            part = Segments(*(s[first : first + self._at_once] for s in segments))
            n = len(part.rank)
            command, action = self._commands[:n].numpy(), self._actions[:n].numpy()
            flat = Segments(*(s.reshape(-1) for s in part))
            examples = self._experience.examples(flat)
            for gathered, one in zip(self._seen, examples.seen, strict=True):
                gathered[:n].numpy()[:] = one.reshape(gathered[:n].shape)
            if hidden is not None:
                for k in self._previous:
                    self._seen[k][:n].numpy()[hidden[first : first + n]] = 0
            command[:] = (examples.command * self._scales).reshape(command.shape)
            if (expected := self._experience.expected_at(flat)) is not None:
                commands = self._commands[:n]
                commands[:] = relative(commands, torch.from_numpy(expected).view(commands.shape))
            action[:] = examples.action.reshape(action.shape)
            for k in range(n):
                seen = tuple(one[k].to(self._device) for one in self._seen)
                yield seen, self._commands[k].to(self._device), self._actions[k].to(self._device)
