"""Section 2.3.6: what an evaluation says."""

import math
from collections.abc import Sequence
from statistics import fmean, stdev
from typing import NamedTuple


class Evaluation(NamedTuple):
    """Mean and spread of the returns of an evaluation's episodes.

    Attributes:
        mean: of the returns.
        std: standard deviation of the sample (divided by n - 1); 0 for one episode.
        ci95_low: lower end of the 95 % confidence interval of the mean, mean - 1.96 std / sqrt(n).
        ci95_high: its upper end.
        episodes: n.
    """

    mean: float
    std: float
    ci95_low: float
    ci95_high: float
    episodes: int


def summarise(returns: Sequence[float]) -> Evaluation:
    """Return the evaluation of some episode returns, at least one."""
    mean = fmean(returns)
    std = stdev(returns) if len(returns) > 1 else 0.0
    half = 1.96 * std / math.sqrt(len(returns))
    return Evaluation(mean, std, mean - half, mean + half, len(returns))
