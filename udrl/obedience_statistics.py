"""Section 3.5: how obtained returns follow commanded ones, and where they do.

What can be commanded is what the episodes of the replay buffer did (:func:`spread`,
:func:`mean_of_nearest`); where an agent obeys is judged by the mean return that it
obtains for each command (:func:`obeyed`).
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

#: Share of the episodes, those with the least returns, that does not count as reachable: among them
#: are rare accidents of exploration, far below all others.
OUTLIERS = 0.05
#: Share of the episodes that count as nearest to a return, and how many do at least.
NEAREST, LEAST_NEAREST = 0.05, 5
#: Least slope of obtained on commanded returns over a range that counts as obeyed.
LEAST_SLOPE = 0.5

Floats = npt.NDArray[np.float64]


class Means(NamedTuple):
    """What was obtained for each command, in increasing order of the commanded value.

    Attributes:
        commanded: float64 [n], without repetitions.
        mean: mean of what was obtained, float64 [n].
        ci95_low: lower end of its 95 % confidence interval, float64 [n].
        ci95_high: upper end, float64 [n].
    """

    commanded: Floats
    mean: Floats
    ci95_low: Floats
    ci95_high: Floats


def reachable(values: npt.ArrayLike) -> tuple[float, float]:
    """Return the least and the greatest value, the lowest :data:`OUTLIERS` left out.

    Args:
        values: returns or lengths of episodes, float [n], at least one.
    """
    values = np.asarray(values, np.float64)
    return float(np.quantile(values, OUTLIERS, method="lower")), float(values.max())


def evenly(low: float, high: float, n: int) -> list[float]:
    """Return at most ``n`` values spread evenly from ``low`` to ``high``, without repetitions.

    They are rounded to a tenth of the decimal place of their spacing, so that they can be written
    down as they are: -119.3 to 287.6 in 11 values is -119, -79, ..., 288.

    Args:
        low: least value.
        high: greatest value, not less.
        n: how many, at least 2.
    """
    if not high > low:
        return [low]
    digits = 1 - math.floor(math.log10((high - low) / (n - 1)))
    # Adding 0 turns -0 into 0.
    return sorted({round(float(value), digits) + 0.0 for value in np.linspace(low, high, n)})


def spread(values: npt.ArrayLike, n: int) -> list[float]:
    """Return what to command, of what episodes did: at most ``n`` values in increasing order.

    Where episodes differ in a few values only, these: nothing between them can be obtained. Else
    what is :func:`reachable`, spread :func:`evenly`.

    Args:
        values: returns or lengths of episodes, float [m], at least one.
        n: at least 2.
    """
    distinct = np.unique(np.asarray(values, np.float64))
    return distinct.tolist() if len(distinct) <= n else evenly(*reachable(values), n)


def mean_of_nearest(at: float, where: npt.ArrayLike, values: npt.ArrayLike) -> float:
    """Return the mean value of the episodes that are nearest to a return.

    These are :data:`NEAREST` of all, at least :data:`LEAST_NEAREST`, and all that are as near as
    the last of these.

    Args:
        at: the return.
        where: returns of the episodes, float [n], at least one.
        values: their lengths, say; float [n].
    """
    distance = np.abs(np.asarray(where, np.float64) - at)
    count = min(len(distance), max(LEAST_NEAREST, math.ceil(NEAREST * len(distance))))
    furthest = np.partition(distance, count - 1)[count - 1]
    return float(np.asarray(values, np.float64)[distance <= furthest].mean())


def correlation(commanded: npt.ArrayLike, obtained: npt.ArrayLike) -> float:
    """Return Pearson's correlation; 0 where one of the two does not vary.

    Args:
        commanded: float [n], at least one.
        obtained: float [n].
    """
    x, y = (np.asarray(values, np.float64) for values in (commanded, obtained))
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        return 0.0
    x, y = x - x.mean(), y - y.mean()
    # Dividing first, lest a square is not a number.
    x, y = x / np.abs(x).max(), y / np.abs(y).max()
    return float(np.clip(x @ y / math.sqrt((x @ x) * (y @ y)), -1.0, 1.0))


def mean_absolute_error(commanded: npt.ArrayLike, obtained: npt.ArrayLike) -> float:
    """Return the mean distance between what was commanded and obtained.

    Args:
        commanded: float [n], at least one.
        obtained: float [n].
    """
    return float(np.abs(np.asarray(obtained) - np.asarray(commanded)).mean())


def obeyed(means: Means, tolerance: float) -> slice | None:
    """Return the commands of the range in which an agent obeys; None: there is none.

    It is the widest one of which all of this is true, and of equally wide ones the highest:

    - Every mean lies within ``tolerance`` of its command.
    - The mean increases with the command: the slope of the straight line that fits best is at least
      :data:`LEAST_SLOPE`.
    - It is no accident: the confidence intervals at the two ends do not overlap, and the upper
      one's is the higher.

    Args:
        means: what was obtained for each command.
        tolerance: at least 0, in units of the return.
    """
    x, n = means.commanded, len(means.commanded)
    near = np.abs(means.mean - x) <= tolerance
    outside = np.concatenate([[0], np.cumsum(~near)])
    first, last = np.triu_indices(n, k=1)
    allowed = outside[last + 1] == outside[first]
    allowed &= means.ci95_low[last] > means.ci95_high[first]
    # n Sxy and n Sxx of every range, by sums from the first command on.
    x, y = x - x[:1], means.mean - x[:1]
    count = (last + 1 - first).astype(np.float64)

    def sums(values: Floats) -> Floats:
        until = np.concatenate([[0.0], np.cumsum(values)])
        total: Floats = until[last + 1] - until[first]
        return total

    sum_x = sums(x)
    together = count * sums(x * y) - sum_x * sums(y)
    allowed &= together >= LEAST_SLOPE * (count * sums(x * x) - sum_x**2)
    if not allowed.any():
        return None
    width = np.where(allowed, x[last] - x[first], -1.0)
    best = int(np.flatnonzero(width == width.max())[-1])
    return slice(int(first[best]), int(last[best]) + 1)
