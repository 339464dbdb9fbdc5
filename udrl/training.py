"""Section 2.3.3: weights version v is version v-1 after a fixed number of Adam updates."""

import contextlib
import math
import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from udrl.adam import Adam
from udrl.architecture import state_sizes
from udrl.batches import Batch, Batches, Draw, SeenTensors, draw_examples
from udrl.behavior import BehaviorFunction, initialise
from udrl.config import Config
from udrl.encoders import PRECISIONS
from udrl.environments.specification import EnvironmentSpec
from udrl.experience import RankedExperience
from udrl.graph import Weights
from udrl.guidance import EXAMPLES, choose_guidance
from udrl.initialisation import draw_weights
from udrl.spaces import Vector
from udrl.streams import Purpose, Stream, stream_key
from udrl.value import Critic, ValueFunction, value_loss
from udrl.whole_buffer import at_all_steps


@dataclass
class TrainingState:
    """The state of training: version v of the networks, and their optimizer.

    Attributes:
        version: v; 0 is untrained.
        behavior: B(s, c; theta).
        critic: critic, if ``baseline`` is ``action_value``.
        optimizer: optimizer of both networks.
        loss: mean cross-entropy, in nats, over the last round of updates; NaN for version 0.
    """

    version: int
    behavior: BehaviorFunction
    critic: Critic | None
    optimizer: Adam
    loss: float = float("nan")

    @property
    def weights(self) -> Weights:
        """The behavior function's weights."""
        return weights_of(self.behavior)

    def parameters(self) -> dict[str, nn.Parameter]:
        """Return all trainable parameters by name."""
        return trainable_parameters(self.behavior, self.critic)


#: Rounds of updates after a reset (``reset_every``). Fewer rounds learn the buffer less well.
RESET_ROUNDS = 24
#: Settings found by each active :func:`exact_arithmetic`, in order of entry.
_found_settings: list[tuple[int, str | None]] = []
_settings_lock = threading.Lock()
#: Environment variable without which CUDA's matrix products are not deterministic.
_WORKSPACE = "CUBLAS_WORKSPACE_CONFIG"


def weights_of(behavior: BehaviorFunction) -> Weights:
    """Return a behavior function's parameters and buffers as new arrays."""
    return {n: t.detach().cpu().numpy().copy() for n, t in behavior.state_dict().items()}


def compute_deterministically() -> None:
    """Make torch compute deterministically, in one thread."""
    if torch.get_num_threads() != 1:
        torch.set_num_threads(1)
    os.environ.setdefault(_WORKSPACE, ":4096:8")
    # As use_deterministic_algorithms() does, which imports torch's compiler.
    torch.set_deterministic_debug_mode("error")


@contextlib.contextmanager
def exact_arithmetic() -> Iterator[None]:
    """Make torch compute deterministically in one thread, and restore its settings on exit.

    Several threads of a process may use this at the same time; the last to exit restores the
    settings.
    """
    threads = torch.get_num_threads()  # torch has one value for each thread
    with _settings_lock:
        _found_settings.append((torch.get_deterministic_debug_mode(), os.environ.get(_WORKSPACE)))
        compute_deterministically()
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        with _settings_lock:
            # Whichever thread exits last pops the first entry, which has the original settings.
            mode, workspace = _found_settings.pop()
            torch.set_deterministic_debug_mode(mode)
            if workspace is None:
                os.environ.pop(_WORKSPACE, None)


def untrained(config: Config, spec: EnvironmentSpec) -> TrainingState:
    """Return version 0, which depends only on the settings and the seed."""
    behavior, critic = initialise(config, spec), make_critic(config, spec)
    if critic is not None:
        draw_weights(critic, config, 1, ("expected",))
    return assemble(0, behavior, critic, config)


def make_critic(config: Config, spec: EnvironmentSpec) -> Critic | None:
    """Return a critic without initial weights; None unless ``baseline`` is ``action_value``."""
    if config.network.baseline != "action_value":
        return None
    return Critic(spec, config.network, PRECISIONS[config.arithmetic.precision])


def assemble(
    version: int, behavior: BehaviorFunction, critic: Critic | None, config: Config
) -> TrainingState:
    """Return the state of a version with a new Adam optimizer, on the training device."""
    behavior.to(config.arithmetic.device)
    if critic is not None:
        critic.to(config.arithmetic.device)
    parameters = trainable_parameters(behavior, critic).values()
    adam = Adam(parameters, lr=config.training.learning_rate, fused=True)
    return TrainingState(version, behavior, critic, adam)


def trainable_parameters(
    behavior: BehaviorFunction, critic: Critic | None
) -> dict[str, nn.Parameter]:
    """Return the parameters of the networks by name; the critic's begin with ``critic.``."""
    parameters = dict(behavior.named_parameters())
    if critic is not None:
        parameters |= {f"critic.{name}": p for name, p in critic.named_parameters()}
    return parameters


