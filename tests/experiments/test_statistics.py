import csv
import hashlib
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from random import Random
from statistics import NormalDist, fmean, pstdev

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from udrl.errors import ConfigError
from udrl.streams import Purpose, Stream, stream_key
from udrl_experiments.records import EvaluationRecord
from udrl_experiments.statistics import (
    CurvePoint,
    Reached,
    bootstrap_interval,
    curves,
    reached,
    score,
)
from udrl_inspect.csv_tables import read, write

RETURNS = st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=12)


def evaluated(
    env_steps: int,
    mean: float,
    seed: int = 1,
    *,
    algorithm: str = "UDRL",
    variant: str = "",
    wall_s: float = 0.0,
) -> EvaluationRecord:
    return EvaluationRecord(
        environment="LunarLander-v3", algorithm=algorithm, variant=variant, seed=seed,
        env_steps=env_steps, wall_s=wall_s, mean=mean, std=1.0, episodes=100,
    )  # fmt: skip


# The bootstrap.


def slow_interval(values: Sequence[float], samples: int, level: float) -> tuple[float, float]:
    """Section 3.3 on lists: number i * samples + j selects value i of resample j."""
    ordered, n = sorted(values), len(values)
    numbers = Stream(hashlib.sha256(b"udrl/study/bootstrap/1").digest()[:16]).uniforms(n * samples)
    means = []
    for j in range(samples):
        total = 0.0
        for i in range(n):
            total += ordered[int(numbers[i * samples + j] * n)]
        means.append(total / n)
    means.sort()

    def quantile(q: float) -> float:
        place = q * (samples - 1)
        below = int(place)
        above = min(below + 1, samples - 1)
        return means[below] + (place - below) * (means[above] - means[below])

    return quantile((1 - level) / 2), quantile((1 + level) / 2)


@given(RETURNS, st.integers(1, 200), st.sampled_from([0.5, 0.9, 0.95, 0.99]))
def test_interval_equals_that_of_a_slow_bootstrap(
    values: list[float], samples: int, level: float
) -> None:
    scale = max(map(abs, values))
    assert bootstrap_interval(values, samples, level) == pytest.approx(
        slow_interval(values, samples, level), rel=1e-12, abs=1e-12 * scale
    )


@given(RETURNS, st.randoms(use_true_random=False), st.floats(-1e6, 1e6))
def test_interval_is_within_the_values_and_equivariant_to_shifts(
    values: list[float], random: Random, shift: float
) -> None:
    low, high = bootstrap_interval(values)
    assert min(values) <= low <= high <= max(values)
    shuffled = list(values)
    random.shuffle(shuffled)
    assert bootstrap_interval(shuffled) == (low, high)
    assert bootstrap_interval([value + shift for value in values]) == pytest.approx(
        (low + shift, high + shift), abs=1e-8
    )


@given(st.floats(-1e300, 1e300), st.integers(1, 20))
def test_interval_of_equal_values_is_that_value(value: float, n: int) -> None:
    assert bootstrap_interval([value] * n) == (value, value)


def test_interval_is_pinned() -> None:
    assert bootstrap_interval([3.0, 10.0, 1.0, 4.0]) == pytest.approx((1.75, 8.25625), rel=1e-12)


def test_interval_of_many_values_is_the_normal_one() -> None:
    n = 400
    values = [NormalDist(100, 30).inv_cdf((i + 0.5) / n) for i in range(n)]
    half = 1.96 * pstdev(values) / math.sqrt(n)
    # Five times the random error of 20 000 resamples: a quantile's error is 0.019 half / 1.96.
    assert bootstrap_interval(values, samples=20_000) == pytest.approx(
        (100 - half, 100 + half), abs=0.05 * half
    )


def test_interval_has_approximately_its_nominal_coverage() -> None:
    numbers = Stream(stream_key(1, Purpose.PROBE)).uniforms(600 * 30).reshape(600, 30)
    held = sum(low <= 0.5 <= high for low, high in map(bootstrap_interval, numbers.tolist()))
    # Thirty values are few for a percentile bootstrap: its coverage is 93 to 94 %.
    assert 0.90 < held / 600 < 0.97


def test_interval_of_no_values_is_an_error() -> None:
    with pytest.raises(ConfigError, match="no values for a bootstrap interval; expected"):
        bootstrap_interval([])


# The score.


@pytest.mark.parametrize(
    ("means", "last", "mean"),
    [
        ([float(i) for i in range(1, 31)], 20, 20.5),
        ([1.0, 2.0, 6.0], 20, 3.0),
        ([1.0, 2.0, 6.0], 2, 4.0),
        ([1.0, 2.0, 6.0], 1, 6.0),
        ([7.0], 20, 7.0),
    ],
)
def test_score_is_the_mean_of_the_last_evaluations(
    means: list[float], last: int, mean: float
) -> None:
    assert score(means, last) == mean


def test_score_has_twenty_evaluations_by_default() -> None:
    assert score([1e9, *[2.0] * 20]) == 2.0


@pytest.mark.parametrize(("means", "last"), [([], 20), ([1.0], 0), ([1.0], -1)])
def test_score_of_no_evaluations_is_an_error(means: list[float], last: int) -> None:
    with pytest.raises(ConfigError, match=f"last {last} of {len(means)} .* expected at least one"):
        score(means, last)


# Curves.

ROWS = st.lists(
    st.builds(
        evaluated,
        st.integers(0, 45),
        st.floats(-1e3, 1e3),
        st.integers(1, 3),
        algorithm=st.sampled_from(["UDRL", "A2C"]),
        variant=st.sampled_from(["", "lead 2"]),
        wall_s=st.floats(0, 1e5),
    ),
    max_size=30,
)


