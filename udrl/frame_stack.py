"""Frame stacks: the most recent observations of an episode as the networks' input."""

from typing import Any

import numpy as np
import numpy.typing as npt

from udrl.spaces import LeafSpace, Observations, ObservationSpace, leaves_of, parts_of

#: The networks' input: an array for each leaf of the observations, [n, *shape].
Seen = tuple[npt.NDArray[Any], ...]


class FrameStack:
    """The last ``frame_stack`` observations, concatenated along the first dimension.

    At the start of an episode, the first observation is repeated.

    Args:
        space: space of single observations.
        length: number of observations, ``frame_stack``.

    Attributes:
        length: number of observations.
        shapes: shape of the networks' input for each leaf; [length] for a category.
    """

    def __init__(self, space: ObservationSpace, length: int) -> None:
        self.length = length
        self.shapes = tuple(_stacked(leaf.space, length) for leaf in leaves_of(space))

    def times(self, t: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Return the times of the observations in the stacks of times ``t``.

        Args:
            t: int64 [n].

        Returns:
            int64 [n, length]: t - length + 1 to t; 0 instead of negative times.
        """
        times: npt.NDArray[np.int64] = np.maximum(t[:, None] - np.arange(self.length)[::-1], 0)
        return times

    def join(self, observations: Observations) -> Seen:
        """Return the networks' input for observations, [n, length, *observation_shape].

        They are views if the length is 1.
        """
        n = len(observations)
        return tuple(
            part.reshape(n, *shape)
            for part, shape in zip(parts_of(observations), self.shapes, strict=True)
        )


def _stacked(space: LeafSpace, length: int) -> tuple[int, ...]:
    """Return the shape of ``length`` elements, concatenated along the first dimension."""
    first, *rest = space.shape or (1,)
    return (length * first, *rest)
