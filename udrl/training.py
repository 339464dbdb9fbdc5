"""Section 2.3.3: a fixed number of Adam updates turns weights version v-1 into version v."""

from dataclasses import dataclass

import numpy as np
import torch
from torch.nn import functional

from udrl.behavior import BehaviorFunction, initialise
from udrl.config import Config
from udrl.environments.making import EnvironmentSpec
from udrl.segments import RankedExperience, Segments, draw_segments
from udrl.streams import Purpose, Stream, stream_key


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


def untrained(config: Config, spec: EnvironmentSpec) -> TrainingState:
    """Return version 0, a function of the seed."""
    behavior = initialise(config, spec)
    return TrainingState(0, behavior, make_optimizer(behavior, config))


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
    batch = _Batch(config, state.behavior)
    parameters = list(state.behavior.parameters())
    losses = torch.zeros((), dtype=torch.float64)
    one = torch.ones(())
    for rank, t1, t2 in zip(*segments, strict=True):
        batch.fill(experience, Segments(rank, t1, t2))
        loss = functional.cross_entropy(
            state.behavior(batch.observation, batch.command), batch.action
        )
        for parameter in parameters:
            parameter.grad = None  # Optimizer.zero_grad costs a fiftieth of an update
        loss.backward(one)
        state.optimizer.step()
        losses += loss.detach()
    state.version = version
    state.loss = float(losses) / config.n_updates_per_iter


class _Batch:
    """Tensors that every update of a version is copied into.

    They are torch's own memory: it is aligned to 64 bytes, which numpy's is not, and the rounding
    of a matrix product may depend on alignment.
    """

    def __init__(self, config: Config, behavior: BehaviorFunction) -> None:
        n = config.batch_size
        self.observation = torch.empty(n, behavior.observation.in_features)
        self.command = torch.empty(n, 2)
        self.action = torch.empty(n, dtype=torch.int64)
        self._observation = self.observation.numpy()
        self._command = self.command.numpy()
        self._action = self.action.numpy()
        self._scales = np.array([config.return_scale, config.horizon_scale])

    def fill(self, experience: RankedExperience, segments: Segments) -> None:
        examples = experience.examples(segments)
        self._observation[:] = examples.observation
        self._command[:, 0] = examples.desired_return * self._scales[0]
        self._command[:, 1] = examples.desired_horizon * self._scales[1]
        self._action[:] = examples.action
