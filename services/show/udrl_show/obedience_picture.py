"""The obedience report as a figure."""

from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING

from udrl.file_endings import check_ending
from udrl_inspect.obedience_report import ObedienceReport
from udrl_inspect.obedience_text import answer
from udrl_show import pictures
from udrl_show.styles import line_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Characters per line of the title, for each panel.
_TITLE = 52


def draw_obedience(report: ObedienceReport, picture: Path) -> None:
    """Draw obtained against commanded returns, and lengths against commanded horizons.

    Args:
        report: the report.
        picture: ``.png``, ``.svg`` or ``.pdf``.

    Raises:
        ConfigError: matplotlib is not installed, the extension is not supported, or the file cannot
            be written.
    """
    check_ending(picture, pictures.ENDINGS)
    figure, axes = pictures.empty(2 if report.by_horizon else 1)
    _returns(axes[0], report)
    if report.by_horizon:
        _horizons(axes[1], report)
    title = f"{report.environment}, weights version {report.weights_version}\n"
    figure.suptitle(title + fill(answer(report), _TITLE * len(axes)), fontsize="medium")
    pictures.save(figure, picture)


def _returns(axes: "Axes", report: ObedienceReport) -> None:
    points, tolerance = report.by_return, report.tolerance
    commanded = [point.desired_return for point in points]
    ends = [commanded[0], commanded[-1]]
    if report.obeyed is not None:
        axes.axvspan(
            report.obeyed.low, report.obeyed.high, color="#009E73", alpha=0.12, lw=0,
            label="the agent obeys",
        )  # fmt: skip
    axes.plot(ends, ends, ":", color="0.4", lw=1.5, label="obtained = commanded")
    for sign, label in ((-1, "tolerance"), (1, "_")):
        edge = [end + sign * tolerance for end in ends]
        axes.plot(ends, edge, "-", color="0.7", lw=0.8, label=label)
    axes.errorbar(
        commanded,
        [point.return_mean for point in points],
        [
            [point.return_mean - point.return_ci95_low for point in points],
            [point.return_ci95_high - point.return_mean for point in points],
        ],
        label="mean and 95 % interval", capsize=2, elinewidth=1, **line_style(1),
    )  # fmt: skip
    axes.set(xlabel="commanded return", ylabel="obtained return")
    axes.legend(fontsize="small")


def _horizons(axes: "Axes", report: ObedienceReport) -> None:
    points = report.by_horizon
    commanded = [point.desired_horizon for point in points]
    ends = [commanded[0], commanded[-1]]
    axes.plot(ends, ends, ":", color="0.4", lw=1.5, label="obtained = commanded")
    axes.errorbar(
        commanded,
        [point.length_mean for point in points],
        [
            [point.length_mean - point.length_ci95_low for point in points],
            [point.length_ci95_high - point.length_mean for point in points],
        ],
        label="mean and 95 % interval", capsize=2, elinewidth=1, **line_style(2),
    )  # fmt: skip
    axes.set(
        xlabel=f"commanded horizon, steps (return {points[0].desired_return:.4g})",
        ylabel="length of the episodes, steps",
    )
    axes.legend(fontsize="small")
