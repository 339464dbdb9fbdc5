"""What the networks remember: the most recent observations of an episode, or the last alone."""

from typing import Any

import numpy as np
import numpy.typing as npt

from udrl.spaces import LeafSpace, Observations, ObservationSpace, leaves_of, parts_of

#: What the networks see: an array for each leaf of the observations, [n, *shape].
Seen = tuple[npt.NDArray[Any], ...]


class FrameStack:
    """The last ``frame_stack`` observations, one after another along the first dimension.

    Before an episode's first observation there is the first again.

    Args:
        space: of single observations.
        length: how many, ``frame_stack``.

    Attributes:
        length: how many.
        shapes: of what the networks see of each leaf; of a category [length].
    """

    def __init__(self, space: ObservationSpace, length: int) -> None:
        self.length = length
        self.shapes = tuple(_stacked(leaf.space, length) for leaf in leaves_of(space))

    def times(self, t: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Return the times of the observations that are seen at times ``t``.

        Args:
            t: int64 [n].

        Returns:
            int64 [n, length]: t - length + 1 to t; 0 for those before the episode.
        """
        times: npt.NDArray[np.int64] = np.maximum(t[:, None] - np.arange(self.length)[::-1], 0)
        return times

    def join(self, observations: Observations) -> Seen:
        """Return what the networks see of observations, [n, length, *observation_shape].

        Of a length of 1 it is a view.
        """
        n = len(observations)
        return tuple(
            part.reshape(n, *shape)
            for part, shape in zip(parts_of(observations), self.shapes, strict=True)
        )


def _stacked(space: LeafSpace, length: int) -> tuple[int, ...]:
    """Return the shape of so many elements, one after another along the first dimension."""
    first, *rest = space.shape or (1,)
    return (length * first, *rest)
