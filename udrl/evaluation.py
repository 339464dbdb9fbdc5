"""Section 2.3.6: the statistics of an evaluation."""

import math
from collections.abc import Sequence
from statistics import fmean, stdev
from typing import NamedTuple


class Evaluation(NamedTuple):
    """Mean and spread of the returns of an evaluation's episodes.

    Attributes:
        mean: mean return.
        std: standard deviation of the sample (divided by n - 1); 0 for one episode.
        ci95_low: lower end of the 95 % confidence interval of the mean, mean - 1.96 std / sqrt(n).
        ci95_high: upper end of that interval.
        episodes: number of episodes, n.
    """

    mean: float
    std: float
    ci95_low: float
    ci95_high: float
    episodes: int


def return_text(value: float) -> str:
    """Format a return: one decimal, or up to three significant digits below 10.

    Environments differ by orders of magnitude: returns of 0 to 1 need more decimals.
    """
    size = abs(value)
    if not 1e-4 <= size < 10:
        return f"{value:.3g}" if 0 < size < 1 else f"{value + 0.0:.1f}"
    whole, _, decimals = f"{value:.{2 - math.floor(math.log10(size))}f}".partition(".")
    return f"{whole}.{decimals.rstrip('0') or '0'}"


def interval_text(mean: float, half: float) -> str:
    """Format a mean and the half width of its interval, with as many decimals as that needs.

    These show its first significant digit, but are at least 1 and at most 6.
    """
    if half == 0:
        return f"{return_text(mean)} ± 0.0"
    decimals = min(max(1, math.ceil(-math.log10(half))), 6)
    return f"{round(mean, decimals) + 0.0:.{decimals}f} ± {half:.{decimals}f}"


def summarise(returns: Sequence[float]) -> Evaluation:
    """Return the statistics of episode returns, at least one."""
    mean = fmean(returns)
    std = stdev(returns) if len(returns) > 1 else 0.0
    half = 1.96 * std / math.sqrt(len(returns))
    return Evaluation(mean, std, mean - half, mean + half, len(returns))
