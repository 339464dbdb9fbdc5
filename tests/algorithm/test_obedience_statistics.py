"""Statistics of obedience against loops that read like their definitions."""

import math
import statistics

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from udrl.obedience_statistics import (
    Means,
    correlation,
    evenly,
    mean_absolute_error,
    mean_of_nearest,
    obeyed,
    reachable,
    spread,
)

WHOLE = st.integers(-1000, 1000)
#: Commands, obtained returns, and half-widths of their intervals: integers, for exact sums.
MEASURED = st.lists(
    st.tuples(st.integers(-20, 20), st.integers(-20, 20), st.integers(0, 5)),
    min_size=1, max_size=12, unique_by=lambda row: row[0],
).map(sorted)  # fmt: skip


def means(rows: list[tuple[int, int, int]]) -> Means:
    commanded, mean, half = np.array(rows, np.float64).T
    return Means(commanded, mean, mean - half, mean + half)


def slow_obeyed_range(rows: list[tuple[int, int, int]], tolerance: float) -> slice | None:
    best = None
    for first in range(len(rows)):
        for last in range(first + 1, len(rows)):
            part = rows[first : last + 1]
            commanded, mean = [row[0] for row in part], [row[1] for row in part]
            (_, low, below), (_, high, above) = part[0], part[-1]
            if (
                all(abs(m - c) <= tolerance for c, m, _ in part)
                and low + below < high - above
                and slope_is_enough(commanded, mean)
                and (best is None or part[-1][0] - part[0][0] >= width(rows, best))
            ):
                best = slice(first, last + 1)
    return best


def width(rows: list[tuple[int, int, int]], part: slice) -> int:
    return rows[part][-1][0] - rows[part][0][0]


def slope_is_enough(x: list[int], y: list[int]) -> bool:
    """Whether the least squares line has a slope of at least 1/2, in integers."""
    n = len(x)
    together = n * sum(a * b for a, b in zip(x, y, strict=True)) - sum(x) * sum(y)
    return 2 * together >= n * sum(a * a for a in x) - sum(x) ** 2


@given(rows=MEASURED, tolerance=st.integers(0, 12))
def test_obeyed_range_is_the_widest_that_meets_its_definition(
    rows: list[tuple[int, int, int]], tolerance: int
) -> None:
    assert obeyed(means(rows), tolerance) == slow_obeyed_range(rows, tolerance)


def test_obeyed_range_ends_at_the_agents_best() -> None:
    rows = [(c, min(c, 60) + 1, 2) for c in range(0, 101, 10)]
    assert obeyed(means(rows), tolerance=10) == slice(0, 8)  # 70 gives 61, and so does 80


@pytest.mark.parametrize("half", [0, 9])
def test_agent_of_constant_behaviour_obeys_nowhere(half: int) -> None:
    """Some commands are within the tolerance of its constant return."""
    rows = [(c, 50 + (c % 20 == 0), half) for c in range(0, 101, 10)]
    assert obeyed(means(rows), tolerance=10) is None


def test_noise_is_not_obedience() -> None:
    rows = [(40, 44, 9), (50, 50, 9), (60, 56, 9)]
    assert obeyed(means(rows), tolerance=10) is None
    assert obeyed(means([(c, m, 5) for c, m, _ in rows]), tolerance=10) == slice(0, 3)


@given(values=st.lists(WHOLE, min_size=1, max_size=60))
def test_reachable_range_excludes_the_lowest_twentieth(values: list[int]) -> None:
    ranked = sorted(values)
    left_out = math.floor(round((len(values) - 1) / 20, 9))
    assert reachable(values) == (ranked[left_out], ranked[-1])


@given(values=st.lists(st.tuples(WHOLE, WHOLE), min_size=1, max_size=150), at=WHOLE)
def test_nearest_episodes_include_ties(values: list[tuple[int, int]], at: int) -> None:
    ranked = sorted(values, key=lambda pair: abs(pair[0] - at))
    last = ranked[: max(5, -(-len(values) // 20))][-1]
    nearest = [value for where, value in values if abs(where - at) <= abs(last[0] - at)]
    found = mean_of_nearest(at, *zip(*values, strict=True))
    assert found == pytest.approx(statistics.fmean(nearest))


@given(low=WHOLE, width=st.floats(0.001, 1e6), n=st.integers(2, 50))
def test_commands_are_evenly_spread_and_round(low: int, width: float, n: int) -> None:
    spacing = width / (n - 1)
    found = evenly(low, low + width, n)
    assert len(found) == n
    for k, value in enumerate(found):
        assert value == pytest.approx(low + k * spacing, abs=0.051 * spacing)
        assert len(f"{value:.12g}") <= 13
    assert evenly(low, low, n) == [low]


@given(values=st.lists(st.integers(0, 20), min_size=1, max_size=60), n=st.integers(2, 12))
def test_few_distinct_values_are_commanded_exactly(values: list[int], n: int) -> None:
    distinct = sorted(set(values))
    if len(distinct) <= n:
        assert spread(values, n) == distinct
    else:
        assert spread(values, n) == evenly(*reachable(values), n)


def test_commands_are_rounded_if_possible() -> None:
    assert evenly(0, 100, 11) == list(range(0, 101, 10))
    assert evenly(-119.31, 287.64, 11)[:3] == [-119, -79, -38]
    assert evenly(-0.04, 0.04, 2) == [-0.04, 0.04]
    assert str(evenly(-1, 1, 3)[1]) == "0.0"


@given(pairs=st.lists(st.tuples(WHOLE, WHOLE), min_size=1, max_size=20))
def test_correlation_and_error(pairs: list[tuple[int, int]]) -> None:
    x, y = map(list, zip(*pairs, strict=True))
    varies = len(set(x)) > 1 and len(set(y)) > 1
    expected = statistics.correlation(x, y) if varies else 0.0
    assert correlation(x, y) == pytest.approx(expected, abs=1e-9)
    error = statistics.fmean(abs(a - b) for a, b in pairs)
    assert mean_absolute_error(x, y) == pytest.approx(error)
