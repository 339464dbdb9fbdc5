"""Section 2.3.3: a fixed number of Adam updates turns weights version v-1 into version v."""

import contextlib
import copy
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.optim.swa_utils import get_ema_multi_avg_fn

from udrl.behavior import BehaviorFunction, initialise
from udrl.config import Config
from udrl.environments.making import EnvironmentSpec
from udrl.segments import RankedExperience, Segments, draw_segments
from udrl.streams import Purpose, Stream, stream_key
from udrl.value import ValueFunction, value_loss


@dataclass
class TrainingState:
    """All that training changes: version v of the behavior function and its optimizer.

    Attributes:
        version: v; 0 is untrained.
        trained: what the optimizer updates.
        behavior: what acts: the moving average of ``trained``, or the same object where
            ``ema_decay`` is 0.
        loss: mean cross-entropy, in nats, over the updates that made this version; NaN at 0.
    """

    version: int
    trained: BehaviorFunction
    behavior: BehaviorFunction
    optimizer: torch.optim.Adam
    loss: float = float("nan")

    def acting(self) -> BehaviorFunction:
        """Return the behavior function on the CPU, where acting is done."""
        if self.behavior.action.weight.is_cpu:
            return self.behavior
        return copy.deepcopy(self.behavior).cpu()


def untrained(config: Config, spec: EnvironmentSpec) -> TrainingState:
    """Return version 0, a function of the seed."""
    trained = initialise(config, spec).to(config.device)
    behavior = copy.deepcopy(trained) if config.ema_decay else trained
    return TrainingState(0, trained, behavior, make_optimizer(trained, config))


def make_optimizer(behavior: BehaviorFunction, config: Config) -> torch.optim.Adam:
    """Return a new Adam for a behavior function."""
    return torch.optim.Adam(behavior.parameters(), lr=config.learning_rate, fused=True)


def train(state: TrainingState, experience: RankedExperience, config: Config) -> None:
    """Advance ``state`` by one version, on the buffer after iteration ``state.version``.

    The numbers that choose the examples come from the stream (seed, training, new version).
    """
    version = state.version + 1
    stream = Stream(stream_key(config.seed, Purpose.TRAINING, version))
    uniforms = stream.uniforms(3 * config.n_updates_per_iter * config.batch_size)
    segments = draw_segments(
        uniforms.reshape(3, config.n_updates_per_iter, config.batch_size),
        experience.lengths,
        config.segments,
    )
    with _threads(config.training_threads):
        losses = _update(state, experience, segments, config)
    state.version = version
    state.loss = losses / config.n_updates_per_iter


def _update(
    state: TrainingState, experience: RankedExperience, segments: Segments, config: Config
) -> float:
    """Make one Adam update for each row of ``segments``; return the sum of their losses."""
    batch = _Batch(config, state.trained)
    losses = torch.zeros((), dtype=torch.float64, device=config.device)
    one = torch.ones((), device=config.device)
    parameters = list(state.trained.parameters())
    averages = list(state.behavior.parameters())
    average = get_ema_multi_avg_fn(config.ema_decay)
    if state.trained.value is not None:
        _learn_value(state, state.trained.value, experience, segments, config, batch)
    for rank, t1, t2 in zip(*segments, strict=True):
        observation, command, action = batch.fill(experience, Segments(rank, t1, t2))
        loss = functional.cross_entropy(state.trained(observation, command), action)
        _step(state.optimizer, parameters, loss, one)
        if config.ema_decay:
            average(averages, parameters, None)
        losses += loss.detach()
    return float(losses)


def _learn_value(
    state: TrainingState,
    value: ValueFunction,
    experience: RankedExperience,
    segments: Segments,
    config: Config,
    batch: "_Batch",
) -> None:
    """Bring V to the lambda-returns, one update for each row, then label the examples anew."""
    parameters = list(state.trained.parameters())
    one = torch.ones((), device=config.device)
    _label(value, experience, config)
    for rank, t1, t2 in zip(*segments, strict=True):
        observation, command, _ = batch.fill(experience, Segments(rank, t1, t2))
        loss = value_loss(value(observation), command[:, 0])
        _step(state.optimizer, parameters, loss, one)
    _label(value, experience, config)


def _label(value: ValueFunction, experience: RankedExperience, config: Config) -> None:
    """Label all steps of the buffer with lambda-returns."""
    with torch.inference_mode():
        act = value.frozen()
        expected = [
            act(torch.from_numpy(part).clone().to(config.device))[:, 0].cpu().numpy()
            for part in experience.observations()
        ]
    experience.label(np.concatenate(expected) / config.return_scale, config.return_lambda)


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


class _Batch:
    """Tensors that every update of a version is copied into.

    They are torch's own memory: it is aligned to 64 bytes, which numpy's is not, and the rounding
    of a matrix product may depend on alignment.
    """

    def __init__(self, config: Config, behavior: BehaviorFunction) -> None:
        n, shape = config.batch_size, behavior.observation_shape
        dtype = torch.uint8 if behavior.is_convolutional else torch.float32
        self._tensors = (
            torch.empty(n, *shape, dtype=dtype),
            torch.empty(n, 2),
            torch.empty(n, dtype=torch.int64),
        )
        self._observation, self._command, self._action = (t.numpy() for t in self._tensors)
        self._device = config.device
        self._scales = np.array([config.return_scale, config.horizon_scale])

    def fill(
        self, experience: RankedExperience, segments: Segments
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return observations, scaled commands and actions, where the network is."""
        examples = experience.examples(segments)
        self._observation[:] = examples.observation
        self._command[:, 0] = examples.desired_return * self._scales[0]
        self._command[:, 1] = examples.desired_horizon * self._scales[1]
        self._action[:] = examples.action
        observation, command, action = (t.to(self._device) for t in self._tensors)
        return observation, command, action