def train(state: TrainingState, experience: RankedExperience, config: Config) -> None:
    """Advance ``state`` by one version, on the buffer after iteration ``state.version``.

    The examples are drawn with the random streams (seed, training, new version, round).
    """
    version, every = state.version + 1, config.training.reset_every
    rounds = 1
    if every is not None and version % every == 0:
        _reset(state, config)
        rounds = RESET_ROUNDS
    if version == 1 and config.network.normalise_observations:
        _normalise(state, experience)
    for k in range(rounds):
        stream = Stream(stream_key(config.seed, Purpose.TRAINING, version, k))
        draw = draw_examples(stream, experience, config)
        with _threads(config.arithmetic.training_threads):
            losses = _update(state, experience, draw, config)
        state.loss = losses / config.training.n_updates_per_iter
    state.version = version


def _reset(state: TrainingState, config: Config) -> None:
    """Give all networks their initial weights, and begin with a new optimizer state.

    Networks that are trained for long learn worse from new data than new ones do (Nikishin et al.,
    2022). The normalisation of observations remains.
    """
    initial = untrained(config, state.behavior.spec).parameters()
    with torch.no_grad():
        for name, parameter in state.parameters().items():
            parameter.copy_(initial[name])
    state.optimizer.state.clear()


def _normalise(state: TrainingState, experience: RankedExperience) -> None:
    """Set all networks' normalisation to the mean and deviation of vectors in the buffer."""
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
    """Make one Adam update for each batch of a draw; return the sum of the losses."""
    batches = Batches(draw, experience, config)
    losses = torch.zeros((), dtype=torch.float64, device=config.arithmetic.device)
    behavior = state.behavior
    if behavior.value is not None:
        _learn_value(state, behavior.value, experience, batches, config)
    states = None
    if behavior.memory is not None:
        size = behavior.memory.size
        states = at_all_steps(
            lambda seen, _, before: behavior.encode(seen, before), size, experience, config
        ).states
    step = _Stepper(state)
    for batch in batches.gather(hide=True):
        state_before = _initial_states(batch, states)
        parameters = behavior.forward_relative(batch.seen, batch.command, state_before)
        loss = behavior.loss(batch.counted(parameters), batch.counted(batch.action))
        step(loss)
        losses += loss.detach()
    if behavior.guidance is not None:
        minimum = config.network.guidance_kl
        most = math.ceil(EXAMPLES / config.training.batch_size)
        chosen = choose_guidance(
            behavior,
            lambda: ((b, _initial_states(b, states)) for b in batches.gather(most=most)),
            minimum,
        )
        behavior.guidance.copy_(torch.tensor([chosen]))
    return float(losses)


def _learn_value(
    state: TrainingState,
    value: ValueFunction,
    experience: RankedExperience,
    batches: Batches,
    config: Config,
) -> None:
    """Fit V to lambda-returns, or with a critic, Q to these and V to Q; relabel the examples.

    Each network makes one update per batch. V and D do not change again in this version, so they
    are then stored for all steps of the buffer.
    """
    step, scale, lam = _Stepper(state), config.network.return_scale, config.training.return_lambda
    critic, size = state.critic, sum(state_sizes(config.network)[1:])

    def value_at(
        seen: SeenTensors, _: Tensor, before: Tensor | None
    ) -> tuple[Tensor, Tensor | None]:
        expected, after = value.expect(seen, before)
        return value.value_of(expected), after

    experience.expected = None
    found = at_all_steps(value_at, size, experience, config)
    experience.label(found.outputs[:, 0] / scale, lam)
    if critic is not None:

        def critic_at(
            seen: SeenTensors, action: Tensor, before: Tensor | None
        ) -> tuple[Tensor, Tensor | None]:
            expected, after = critic.expect(seen, before)
            return critic.value_of(expected, action), after

        states = at_all_steps(critic_at, size, experience, config).states if size else None
        for batch in batches.gather():
            q = critic(batch.seen, batch.action, _initial_states(batch, states))
            step(batch.counted(q - batch.command[:, 0]).square().mean())
        labels = at_all_steps(critic_at, size, experience, config).outputs
        experience.labels = labels / np.float64(scale)
    for batch in batches.gather():
        expected = value(batch.seen, _initial_states(batch, found.states))
        step(value_loss(batch.counted(expected), batch.counted(batch.command[:, 0])))
    experience.expected = at_all_steps(value_at, size, experience, config).outputs
    if critic is None:
        experience.label(experience.expected[:, 0] / scale, lam)


def _initial_states(batch: Batch, states: Tensor | None) -> Tensor | None:
    """Return the memory's state before each window of a batch."""
    return None if states is None else states[torch.from_numpy(batch.windows).to(states.device)]


class _Stepper:
    """Makes Adam updates of a training state."""

    def __init__(self, state: TrainingState) -> None:
        self._parameters = list(state.parameters().values())
        self._optimizer = state.optimizer
        self._one = torch.ones((), device=self._parameters[0].device)

    def __call__(self, loss: Tensor) -> None:
        """Update the parameters that a loss depends on."""
        for parameter in self._parameters:
            parameter.grad = None  # Optimizer.zero_grad would take 2 % of an update's time
        loss.backward(self._one)
        self._optimizer.step()


@contextlib.contextmanager
def _threads(n: int) -> Iterator[None]:
    """Let torch use ``n`` threads for computations that this thread starts."""
    before = torch.get_num_threads()
    torch.set_num_threads(n)
    try:
        yield
    finally:
        torch.set_num_threads(before)
