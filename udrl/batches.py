"""Batches: the examples of a version's updates as tensors.

All examples of a version are drawn at once, and gathered for several updates at a time. Without a
memory, examples are drawn individually. With a memory, a batch consists of windows of
``memory_window`` consecutive steps of an episode, which begin at multiples of ``memory_window``.
"""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from udrl.config import Config
from udrl.environments.masking import below_observation
from udrl.environments.previous import PREVIOUS
from udrl.experience import RankedExperience
from udrl.segments import Segments, draw_segments
from udrl.streams import Stream
from udrl.targets import ReturnInTime
from udrl.value import relative

#: Paths of the leaves that ``observe_previous`` adds.
_PREVIOUS = [(key,) for key in PREVIOUS]
#: Bytes of observations that are gathered at once, for the next updates.
_GATHERED_BYTES = 16 << 20

SeenTensors = tuple[Tensor, ...]


class Draw(NamedTuple):
    """The examples of all updates.

    Attributes:
        segments: the examples' segments, int64 [updates, examples] each.
        hidden: whether the previous action and reward are hidden from an example, bool [updates,
            examples]; None: from no example.
        windows: with a memory, numbers of the windows (:class:`Windows`), int64 [updates, windows].
            The examples are then the steps of these windows.
        valid: with a memory, whether an example counts, bool [updates, examples]. An episode's last
            window may be incomplete; it is padded with the last step.
    """

    segments: Segments
    hidden: npt.NDArray[np.bool_] | None = None
    windows: npt.NDArray[np.int64] | None = None
    valid: npt.NDArray[np.bool_] | None = None


