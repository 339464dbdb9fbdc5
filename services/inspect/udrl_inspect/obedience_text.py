"""The obedience report as text: sentences, tables, rows of a CSV file."""

import math
from collections.abc import Callable, Iterator, Sequence

import msgspec

from udrl.evaluation import return_text
from udrl_inspect.obedience_report import TOLERANCE, ObediencePoint, ObedienceReport

#: Minimum correlation at which obtained means count as following commands that are not obeyed.
_FOLLOWS = 0.8

_HEAD = "desired return", "desired horizon", "mean return", "95 % interval", "mean length", ""

#: Columns of the CSV file: the varied part of the command, its results, whether it is obeyed.
COLUMNS = ("sweep", *ObediencePoint.__struct_fields__, "obeyed")


def rows(report: ObedienceReport) -> Iterator[tuple[object, ...]]:
    """Yield the rows of the CSV file: commanded returns, then commanded horizons."""
    for sweep, points in (("return", report.by_return), ("horizon", report.by_horizon)):
        for point in points:
            yield sweep, *msgspec.structs.astuple(point), is_obeyed(report, point)


def is_obeyed(report: ObedienceReport, point: ObediencePoint) -> bool:
    """Return whether a command is in the range in which the agent obeys."""
    found = report.obeyed
    return found is not None and found.low <= point.desired_return <= found.high


def answer(report: ObedienceReport) -> str:
    """Return a sentence about the returns that can be commanded."""
    every, found = report.all_returns, report.obeyed
    error = _number(report)
    if found is not None:
        whole = (found.low, found.high) == (every.low, every.high)
        outside = (
            "No other returns were measured."
            if whole
            else "Outside this range, do not expect the commanded return."
        )
        return (
            f"You can command returns from {_exact(found.low)} to {_exact(found.high)} (mean "
            f"absolute error {error(found.mean_absolute_error)}, correlation "
            f"{found.correlation:.2f}). {outside}"
        )
    means = [point.return_mean for point in report.by_return]
    varies = max(means) - min(means)
    over = f"commands from {_exact(every.low)} to {_exact(every.high)}"
    if every.correlation >= _FOLLOWS and varies > report.tolerance:
        return (
            f"A higher desired return obtains more, but not the desired return itself: {over} "
            f"obtain {error(means[0])} to {error(means[-1])} on average; mean absolute error "
            f"{error(every.mean_absolute_error)}, correlation {every.correlation:.2f}."
        )
    return (
        f"This agent does not follow its command: mean obtained returns vary by {error(varies)} "
        f"over {over} (correlation {every.correlation:.2f})."
    )


def best(report: ObedienceReport) -> str:
    """Return a sentence about the command with the highest mean return."""
    point, number = report.best, _number(report)
    return (
        f"Highest mean return: {number(point.return_mean)} (95 % interval "
        f"{number(point.return_ci95_low)} to {number(point.return_ci95_high)}), commanded "
        f"{_exact(point.desired_return)} within {point.desired_horizon} steps."
    )


def summary(report: ObedienceReport) -> str:
    """Return the sentences of :func:`answer` and :func:`best`."""
    return f"{answer(report)} {best(report)}"


def horizons(report: ObedienceReport) -> str:
    """Return a sentence about commanded horizons; empty if none were measured."""
    found = report.all_horizons
    if found is None:
        return ""
    lengths = [point.length_mean for point in report.by_horizon]
    return (
        f"Horizons from {found.low:.0f} to {found.high:.0f} steps, commanded with a return of "
        f"{_number(report)(report.by_horizon[0].desired_return)}: mean lengths from "
        f"{min(lengths):.0f} to {max(lengths):.0f} steps, mean absolute error "
        f"{found.mean_absolute_error:.0f}, correlation {found.correlation:.2f}."
    )


def rule(report: ObedienceReport) -> str:
    """Return a sentence that defines when a command counts as obeyed."""
    is_usual = math.isclose(report.tolerance, _usual_tolerance(report))
    share = f" ({100 * TOLERANCE:.0f} % of the returns commanded by default)"
    return (
        f"Obeyed: the mean lies within {_number(report)(report.tolerance)} of the command"
        f"{share if is_usual else ''}, and increases with it."
    )


def about(report: ObedienceReport) -> str:
    """Return a sentence about the measurement."""
    return (
        f"{report.environment}, weights version {report.weights_version}, temperature "
        f"{report.temperature:g}, {report.episodes} episodes for each command."
    )


def table(report: ObedienceReport) -> str:
    """Return the report for a terminal; it ends with the answer."""
    cells = [list(_HEAD), *_cells(report, report.by_return)]
    if report.by_horizon:
        cells += [[""], *_cells(report, report.by_horizon)]
    cells = [row + [""] * (len(_HEAD) - len(row)) for row in cells]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = [
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in cells
    ]
    below = [rule(report), horizons(report), best(report), answer(report)]
    return "\n".join([about(report), "", *lines, "", *filter(None, below)])


def markdown(report: ObedienceReport) -> str:
    """Return the report for a model card."""
    lines = ["| " + " | ".join(_HEAD) + " |", "|" + "---:|" * len(_HEAD)]
    lines += ["| " + " | ".join(row) + " |" for row in _cells(report, report.by_return)]
    below = [horizons(report), best(report)]
    return "\n\n".join(
        [f"**{answer(report)}**", "\n".join(lines), f"{about(report)} {rule(report)}",
         " ".join(filter(None, below))]
    )  # fmt: skip


def _cells(report: ObedienceReport, points: Sequence[ObediencePoint]) -> Iterator[list[str]]:
    number = _number(report)
    varied = points is report.by_return
    for point in points:
        yield [
            _exact(point.desired_return) if varied else number(point.desired_return),
            str(point.desired_horizon),
            number(point.return_mean),
            f"{number(point.return_ci95_low)} to {number(point.return_ci95_high)}",
            f"{point.length_mean:.0f}",
            "obeyed" if varied and is_obeyed(report, point) else "",
        ]


def _exact(value: float) -> str:
    """Return a commanded return unrounded, unlike `obedience_statistics.evenly`."""
    return f"{value:.10g}"


def _number(report: ObedienceReport) -> Callable[[float], str]:
    """Return a function that formats the returns of a report, all with the same precision.

    The precision is a tenth of the tolerance, or of the usual one if that is smaller.
    """
    finest = min(report.tolerance, _usual_tolerance(report))
    if finest <= 0:
        return return_text
    digits = max(0, 1 - math.floor(math.log10(finest)))
    return lambda value: f"{round(value, digits) + 0.0:.{digits}f}"


def _usual_tolerance(report: ObedienceReport) -> float:
    return TOLERANCE * (report.reachable_high - report.reachable_low)
