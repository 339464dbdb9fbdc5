"""What the networks remember: the most recent observations of an episode, or the last alone."""

import numpy as np
import numpy.typing as npt

from udrl.spaces import Category, Observations, ObservationSpace


class FrameStack:
    """The last ``frame_stack`` observations, one after another along the first dimension.

    Before an episode's first observation there is the first again.

    Args:
        space: of single observations.
        length: how many, ``frame_stack``.

    Attributes:
        length: how many.
        shape: of what the networks see; of a category [length].
    """

    def __init__(self, space: ObservationSpace, length: int) -> None:
        self.length = length
        first, *rest = (1,) if isinstance(space, Category) else space.shape
        self.shape: tuple[int, ...] = (length * first, *rest)

    def times(self, t: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Return the times of the observations that are seen at times ``t``.

        Args:
            t: int64 [n].

        Returns:
            int64 [n, length]: t - length + 1 to t; 0 for those before the episode.
        """
        times: npt.NDArray[np.int64] = np.maximum(t[:, None] - np.arange(self.length)[::-1], 0)
        return times

    def join(self, observations: Observations) -> Observations:
        """Return what the networks see, [n, *shape], of [n, length, *observation_shape]."""
        return observations.reshape(len(observations), *self.shape)
