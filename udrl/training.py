"""Section 2.3.3: a fixed number of Adam updates turns weights version v-1 into version v."""

import contextlib
import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from udrl.architecture import state_sizes
from udrl.batches import Batch, Batches, Draw, Seen, draw_examples
from udrl.behavior import BehaviorFunction, initialise
from udrl.config import Config
from udrl.encoders import PRECISIONS
from udrl.environments.making import EnvironmentSpec
from udrl.graph import Weights
from udrl.initialisation import draw_weights
from udrl.segments import RankedExperience
from udrl.spaces import Vector
from udrl.streams import Purpose, Stream, stream_key
from udrl.value import Critic, ValueFunction, value_loss
from udrl.whole_buffer import at_all_steps


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
    version = state.version + 1
    stream = Stream(stream_key(config.seed, Purpose.TRAINING, version))
    draw = draw_examples(stream, experience, config)
    if version == 1 and config.network.normalise_observations:
        _normalise(state, experience)
    with _threads(config.arithmetic.training_threads):
        losses = _update(state, experience, draw, config)
    state.version = version
    state.loss = losses / config.training.n_updates_per_iter


def _normalise(state: TrainingState, experience: RankedExperience) -> None:
    """Let all networks read numbers relative to their mean in the buffer."""
    vectors = [k for k, leaf in enumerate(experience.leaves) if isinstance(leaf.space, Vector)]
    parts = [[seen[k] for k in vectors] for seen, _ in experience.steps()]
    networks = [state.behavior, state.behavior.value, state.critic]
    for k, arrays in zip(vectors, zip(*parts, strict=True), strict=True):
        values = np.concatenate(arrays).astype(np.float64)
        mean, deviation = torch.from_numpy(values.mean(0)), torch.from_numpy(values.std(0))
        for network in networks:
            if network is not None and hasattr(network, "encoder"):
                network.encoder.normalise(k, mean, deviation)


def _update(
    state: TrainingState, experience: RankedExperience, draw: Draw, config: Config
) -> float:
    """Make one Adam update for each row of a draw; return the sum of their losses."""
    batches = Batches(draw, experience, config)
    losses = torch.zeros((), dtype=torch.float64, device=config.arithmetic.device)
    behavior = state.behavior
    if behavior.value is not None:
        _learn_value(state, behavior.value, experience, batches, config)
    remembered = None
    if behavior.memory is not None:
        size = behavior.memory.size
        remembered = at_all_steps(
            lambda seen, _, before: behavior.remember(seen, before), size, experience, config
        ).states
    step = _Stepper(state)
    for batch in batches.gather(hide=True):
        parameters = behavior.obey(batch.seen, batch.command, _remembered(batch, remembered))
        loss = behavior.loss(batch.counted(parameters), batch.counted(batch.action))
        step(loss)
        losses += loss.detach()
    return float(losses)


def _learn_value(
    state: TrainingState,
    value: ValueFunction,
    experience: RankedExperience,
    batches: Batches,
    config: Config,
) -> None:
    """Bring V, and Q before it, to the lambda-returns; then label the examples anew.

    Each makes one update for each row. They do not change any more in this version, so the examples
    carry V and D from here on.
    """
    step, scale, lam = _Stepper(state), config.network.return_scale, config.training.return_lambda
    critic, size = state.critic, sum(state_sizes(config.network)[1:])

    def value_at(seen: Seen, _: Tensor, before: Tensor | None) -> tuple[Tensor, Tensor | None]:
        expected, after = value.expect(seen, before)
        return value.value_of(expected), after

    experience.expected = None
    found = at_all_steps(value_at, size, experience, config)
    experience.label(found.outputs[:, 0] / scale, lam)
    if critic is not None:

        def critic_at(
            seen: Seen, action: Tensor, before: Tensor | None
        ) -> tuple[Tensor, Tensor | None]:
            expected, after = critic.expect(seen, before)
            return critic.value_of(expected, action), after

        remembered = at_all_steps(critic_at, size, experience, config).states if size else None
        for batch in batches.gather():
            q = critic(batch.seen, batch.action, _remembered(batch, remembered))
            step(batch.counted(q - batch.command[:, 0]).square().mean())
        labels = at_all_steps(critic_at, size, experience, config).outputs
        experience.labels = labels / np.float64(scale)
    for batch in batches.gather():
        expected = value(batch.seen, _remembered(batch, found.states))
        step(value_loss(batch.counted(expected), batch.counted(batch.command[:, 0])))
    experience.expected = at_all_steps(value_at, size, experience, config).outputs
    if critic is None:
        experience.label(experience.expected[:, 0] / scale, lam)


def _remembered(batch: Batch, states: Tensor | None) -> Tensor | None:
    """Return what is remembered before each window of a batch."""
    return None if states is None else states[torch.from_numpy(batch.windows).to(states.device)]


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