class Windows:
    """The windows of all episodes in the buffer, numbered episode by episode.

    Args:
        lengths: T of each episode, by rank.
        size: steps per window.

    Attributes:
        size: steps per window.
        first: number of each episode's first window, int64 [episodes].
        counts: number of each episode's windows, int64 [episodes].
    """

    def __init__(self, lengths: npt.NDArray[np.int64], size: int) -> None:
        self.size = size
        self.counts = -(-lengths // size)
        self.first = np.cumsum(self.counts) - self.counts
        self._lengths = lengths

    def draw(self, uniforms: npt.NDArray[np.float64]) -> Draw:
        """Draw windows: an episode uniformly, then one of its windows uniformly.

        Args:
            uniforms: random numbers in [0, 1), float64 [2, updates, windows].
        """
        rank = (uniforms[0] * len(self._lengths)).astype(np.int64)
        chunk = (uniforms[1] * self.counts[rank]).astype(np.int64)
        segments, valid = self.steps(rank, chunk)
        flat = Segments(*(s.reshape(len(rank), -1) for s in segments))
        return Draw(flat, None, self.first[rank] + chunk, valid.reshape(len(rank), -1))

    def steps(
        self, rank: npt.NDArray[np.int64], chunk: npt.NDArray[np.int64]
    ) -> tuple[Segments, npt.NDArray[np.bool_]]:
        """Return the trailing segments of windows' steps, and whether each step exists.

        Args:
            rank: ranks of the episodes, int64 of any shape.
            chunk: number of the window within its episode, int64 of the same shape.

        Returns:
            int64 [..., size] each, bool [..., size].
        """
        length = self._lengths[rank][..., None]
        t = chunk[..., None] * self.size + np.arange(self.size)
        t1 = np.minimum(t, length - 1)
        ranks = np.broadcast_to(rank[..., None], t.shape)
        return Segments(ranks, t1, np.broadcast_to(length, t.shape)), t < length


def draw_examples(stream: Stream, experience: RankedExperience, config: Config) -> Draw:
    """Draw the examples of all updates of a version.

    Args:
        stream: the version's random stream.
        experience: the buffer.
        config: the run's settings.
    """
    training, updates = config.training, config.training.n_updates_per_iter
    if config.network.memory == "none":
        shape = (3, updates, training.batch_size)
        uniforms = stream.uniforms(math.prod(shape)).reshape(shape)
        draw = Draw(draw_segments(uniforms, experience.lengths, training.segments))
    else:
        n_windows = max(1, training.batch_size // training.memory_window)
        shape = (2, updates, n_windows)
        uniforms = stream.uniforms(math.prod(shape)).reshape(shape)
        draw = Windows(experience.lengths, training.memory_window).draw(uniforms)
    if not config.observe_previous:
        return draw
    # Hidden from all steps of a window or from none: a single visible action could be copied.
    units = draw.segments.rank if draw.windows is None else draw.windows
    hidden = stream.uniforms(units.size).reshape(units.shape) < training.previous_dropout
    times = draw.segments.rank.shape[1] // units.shape[1]
    return draw._replace(hidden=hidden.repeat(times, axis=1))


class Batch(NamedTuple):
    """The examples of an update, on the networks' device.

    Attributes:
        seen: s, as the networks see it, [batch, *shape] for each leaf.
        command: (desired return, desired horizon), each scaled, float32 [batch, 2]; relative to
            V(s) and D(s) once these are known.
        action: a, int64 [batch, *action_shape].
        windows: with a memory, numbers of the windows, int64 [windows], a numpy array.
        valid: with a memory, whether an example counts, bool [batch].
    """

    seen: SeenTensors
    command: Tensor
    action: Tensor
    windows: npt.NDArray[np.int64] | None
    valid: Tensor | None

    def counted(self, of_examples: Tensor) -> Tensor:
        """Return the rows of the examples that count."""
        return of_examples if self.valid is None else of_examples[self.valid]


class Batches:
    """The batches of a version's updates, gathered several at a time.

    The rounding of a matrix product may depend on alignment, so the tensors are allocated by torch,
    which aligns them to 64 bytes; numpy does not.

    Args:
        draw: the examples.
        experience: the buffer.
        config: the run's settings.
    """

    def __init__(self, draw: Draw, experience: RankedExperience, config: Config) -> None:
        self._draw = draw
        self._experience = experience
        leaves = experience.leaves
        kinds = [(s, leaf.space.dtype) for s, leaf in zip(experience.shapes, leaves, strict=True)]
        self._previous = [
            k for k, leaf in enumerate(leaves) if below_observation(leaf.path)[:1] in _PREVIOUS
        ]
        updates, size = draw.segments.rank.shape
        bytes_each = size * sum(math.prod(s) * d.itemsize for s, d in kinds)
        self._at_once = max(1, min(updates, _GATHERED_BYTES // bytes_each))
        n = self._at_once, size
        self._seen = [torch.empty(*n, *s, dtype=getattr(torch, d.name)) for s, d in kinds]
        self._commands = torch.empty(*n, ReturnInTime.size)
        self._actions = torch.empty(*n, *experience.action_shape, dtype=torch.int64)
        self._device = config.arithmetic.device
        self._scales = np.array(ReturnInTime(config.network).scales)
        self._bound = config.network.advantage_bound

    def gather(self, *, hide: bool = False, most: int | None = None) -> Iterator[Batch]:
        """Yield the batches of all updates, or of the first ones.

        A batch is valid until the next one, which may overwrite its tensors.

        Args:
            hide: whether to hide the previous action and reward in the examples drawn for this
                (:class:`Draw`).
            most: maximum number of batches. None: all.
        """
        draw = self._draw
        end = len(draw.segments.rank[:most])
        for first in range(0, end, self._at_once):
            part = slice(first, min(first + self._at_once, end))
            n = self._fill(Segments(*(s[part] for s in draw.segments)))
            if hide and draw.hidden is not None:
                for k in self._previous:
                    self._seen[k][:n].numpy()[draw.hidden[part]] = 0
            for k in range(n):
                valid = None if draw.valid is None else torch.from_numpy(draw.valid[first + k])
                yield Batch(
                    tuple(one[k].to(self._device) for one in self._seen),
                    self._commands[k].to(self._device),
                    self._actions[k].to(self._device),
                    None if draw.windows is None else draw.windows[first + k],
                    None if valid is None else valid.to(self._device),
                )

    def _fill(self, segments: Segments) -> int:
        """Gather the examples of some updates, and return the number of updates."""
        n = len(segments.rank)
        command, action = self._commands[:n].numpy(), self._actions[:n].numpy()
        flat = Segments(*(s.reshape(-1) for s in segments))
        examples = self._experience.examples(flat)
        for gathered, one in zip(self._seen, examples.seen, strict=True):
            gathered[:n].numpy()[:] = one.reshape(gathered[:n].shape)
        command[:] = (examples.command * self._scales).reshape(command.shape)
        if (expected := self._experience.expected_at(flat)) is not None:
            commands = self._commands[:n]
            commands[:] = relative(
                commands, torch.from_numpy(expected).view(commands.shape), self._bound
            )
        action[:] = examples.action.reshape(action.shape)
        return n


def tensor_of(array: npt.NDArray[Any]) -> Tensor:
    """Return a copy of an array as a tensor allocated by torch; strides may be arbitrary."""
    return torch.from_numpy(np.ascontiguousarray(array)).clone()
