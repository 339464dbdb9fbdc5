"""Section 2.3.3: segments of the episodes in the replay buffer, which are training examples.

A segment teaches that in state s_t1, action a_t1 began a behavior that obtained the desired return
sum(r[t1..t2-1]) within the desired horizon t2 - t1. Trailing segments have t2 = T.
:mod:`udrl.experience` gathers their examples.
"""

from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

IndexArray = npt.NDArray[np.int64]


class Segments(NamedTuple):
    """Segments as int64 arrays of one shape: the episode's rank in the buffer, t1 and t2."""

    rank: IndexArray
    t1: IndexArray
    t2: IndexArray


def draw_segments(
    uniforms: npt.NDArray[np.float64], lengths: IndexArray, kind: Literal["trailing", "all"]
) -> Segments:
    """Draw segments: an episode uniformly, then the times uniformly.

    Args:
        uniforms: random numbers in [0, 1), float64 [3, ...]; trailing segments ignore the third
            row.
        lengths: T of each episode, by rank.
        kind: ``trailing``: 0 <= t1 < T, t2 = T. ``all``: 0 <= t1 < t2 <= T, with every pair of an
            episode equally likely.
    """
    rank = (uniforms[0] * len(lengths)).astype(np.int64)
    length = lengths[rank]
    if kind == "trailing":
        return Segments(rank, (uniforms[1] * length).astype(np.int64), length)
    # Two different times in 0..T: the second draw skips the first time.
    one = (uniforms[1] * (length + 1)).astype(np.int64)
    other = (uniforms[2] * length).astype(np.int64)
    other += other >= one
    return Segments(rank, np.minimum(one, other), np.maximum(one, other))