def slow_curves(rows: Sequence[EvaluationRecord], every: int) -> Iterator[CurvePoint]:
    agents = []
    for row in rows:
        if (row.algorithm, row.variant) not in agents:
            agents.append((row.algorithm, row.variant))
    for agent in agents:
        own = [row for row in rows if (row.algorithm, row.variant) == agent]
        seeds = {row.seed for row in own}
        for start in range(0, 1 + max(row.env_steps for row in own), every):
            here = [row for row in own if start <= row.env_steps < start + every]
            if {row.seed for row in here} != seeds:
                continue
            firsts = []
            for seed in seeds:
                run = [row for row in here if row.seed == seed]
                earliest = min(row.env_steps for row in run)
                firsts.append(next(row for row in run if row.env_steps == earliest))
            low, high = bootstrap_interval([row.mean for row in firsts])
            yield CurvePoint(
                environment="LunarLander-v3", algorithm=agent[0], variant=agent[1],
                env_steps=start, wall_s=fmean(row.wall_s for row in firsts), seeds=len(seeds),
                mean=fmean(row.mean for row in firsts), low=low, high=high,
            )  # fmt: skip


@given(ROWS, st.integers(1, 20))
def test_curves_equal_those_of_a_slow_search(rows: list[EvaluationRecord], every: int) -> None:
    assert curves(rows, every) == list(slow_curves(rows, every))


def test_bin_without_all_seeds_has_no_point() -> None:
    rows = [
        evaluated(1_003, 10.0, 1, wall_s=5.0), evaluated(2_000, 20.0, 1), evaluated(3_001, 30.0, 1),
        evaluated(1_999, 30.0, 2, wall_s=7.0), evaluated(3_999, 50.0, 2),
    ]  # fmt: skip
    points = curves(rows, 1_000)
    assert [(p.env_steps, p.mean, p.seeds) for p in points] == [(1_000, 20.0, 2), (3_000, 40.0, 2)]
    assert points[0].wall_s == 6.0


def test_earliest_evaluation_of_a_bin_counts() -> None:
    rows = [evaluated(1_010, 2.0), evaluated(1_005, 1.0), evaluated(1_005, 3.0)]
    assert [point.mean for point in curves(rows, 1_000)] == [1.0]


def test_agents_and_environments_are_ordered_by_their_first_rows() -> None:
    first = evaluated(0, 1.0, variant="lead 2")
    elsewhere = msgspec.structs.replace(first, environment="TakeCover-v0")
    rows = [first, evaluated(0, 2.0, algorithm="A2C"), elsewhere, evaluated(50, 3.0, 9)]
    points = curves(rows, 50)
    assert [(p.environment, p.algorithm, p.variant, p.env_steps) for p in points] == [
        ("LunarLander-v3", "UDRL", "lead 2", 0),
        ("LunarLander-v3", "A2C", "", 0),
        ("TakeCover-v0", "UDRL", "lead 2", 0),
        ("LunarLander-v3", "UDRL", "", 50),
    ]


def test_points_are_rows_of_a_tidy_table(tmp_path: Path) -> None:
    points = curves([evaluated(100, 0.1, 1), evaluated(100, 1 / 3, 2)], 50)
    write(tmp_path / "curves.csv", CurvePoint, points)
    assert read(tmp_path / "curves.csv", CurvePoint) == points


@pytest.mark.parametrize("every", [0, -1])
def test_nonpositive_bin_width_is_an_error(every: int) -> None:
    with pytest.raises(ConfigError, match=f"interval of {every} env steps; expected at least 1"):
        curves([], every)


# Thresholds.


def slow_reached(
    rows: Sequence[EvaluationRecord], thresholds: Sequence[float]
) -> Iterator[Reached]:
    runs = []
    for row in rows:
        if (row.algorithm, row.variant, row.seed) not in runs:
            runs.append((row.algorithm, row.variant, row.seed))
    for algorithm, variant, seed in runs:
        for threshold in thresholds:
            found = None
            for row in rows:
                own = (row.algorithm, row.variant, row.seed) == (algorithm, variant, seed)
                earlier = found is None or row.env_steps < found.env_steps
                if own and row.mean >= threshold and earlier:
                    found = row
            yield Reached(
                environment="LunarLander-v3", algorithm=algorithm, variant=variant, seed=seed,
                threshold=threshold, env_steps=found.env_steps if found else None,
                wall_s=found.wall_s if found else None,
            )  # fmt: skip


@given(ROWS, st.lists(st.floats(-1e3, 1e3), max_size=3))
def test_reached_equals_the_result_of_a_slow_search(
    rows: list[EvaluationRecord], thresholds: list[float]
) -> None:
    assert reached(rows, thresholds) == list(slow_reached(rows, thresholds))


def test_threshold_is_reached_by_equality_and_need_not_be_kept() -> None:
    rows = [
        evaluated(0, -3.0, wall_s=1.0), evaluated(50, 200.0, wall_s=2.5),
        evaluated(100, 90.0, wall_s=4.0), evaluated(150, 210.0, wall_s=5.0),
    ]  # fmt: skip
    found = [(row.threshold, row.env_steps, row.wall_s) for row in reached(rows, [200.0, -5, 300])]
    assert found == [(200.0, 50, 2.5), (-5, 0, 1.0), (300, None, None)]


def test_unreached_threshold_is_an_empty_field(tmp_path: Path) -> None:
    write(tmp_path / "reached.csv", Reached, reached([evaluated(50, 1.0)], [2.0]))
    with (tmp_path / "reached.csv").open(encoding="utf-8", newline="") as file:
        (row,) = csv.DictReader(file)
    assert (row["threshold"], row["env_steps"], row["wall_s"]) == ("2.0", "", "")
