"""What the paper says about several runs: mean curves with bootstrap intervals, scores, thresholds.

Everything here is a function of a tidy table alone: the bootstrap resamples with the numbers of one
fixed stream, so drawing a figure again from the same file gives the same figure.
"""

import hashlib
from collections.abc import Iterable, Sequence
from statistics import fmean

import msgspec
import numpy as np

from udrl.errors import ConfigError
from udrl.streams import Stream
from udrl_experiments.records import EvaluationRecord

_KEY = hashlib.sha256(b"udrl/study/bootstrap/1").digest()[:16]


class CurvePoint(msgspec.Struct, frozen=True, kw_only=True):
    """A point of a learning curve (Figures 4 and 5): the evaluations of all seeds at one time.

    Attributes:
        environment: Gymnasium's id.
        algorithm: one of :data:`udrl_experiments.protocol.Algorithm`.
        variant: what sets the agents apart within the study; may be empty.
        env_steps: training steps before the evaluations, a multiple of the curves' interval.
        wall_s: seconds before the end of the evaluations, mean over the seeds.
        seeds: how many.
        mean: of the seeds' evaluation scores.
        low: lower end of the 95 % bootstrap interval of the mean.
        high: its upper end.
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
    """When the evaluations of a run first had a mean return that was asked for.

    Attributes:
        environment: Gymnasium's id.
        algorithm: one of :data:`udrl_experiments.protocol.Algorithm`.
        variant: what sets the agent apart within the study; may be empty.
        seed: of the run.
        threshold: the mean return.
        env_steps: training steps before the evaluation; none if no evaluation reached it.
        wall_s: seconds before the evaluation's end; none if no evaluation reached it.
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
    """Return the percentile bootstrap interval of the mean (section 3.3): its lower and upper end.

    The order of the values does not matter. The interval of one value is that value twice.

    Args:
        values: finite, at least one; of independent runs.
        samples: how often to resample.
        level: of the interval, between 0 and 1.

    Raises:
        ConfigError: there are no values.
    """
    if not values:
        raise ConfigError("an interval of no values; expected the scores of at least one run")
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    chosen = Stream(_KEY).integers(len(ordered) * samples, 0, len(ordered))
    # A column per resample: numpy adds up rows one after the other, the same on every processor.
    means = ordered[chosen.reshape(len(ordered), samples)].sum(axis=0) / len(ordered)
    ends = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    # Rounding can carry the mean of equal values past them.
    low, high = np.clip(ends, ordered[0], ordered[-1])
    return float(low), float(high)


def score(means: Sequence[float], last: int = 20) -> float:
    """Return the score of a run: the mean of its last evaluations (Appendix B).

    Args:
        means: mean return of each evaluation, in their order.
        last: how many count, at least one; all of them if there are fewer.

    Raises:
        ConfigError: there are no evaluations, or none should count.
    """
    if not means or last < 1:
        raise ConfigError(
            f"a score of the last {last} of {len(means)} evaluations; expected at least one"
        )
    return fmean(means[-last:])


def curves(rows: Iterable[EvaluationRecord], every: int) -> list[CurvePoint]:
    """Return the learning curves of runs that differ in their seeds (section 3.3).

    An evaluation belongs to the last multiple of ``every`` that the run had passed; if several of a
    run belong to the same one, the earliest counts. A multiple is a point only where all seeds
    have it: a curve never bends because a seed is missing.

    Args:
        rows: evaluations of any number of agents.
        every: interval between points, in env steps.

    Returns:
        The points in the order of env steps, agent after agent in the order of their first rows.

    Raises:
        ConfigError: the interval is not positive.
    """
    if every < 1:
        raise ConfigError(f"points every {every} env steps; expected at least 1")
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
    """Return when each run first reached each threshold.

    Args:
        rows: evaluations of any number of runs.
        thresholds: mean returns; an evaluation reaches one that it equals.

    Returns:
        A row for each run and threshold, runs in the order of their first rows.
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
