"""Section 3.5: how closely, and in which range, obtained returns follow desired returns.

Commands are taken from what the episodes of the replay buffer achieved (:func:`spread`,
:func:`mean_of_nearest`). The range in which an agent obeys follows from the mean return obtained
for each command (:func:`obeyed`).
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

#: Share of episodes, those with the lowest returns, that does not count as reachable: some are rare
#: accidents of exploration, far below the rest.
OUTLIERS = 0.05
#: Share of episodes that count as nearest to a return, and their minimum number.
NEAREST, MIN_NEAREST = 0.05, 5
#: Minimum slope of obtained over desired returns in a range that counts as obeyed.
MIN_SLOPE = 0.5

Floats = npt.NDArray[np.float64]


class Means(NamedTuple):
    """Mean obtained value for each command, in increasing order of the commanded value.

    Attributes:
        commanded: commanded values, float64 [n], without duplicates.
        mean: mean obtained values, float64 [n].
        ci95_low: lower ends of their 95 % confidence intervals, float64 [n].
        ci95_high: upper ends, float64 [n].
    """

    commanded: Floats
    mean: Floats
    ci95_low: Floats
    ci95_high: Floats


def reachable(values: npt.ArrayLike) -> tuple[float, float]:
    """Return the lowest and the highest value, without the lowest :data:`OUTLIERS`.

    Args:
        values: returns or lengths of episodes, float [n], at least one.
    """
    values = np.asarray(values, np.float64)
    return float(np.quantile(values, OUTLIERS, method="lower")), float(values.max())


def evenly(low: float, high: float, n: int) -> list[float]:
    """Return at most ``n`` evenly spaced values from ``low`` to ``high``, without duplicates.

    They are rounded to a tenth of the decimal place of their spacing, so that they are short to
    write: -119.3 to 287.6 in 11 values is -119, -79, ..., 288.

    Args:
        low: lowest value.
        high: highest value, at least ``low``.
        n: number of values, at least 2.
    """
    if not high > low:
        return [low]
    digits = 1 - math.floor(math.log10((high - low) / (n - 1)))
    # Adding 0 turns -0 into 0.
    return sorted({round(float(value), digits) + 0.0 for value in np.linspace(low, high, n)})


def spread(values: npt.ArrayLike, n: int) -> list[float]:
    """Return values to command, given those of episodes: at most ``n``, in increasing order.

    If there are at most ``n`` distinct values, these: values in between may be impossible to
    obtain. Otherwise evenly spaced values (:func:`evenly`) over the :func:`reachable` range.

    Args:
        values: returns or lengths of episodes, float [m], at least one.
        n: maximum number of values, at least 2.
    """
    distinct = np.unique(np.asarray(values, np.float64))
    return distinct.tolist() if len(distinct) <= n else evenly(*reachable(values), n)


def mean_of_nearest(at: float, where: npt.ArrayLike, values: npt.ArrayLike) -> float:
    """Return the mean value of the episodes whose returns are nearest to a return.

    These are the share :data:`NEAREST` of all episodes, at least :data:`MIN_NEAREST`, and all at
    the same distance as the last of these.

    Args:
        at: the return.
        where: returns of the episodes, float [n], at least one.
        values: values to average, e.g. the episodes' lengths, float [n].
    """
    distance = np.abs(np.asarray(where, np.float64) - at)
    count = min(len(distance), max(MIN_NEAREST, math.ceil(NEAREST * len(distance))))
    furthest = np.partition(distance, count - 1)[count - 1]
    return float(np.asarray(values, np.float64)[distance <= furthest].mean())


def correlation(commanded: npt.ArrayLike, obtained: npt.ArrayLike) -> float:
    """Return Pearson's correlation; 0 if one of the two does not vary.

    Args:
        commanded: commanded values, float [n], at least one.
        obtained: obtained values, float [n].
    """
    x, y = (np.asarray(values, np.float64) for values in (commanded, obtained))
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        return 0.0
    x, y = x - x.mean(), y - y.mean()
    # Normalised first, so that squares do not overflow.
    x, y = x / np.abs(x).max(), y / np.abs(y).max()
    return float(np.clip(x @ y / math.sqrt((x @ x) * (y @ y)), -1.0, 1.0))


def mean_absolute_error(commanded: npt.ArrayLike, obtained: npt.ArrayLike) -> float:
    """Return the mean absolute difference between commanded and obtained values.

    Args:
        commanded: commanded values, float [n], at least one.
        obtained: obtained values, float [n].
    """
    return float(np.abs(np.asarray(obtained) - np.asarray(commanded)).mean())


def obeyed(means: Means, tolerance: float) -> slice | None:
    """Return the commands of the range in which an agent obeys; None: there is no such range.

    It is the widest range that meets all of these conditions, and the highest of equally wide ones:

    - Every mean is within ``tolerance`` of its command.
    - The mean increases with the command: the slope of the least-squares line is at least
      :data:`MIN_SLOPE`.
    - The increase is significant: the confidence interval at the upper end lies above that at the
      lower end.

    Args:
        means: mean obtained return for each command.
        tolerance: at least 0, in units of the return.
    """
    x, n = means.commanded, len(means.commanded)
    near = np.abs(means.mean - x) <= tolerance
    outside = np.concatenate([[0], np.cumsum(~near)])
    first, last = np.triu_indices(n, k=1)
    allowed = outside[last + 1] == outside[first]
    allowed &= means.ci95_low[last] > means.ci95_high[first]
    # n Sxy and n Sxx of every range, from cumulative sums.
    x, y = x - x[:1], means.mean - x[:1]
    count = (last + 1 - first).astype(np.float64)

    def sums(values: Floats) -> Floats:
        until = np.concatenate([[0.0], np.cumsum(values)])
        total: Floats = until[last + 1] - until[first]
        return total

    sum_x = sums(x)
    together = count * sums(x * y) - sum_x * sums(y)
    allowed &= together >= MIN_SLOPE * (count * sums(x * x) - sum_x**2)
    if not allowed.any():
        return None
    width = np.where(allowed, x[last] - x[first], -1.0)
    best = int(np.flatnonzero(width == width.max())[-1])
    return slice(int(first[best]), int(last[best]) + 1)
