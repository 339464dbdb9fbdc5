from itertools import combinations
from typing import Literal

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from udrl.segments import draw_segments
from udrl.streams import Purpose, Stream, stream_key

Kind = Literal["trailing", "all"]


def all_times(length: int) -> list[tuple[int, int]]:
    return list(combinations(range(length + 1), 2))


def draw_one(u: tuple[float, float, float], lengths: list[int], kind: Kind) -> tuple[int, int, int]:
    """Draw an episode uniformly, then the times uniformly."""
    rank = int(u[0] * len(lengths))
    length = lengths[rank]
    if kind == "trailing":
        return rank, range(length)[int(u[1] * length)], length
    times = list(range(length + 1))
    one = times.pop(int(u[1] * len(times)))
    other = times.pop(int(u[2] * len(times)))
    return rank, min(one, other), max(one, other)


units = st.floats(0, 1, exclude_max=True)


@pytest.mark.parametrize("kind", ["trailing", "all"])
@given(
    lengths=st.lists(st.integers(1, 1000), min_size=1, max_size=5),
    uniforms=st.lists(st.tuples(units, units, units), min_size=1),
)
def test_segments_equal_those_of_a_loop_over_examples(
    kind: Kind, lengths: list[int], uniforms: list[tuple[float, float, float]]
) -> None:
    drawn = draw_segments(np.array(uniforms).T, np.array(lengths), kind)
    assert list(zip(*(a.tolist() for a in drawn), strict=True)) == [
        draw_one(u, lengths, kind) for u in uniforms
    ]


def uniform_numbers(n: int) -> npt.NDArray[np.float64]:
    return Stream(stream_key(1, Purpose.PROBE)).uniforms(3 * n).reshape(3, n)


def chi_square(counts: npt.NDArray[np.int64], probabilities: npt.NDArray[np.float64]) -> float:
    expected = counts.sum() * probabilities
    return float(((counts - expected) ** 2 / expected).sum())


@pytest.mark.parametrize("kind", ["trailing", "all"])
def test_episodes_and_their_segments_are_equally_likely(kind: Kind) -> None:
    lengths = [1, 2, 3, 7]
    possible: list[tuple[int, int, int]] = []
    probabilities: list[float] = []
    for rank, length in enumerate(lengths):
        times = [(t, length) for t in range(length)] if kind == "trailing" else all_times(length)
        possible += [(rank, *pair) for pair in times]
        probabilities += [1 / len(lengths) / len(times)] * len(times)

    drawn = draw_segments(uniform_numbers(200_000), np.array(lengths), kind)
    values, counts = np.unique(np.stack(drawn), axis=1, return_counts=True)

    assert [tuple(v) for v in values.T.tolist()] == sorted(possible)
    # With k - 1 degrees of freedom, chi-square has mean k - 1 and variance 2 (k - 1).
    freedom = len(possible) - 1
    assert chi_square(counts, np.array(probabilities)) < freedom + 4 * (2 * freedom) ** 0.5


@pytest.mark.parametrize("kind", ["trailing", "all"])
def test_segments_keep_the_shape_of_their_random_numbers(kind: Kind) -> None:
    numbers = uniform_numbers(6)
    flat = draw_segments(numbers, np.array([4, 5]), kind)
    shaped = draw_segments(numbers.reshape(3, 2, 3), np.array([4, 5]), kind)
    for one, other in zip(flat, shaped, strict=True):
        np.testing.assert_array_equal(one.reshape(2, 3), other)
