"""Statistics of runs as in the paper: curves with bootstrap intervals, scores, thresholds.

All results are functions of a tidy table. The bootstrap uses a fixed random stream, so the same
table always gives the same figure.
"""

import hashlib
from collections.abc import Iterable, Sequence
from statistics import fmean

import msgspec
import numpy as np

from udrl.errors import ConfigError
from udrl.streams import Stream
from udrl_experiments.protocol import LAST
from udrl_experiments.records import EvaluationRecord

_KEY = hashlib.sha256(b"udrl/study/bootstrap/1").digest()[:16]


class CurvePoint(msgspec.Struct, frozen=True, kw_only=True):
    """A point of a learning curve (Figures 4 and 5): the evaluations of all seeds at one step.

    Attributes:
        environment: Gymnasium's id.
        algorithm: one of :data:`udrl_experiments.protocol.Algorithm`.
        variant: label that distinguishes agents of a study; may be empty.
        env_steps: training steps before the evaluations, a multiple of the curve's interval.
        wall_s: seconds from the start to the end of the evaluations, mean over the seeds.
        seeds: number of seeds.
        mean: mean over the seeds of the evaluations' mean returns.
        low: lower bound of the 95 % bootstrap interval of the mean.
        high: upper bound of this interval.
    """

    environment: str
    algorithm: str
    variant: str
    env_steps: int
    wall_s: float
    seeds: int
    mean: float
    low: float
    high: float


class Reached(msgspec.Struct, frozen=True, kw_only=True):
    """The first evaluation of a run that reached a threshold.

    Attributes:
        environment: Gymnasium's id.
        algorithm: one of :data:`udrl_experiments.protocol.Algorithm`.
        variant: label that distinguishes agents of a study; may be empty.
        seed: seed of the run.
        threshold: the mean return to reach.
        env_steps: training steps before the evaluation; none if the threshold was not reached.
        wall_s: seconds from the start to the evaluation's end; none likewise.
    """

    environment: str
    algorithm: str
    variant: str
    seed: int
    threshold: float
    env_steps: int | None
    wall_s: float | None


def bootstrap_interval(
    values: Sequence[float], samples: int = 1000, level: float = 0.95
) -> tuple[float, float]:
    """Return the bounds of the percentile bootstrap interval of the mean (section 3.3).

    The order of the values does not matter. The bounds of a single value are the value itself.

    Args:
        values: finite values of independent runs, at least one.
        samples: number of bootstrap samples.
        level: confidence level, between 0 and 1.

    Raises:
        ConfigError: there are no values.
    """
    if not values:
        raise ConfigError("no values for a bootstrap interval; expected those of at least one run")
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    chosen = Stream(_KEY).integers(len(ordered) * samples, 0, len(ordered))
    # One column per sample: numpy adds rows in order, with the same rounding on every processor.
    means = ordered[chosen.reshape(len(ordered), samples)].sum(axis=0) / len(ordered)
    ends = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    # Rounding can move the mean of equal values beyond them.
    low, high = np.clip(ends, ordered[0], ordered[-1])
    return float(low), float(high)


def score(means: Sequence[float], last: int = LAST) -> float:
    """Return the score of a run: the mean of its last evaluations (Appendix B).

    Args:
        means: mean return of each evaluation, in order.
        last: number of evaluations in the score, at least 1; all of them if there are fewer.

    Raises:
        ConfigError: there are no evaluations, or ``last`` is less than 1.
    """
    if not means or last < 1:
        raise ConfigError(
            f"score of the last {last} of {len(means)} evaluations; expected at least one"
        )
    return fmean(means[-last:])


def curves(rows: Iterable[EvaluationRecord], every: int) -> list[CurvePoint]:
    """Return the learning curves of runs that differ in their seeds (section 3.3).

    An evaluation counts at the last multiple of ``every`` that the run had reached. If several of a
    run count at the same multiple, the earliest is used. A multiple at which some seed has no
    evaluation is left out, so that a curve never jumps because a seed is missing.

    Args:
        rows: evaluations of any number of agents.
        every: interval between points, in env steps.

    Returns:
        The points by agent, in the order of the agents' first rows, then by env steps.

    Raises:
        ConfigError: the interval is not positive.
    """
    if every < 1:
        raise ConfigError(f"interval of {every} env steps; expected at least 1")
    agents: dict[tuple[str, str, str], dict[int, dict[int, EvaluationRecord]]] = {}
    for row in rows:
        bins = agents.setdefault((row.environment, row.algorithm, row.variant), {})
        runs = bins.setdefault(row.env_steps // every * every, {})
        if row.seed not in runs or row.env_steps < runs[row.seed].env_steps:
            runs[row.seed] = row
    points = []
    for (environment, algorithm, variant), bins in agents.items():
        seeds = {seed for runs in bins.values() for seed in runs}
        for env_steps, runs in sorted(bins.items()):
            if runs.keys() != seeds:
                continue
            means = [row.mean for row in runs.values()]
            low, high = bootstrap_interval(means)
            point = CurvePoint(
                environment=environment, algorithm=algorithm, variant=variant,
                env_steps=env_steps, wall_s=fmean(row.wall_s for row in runs.values()),
                seeds=len(seeds), mean=fmean(means), low=low, high=high,
            )  # fmt: skip
            points.append(point)
    return points


def reached(rows: Iterable[EvaluationRecord], thresholds: Sequence[float]) -> list[Reached]:
    """Return the first evaluation of each run that reached each threshold.

    Args:
        rows: evaluations of any number of runs.
        thresholds: mean returns; equality counts.

    Returns:
        One row per run and threshold, runs in the order of their first rows.
    """
    runs: dict[tuple[str, str, str, int], list[EvaluationRecord]] = {}
    for one in rows:
        key = (one.environment, one.algorithm, one.variant, one.seed)
        runs.setdefault(key, []).append(one)
    found = []
    for (environment, algorithm, variant, seed), run in runs.items():
        run.sort(key=lambda one: one.env_steps)
        for threshold in thresholds:
            first = next((one for one in run if one.mean >= threshold), None)
            row = Reached(
                environment=environment, algorithm=algorithm, variant=variant, seed=seed,
                threshold=threshold, env_steps=None if first is None else first.env_steps,
                wall_s=None if first is None else first.wall_s,
            )  # fmt: skip
            found.append(row)
    return found
