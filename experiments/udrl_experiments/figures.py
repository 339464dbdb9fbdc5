"""Figures of the studies, drawn from tidy tables, in the layout of the paper's figures.

Lines are distinguishable in greyscale and with colour blindness (:mod:`udrl_show.styles`).
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from udrl.atomic_files import replacing
from udrl.errors import ConfigError
from udrl_experiments.records import Obtained, agent_name
from udrl_experiments.statistics import CurvePoint
from udrl_show.styles import line_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Styles that are the same in every figure, by agent or algorithm. UDRL is green, as in the paper.
_OWN_STYLES = {"UDRL": 0, "DQN": 1, "A2C": 2, "PPO": 3, "UDRL-paper": 4}

#: Ratio of the lengths of two lines from which on the shorter is too small on a linear axis.
_MUCH_LONGER = 5

_AXES = {"env_steps": ("env steps (millions)", 1e6), "wall_s": ("wall time (minutes)", 60.0)}


def learning_curves(
    points: Sequence[CurvePoint],
    title: str,
    *,
    x: Literal["env_steps", "wall_s"] = "env_steps",
    references: Mapping[str, float] | None = None,
    lowest: float = -math.inf,
) -> "Figure":
    """Draw mean returns with 95 % bootstrap intervals (Figures 4 and 5), one line per agent.

    The x axis is logarithmic if one line is much longer than another.

    Args:
        points: at least one point; those of an agent in the order of env steps.
        title: title of the figure.
        x: quantity on the x axis.
        references: returns of horizontal lines, by label.
        lowest: return below which nothing is shown; the axis then says so.

    Raises:
        ConfigError: there are no points, or matplotlib is not installed.
    """
    lines: dict[tuple[str, str, str], list[CurvePoint]] = {}
    for point in points:
        key = (point.environment, point.algorithm, point.variant)
        lines.setdefault(key, []).append(point)
    xlabel, unit = _AXES[x]
    figure, axes = _empty(title, xlabel, "mean return", rows=len(points))
    for label, value in (references or {}).items():
        axes.axhline(value, color="0.5", lw=0.8)
        axes.annotate(
            label, (1, value), xycoords=("axes fraction", "data"), xytext=(4, 0),
            textcoords="offset points", va="center", fontsize="small",
        )  # fmt: skip
    several = len({environment for environment, _, _ in lines}) > 1
    agents = [(agent_name(algorithm, variant), algorithm) for _, algorithm, variant in lines]
    styles = _styles([name if name in _OWN_STYLES else algorithm for name, algorithm in agents])
    for (key, line), (rank, style) in zip(lines.items(), enumerate(styles), strict=True):
        seeds = line[0].seeds
        environment, algorithm, variant = key
        name = f"{environment} " * several + agent_name(algorithm, variant)
        label = f"{name} ({seeds} {'seed' if seeds == 1 else 'seeds'})"
        at = [getattr(point, x) / unit for point in line]
        low, mean, high = ([getattr(p, name) for p in line] for name in ("low", "mean", "high"))
        axes.fill_between(at, low, high, color=style["color"], alpha=0.2, lw=0)
        # Ten markers per line, shifted so that they do not hide each other.
        step = max(1, len(line) // 10)
        axes.plot(at, mean, label=label, markevery=(step * rank // len(lines), step), **style)
    if axes.get_ylim()[0] < lowest:
        axes.set_ylim(bottom=lowest)
        axes.set_ylabel(f"mean return (lower than {lowest:g}: not shown)")
    ends = [getattr(line[-1], x) for line in lines.values()]
    if max(ends) > _MUCH_LONGER * min(ends):
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter("{x:g}")
    _legend(figure, axes, "mean over seeds, 95 % bootstrap interval")
    return figure


def sensitivity_figure(rows: Sequence[Obtained], title: str) -> "Figure":
    """Draw obtained against desired returns (section 3.5, Figure 6), one line per run.

    As in the paper, error bars are the standard deviation of the episodes' returns.

    Args:
        rows: at least one row, in any order.
        title: title of the figure.

    Raises:
        ConfigError: there are no rows, or matplotlib is not installed.
    """
    runs: dict[tuple[str, int], list[Obtained]] = {}
    for row in sorted(rows, key=lambda row: row.desired_return):
        runs.setdefault((row.environment, row.seed), []).append(row)
    figure, axes = _empty(title, "desired return", "obtained return", rows=len(rows))
    ends = [min(row.desired_return for row in rows), max(row.desired_return for row in rows)]
    axes.plot(ends, ends, ":", color="0.5", lw=1.5, label="obtained = desired")
    several = len({environment for environment, _ in runs}) > 1
    styles = _styles([""] * len(runs))
    for ((environment, seed), run), style in zip(sorted(runs.items()), styles, strict=True):
        axes.errorbar(
            [row.desired_return for row in run],
            [row.mean for row in run],
            [row.std for row in run],
            label=f"{environment} seed {seed}" if several else f"seed {seed}",
            capsize=2,
            elinewidth=1,
            **style,
        )
    _legend(figure, axes, "mean and standard deviation of the episodes")
    return figure


def save(figure: "Figure", path: Path) -> list[Path]:
    """Write a figure as PNG and SVG, and return the two files.

    Equal figures give identical bytes. Each file is replaced atomically. Text in the SVG remains
    text.

    Args:
        figure: a figure of this module; saving it fixes its layout.
        path: path without suffix.
    """
    from matplotlib import rc_context

    # Each drawing changes the layout slightly, so the SVG would differ from the PNG.
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    saved = []
    # By default, Matplotlib writes its version, the time and random ids.
    for suffix, omitted in ((".png", "Software"), (".svg", "Date")):
        picture = path.with_name(path.name + suffix)
        with (
            replacing(picture) as unfinished,
            rc_context({"svg.hashsalt": "udrl", "svg.fonttype": "none"}),
        ):
            figure.savefig(unfinished, format=suffix[1:], dpi=130, metadata={omitted: None})
        saved.append(picture)
    return saved


def _empty(title: str, xlabel: str, ylabel: str, *, rows: int) -> "tuple[Figure, Axes]":
    """Return a figure without lines, and its axes."""
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise ConfigError(
            'figures need matplotlib; install it with: pip install "udrl[studies]"'
        ) from error
    if not rows:
        raise ConfigError(f"{title}: the table of the figure is empty; expected at least one row")
    figure = Figure(figsize=(7, 4.6), layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlabel=xlabel, ylabel=ylabel, title=title)
    axes.grid(alpha=0.3)
    axes.margins(x=0.02)
    return figure, axes


def _styles(names: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield a style for each line. The first line of a name in ``_OWN_STYLES`` has its style."""
    own = {name: rank for name, rank in _OWN_STYLES.items() if name in names}
    taken = set(own.values())
    others = (rank for rank in itertools.count() if rank not in taken)
    for name in names:
        rank = own.pop(name) if name in own else next(others)
        yield line_style(rank)


def _legend(figure: "Figure", axes: "Axes", title: str) -> None:
    """Add a legend below the axes, where it covers no lines."""
    _, labels = axes.get_legend_handles_labels()
    # At this font size the figure is about 110 characters wide; a legend handle takes 12.
    columns = min(len(labels), max(1, 110 // (max(map(len, labels)) + 12)))
    figure.set_figheight(4.6 + 0.17 * math.ceil(len(labels) / columns))
    figure.legend(
        loc="outside lower center", ncols=columns, fontsize="small", title=title,
        title_fontsize="small", handlelength=3.5,
    )  # fmt: skip
