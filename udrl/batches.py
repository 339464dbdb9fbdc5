"""The examples of a version's updates as tensors, drawn at once and gathered many at a time.

Without a memory the examples of a batch are drawn one by one. With one they are windows of
``memory_window`` consecutive steps of an episode, which begin at multiples of it.
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
from udrl.segments import RankedExperience, Segments, draw_segments
from udrl.streams import Stream
from udrl.targets import ReturnInTime
from udrl.value import relative

#: Paths of what was before an observation.
_PREVIOUS = [(key,) for key in PREVIOUS]
#: Bytes of observations that are gathered at once for the next updates.
_GATHERED_BYTES = 16 << 20

Seen = tuple[Tensor, ...]


class Draw(NamedTuple):
    """What the examples of all updates are.

    Attributes:
        segments: int64 [updates, examples] each.
        hidden: from which of them the previous action and reward are hidden, bool of that shape;
            None: from none.
        windows: with a memory, which windows of the buffer they are (:class:`Windows`), int64
            [updates, windows]; of each window there are as many examples as it has steps.
        valid: with a memory, which examples count, bool [updates, examples]: an episode's last
            window may be shorter, and its last step is there again until it is full.
    """

    segments: Segments
    hidden: npt.NDArray[np.bool_] | None = None
    windows: npt.NDArray[np.int64] | None = None
    valid: npt.NDArray[np.bool_] | None = None


class Windows:
    """The windows of all episodes in the buffer, episode by episode.

    Args:
        lengths: T of each episode, by rank.
        size: steps of a window.

    Attributes:
        size: steps of a window.
        first: number of each episode's first window, int64 [episodes].
        counts: how many it has, likewise.
    """

    def __init__(self, lengths: npt.NDArray[np.int64], size: int) -> None:
        self.size = size
        self.counts = -(-lengths // size)
        self.first = np.cumsum(self.counts) - self.counts
        self._lengths = lengths

    def draw(self, uniforms: npt.NDArray[np.float64]) -> Draw:
        """Turn numbers into windows: an episode uniformly, then one of its windows uniformly.

        Args:
            uniforms: in [0, 1), float64 [2, updates, windows].
        """
        rank = (uniforms[0] * len(self._lengths)).astype(np.int64)
        chunk = (uniforms[1] * self.counts[rank]).astype(np.int64)
        segments, valid = self.steps(rank, chunk)
        flat = Segments(*(s.reshape(len(rank), -1) for s in segments))
        return Draw(flat, None, self.first[rank] + chunk, valid.reshape(len(rank), -1))

    def steps(
        self, rank: npt.NDArray[np.int64], chunk: npt.NDArray[np.int64]
    ) -> tuple[Segments, npt.NDArray[np.bool_]]:
        """Return the trailing segments of windows' steps, and which of them exist.

        Args:
            rank: of the episodes, int64 of any shape.
            chunk: number of the window in its episode, likewise.

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
        stream: its numbers.
        experience: the buffer.
        config: the settings.
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
    # Of a window from all steps or from none, as an agent that copies itself needs one.
    together = draw.segments.rank if draw.windows is None else draw.windows
    hidden = stream.uniforms(together.size).reshape(together.shape) < training.drop_previous
    times = draw.segments.rank.shape[1] // together.shape[1]
    return draw._replace(hidden=hidden.repeat(times, axis=1))


class Batch(NamedTuple):
    """The examples of an update, where the networks are.

    Attributes:
        seen: s, as the networks see it, [batch, *shape] of each leaf.
        command: (desired return, desired horizon), each scaled, float32 [batch, 2]; relative to
            what is expected, once that is known.
        action: a, int64 [batch, *action_shape].
        windows: with a memory, numbers of the windows, int64 [windows]; on no device.
        valid: with a memory, which examples count, bool [batch].
    """

    seen: Seen
    command: Tensor
    action: Tensor
    windows: npt.NDArray[np.int64] | None
    valid: Tensor | None

    def counted(self, of_examples: Tensor) -> Tensor:
        """Return the rows of the examples that count."""
        return of_examples if self.valid is None else of_examples[self.valid]


class Batches:
    """The batches of a version's updates, gathered many at a time.

    The tensors are torch's own memory: it is aligned to 64 bytes, which numpy's is not, and the
    rounding of a matrix product may depend on alignment.

    Args:
        draw: what they are.
        experience: the buffer.
        config: the settings.
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

    def gather(self, *, hide: bool = False) -> Iterator[Batch]:
        """Yield the batches of all updates.

        Args:
            hide: hide the previous action and reward from the examples drawn for that.
        """
        draw = self._draw
        for first in range(0, len(draw.segments.rank), self._at_once):
            part = slice(first, first + self._at_once)
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
        """Gather the examples of some updates, and return of how many."""
        n = len(segments.rank)
        command, action = self._commands[:n].numpy(), self._actions[:n].numpy()
        flat = Segments(*(s.reshape(-1) for s in segments))
        examples = self._experience.examples(flat)
        for gathered, one in zip(self._seen, examples.seen, strict=True):
            gathered[:n].numpy()[:] = one.reshape(gathered[:n].shape)
        command[:] = (examples.command * self._scales).reshape(command.shape)
        if (expected := self._experience.expected_at(flat)) is not None:
            commands = self._commands[:n]
            commands[:] = relative(commands, torch.from_numpy(expected).view(commands.shape))
        action[:] = examples.action.reshape(action.shape)
        return n


def tensor_of(array: npt.NDArray[Any]) -> Tensor:
    """Return an array as a tensor in torch's own memory; a leaf of a record has odd strides."""
    return torch.from_numpy(np.ascontiguousarray(array)).clone()
