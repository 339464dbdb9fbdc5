"""Figures of learning curves, drawn from ``metrics.csv``.

Environment, settings and final evaluation come from the store. Directories without a store can be
drawn too.
"""

import csv
import logging
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TextIO

import msgspec

from udrl.config import flat
from udrl.errors import StoreError, UdrlError
from udrl.evaluation import Evaluation
from udrl.file_endings import check_ending
from udrl_inspect.run_list import run_directories
from udrl_proto.messages import Hello
from udrl_proto.text import printable
from udrl_replay.database import exists
from udrl_replay.store import EvaluationRow, Store
from udrl_show import pictures
from udrl_show.styles import line_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

log = logging.getLogger("udrl")

#: A row of ``metrics.csv``; missing values are NaN.
Row = Mapping[str, float]
X = Literal["env_steps", "wall_s"]

_METRICS = "metrics.csv"
_COLUMNS = (
    "iteration", "env_steps", "wall_s", "return_mean", "explored_return", "eval_at_env_steps",
    "eval_mean", "eval_ci95_low", "eval_ci95_high",
)  # fmt: skip

#: Label and divisor of the x-axis.
_X = {"env_steps": ("env steps", 1.0), "wall_s": ("wall time, minutes", 60.0)}
#: Maximum number of settings in the label of a line.
_MOST_NAMED = 3


class Curve(NamedTuple):
    """The data of one run for a figure.

    Attributes:
        run_dir: its directory.
        rows: its metrics.
        settings: its settings, without the seed; empty if it has no store.
        seed: its seed; None if it has no store.
        final: its final evaluation. None: there is none.
    """

    run_dir: Path
    rows: Sequence[Row]
    settings: dict[str, Any]
    seed: int | None
    final: EvaluationRow | None

    @property
    def environment(self) -> str:
        """The Gymnasium id; empty if it is unknown."""
        return str(self.settings.get("environment", ""))


#: Runs that are drawn as one line: the seeds of one configuration.
Line = list[Curve]


class LinePoint(NamedTuple):
    """A point of a line, and the ends of its interval."""

    at: float
    mean: float
    low: float
    high: float


def draw_curve(run_dir: Path, title: str) -> Path:
    """Draw a run's returns against env steps into its directory; return the figure's path.

    Raises:
        ConfigError: matplotlib is not installed.
        StoreError: the run has no metrics.
    """
    curve = read_curve(run_dir)
    figure, (axes,) = pictures.empty()
    steps = [r["env_steps"] for r in curve.rows]
    for name, label, style in (
        ("return_mean", "replay buffer, mean", "--"),
        ("explored_return", "exploratory episodes, mean of an iteration", ":"),
    ):
        returns = [r[name] for r in curve.rows]
        axes.plot(steps, returns, style, color="0.6", label=label, lw=1)
    label = "evaluation, mean and 95 % interval"
    _draw_line(axes, [curve], "env_steps", label, rank=1, final_label="final evaluation")
    axes.set(xlabel="env steps", ylabel="return", title=title)
    axes.legend(fontsize="small")
    picture = run_dir / "learning_curve.png"
    pictures.save(figure, picture)
    return picture


def compare(places: Sequence[Path], picture: Path, x: X = "env_steps") -> list[str]:
    """Draw the evaluations of several runs, with a panel for each environment.

    A given run is a line. The runs in a given folder are a line for each configuration: the mean
    over its seeds.

    Args:
        places: directories of runs, and folders of such directories; at least one.
        picture: ``.png``, ``.svg`` or ``.pdf``.
        x: the quantity on the x-axis.

    Returns:
        The reasons why runs in folders are missing in the figure.

    Raises:
        ConfigError: matplotlib is not installed, or the file's extension is not supported.
        StoreError: a run has no metrics, or no run has an evaluation.
    """
    check_ending(picture, pictures.ENDINGS)
    lines, missing = _lines(places)
    curves = [curve for line in lines for curve in line]
    if not any(_points(line, x) or line[0].final for line in lines):
        names = ", ".join(map(str, places))
        raise StoreError(
            f"nothing to draw: {names}: no evaluation in {_METRICS} yet; there is one every "
            f"eval_every env steps"
        )
    panels: dict[str, list[Line]] = {}
    for line in lines:
        panels.setdefault(line[0].environment, []).append(line)
    names_of = dict(zip((c.run_dir for c in curves), _names(curves), strict=True))
    figure, all_axes = pictures.empty(len(panels))
    for axes, (environment, held) in zip(all_axes, panels.items(), strict=True):
        differing = _differing([line[0].settings for line in held])
        for rank, line in enumerate(held):
            name = names_of[line[0].run_dir] if len(line) == 1 else _label(line, differing)
            _draw_line(axes, line, x, name, rank)
        several = any(len(line) > 1 for line in held)
        interval = "mean and range over seeds" if several else "95 % interval"
        axes.set(xlabel=_X[x][0], ylabel=f"mean return ({interval})")
        axes.set(title=environment)
        axes.legend(fontsize="small", handlelength=3.5)
    pictures.save(figure, picture)
    return missing


def read_curve(run_dir: Path) -> Curve:
    """Return the data of a run.

    Raises:
        StoreError: the run has no metrics.
    """
    path = run_dir / _METRICS
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = [{name: float(row[name] or "nan") for name in _COLUMNS} for row in _rows(file)]
    except OSError as error:
        raise StoreError(
            f"{path}: {error.strerror}; give the directory of a run, or a folder of runs"
        ) from error
    except (KeyError, ValueError, csv.Error) as error:
        raise StoreError(
            f"{path} is damaged ({error}); resume the run, and it will be written again"
        ) from error
    try:
        with closing(Store(run_dir, read_only=True)) as store:
            config = store.fact("hello", Hello).config
            settings = {n: v for n, v in flat(config).items() if n != "seed"}
            final = store.last_evaluation(is_final=True)
            return Curve(run_dir, rows, settings, config.seed, final)
    except StoreError as error:
        log.debug("%s is drawn without its store: %s", run_dir, error)
        return Curve(run_dir, rows, {}, None, None)


def _rows(file: TextIO) -> Iterator[dict[str, str]]:
    for row in csv.DictReader(file):
        if None in row.values():
            raise ValueError("a line is too short")
        yield row


def _lines(places: Iterable[Path]) -> tuple[list[Line], list[str]]:
    """Return the lines of a figure, and the reasons why runs are missing in it."""
    lines: list[Line] = []
    missing: list[str] = []
    drawn: set[Path] = set()
    for place in places:
        is_run = exists(place) or (place / _METRICS).exists()
        below = [] if is_run else list(run_directories(place))
        by_settings: dict[bytes, list[Line]] = {}
        for run_dir in below or [place]:
            if run_dir.resolve() in drawn:
                continue
            drawn.add(run_dir.resolve())
            try:
                curve = read_curve(run_dir)
            except UdrlError as error:
                if not below:
                    raise
                missing.append(f"{run_dir}: {error}")
                continue
            if not below or not curve.settings:
                lines.append([curve])
            elif not _evaluated(curve) and curve.final is None:
                missing.append(f"{run_dir}: no evaluation yet")
            else:
                key = msgspec.json.encode(curve.settings, order="sorted")
                _add(by_settings.setdefault(key, []), curve)
        lines += [line for same in by_settings.values() for line in same]
    if not lines:
        raise StoreError(f"nothing to draw: {'; '.join(missing)}")
    return lines, missing


def _add(lines: list[Line], curve: Curve) -> None:
    """Add a run to the first line without its seed, e.g. to a new one if its budget differs."""
    for line in lines:
        if curve.seed not in {other.seed for other in line}:
            line.append(curve)
            return
    lines.append([curve])


def _names(curves: Sequence[Curve]) -> list[str]:
    """Return unique names of runs: as few of the last parts of their paths as possible.

    None begins with an underscore, because matplotlib leaves such names out of legends.
    """
    parts = [curve.run_dir.resolve().parts for curve in curves]
    for n in range(1, max(map(len, parts))):
        names = [printable("/".join(p[-n:])) for p in parts]
        if len(set(names)) == len(set(parts)) and not any(name[0] == "_" for name in names):
            return names
    return [printable(curve.run_dir) for curve in curves]


def _differing(settings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the names of the settings that differ."""
    first = settings[0]
    return [n for n in first if any(s.get(n) != first[n] for s in settings[1:])]


def _label(line: Line, differing: Sequence[str]) -> str:
    """Return the label of several seeds: the settings that distinguish them, and their number."""
    named = [f"{n} = {line[0].settings.get(n)}" for n in differing[:_MOST_NAMED]]
    if len(differing) > _MOST_NAMED:
        named.append("…")
    return "; ".join([*([", ".join(named)] if named else []), f"{len(line)} seeds"])


def _evaluated(curve: Curve) -> list[Row]:
    return [r for r in curve.rows if not math.isnan(r["eval_mean"])]


def _points(line: Line, x: X) -> list[LinePoint]:
    """Return the evaluations of a line, with intervals for one run and ranges for several."""
    column = "eval_at_env_steps" if x == "env_steps" else x
    unit = _X[x][1]
    if len(line) == 1:
        return [
            LinePoint(r[column] / unit, r["eval_mean"], r["eval_ci95_low"], r["eval_ci95_high"])
            for r in _evaluated(line[0])
        ]
    # Evaluation k of a run is the first after k times eval_every env steps.
    every = line[0].settings["eval_every"]
    numbered = [{r["eval_at_env_steps"] // every: r for r in _evaluated(c)} for c in line]
    common = sorted(set.intersection(*(set(one) for one in numbered)))
    return [
        _mean([(one[k][column] / unit, one[k]["eval_mean"]) for one in numbered]) for k in common
    ]


def _mean(found: Sequence[tuple[float, float]]) -> LinePoint:
    """Return the mean of some evaluations, and their range."""
    returns = [value for _, value in found]
    return LinePoint(fmean(at for at, _ in found), fmean(returns), min(returns), max(returns))


def _final(line: Line, x: X) -> LinePoint | None:
    """Return the final evaluations of a line; None unless all its runs have one."""
    found: list[tuple[float, Evaluation]] = []
    for curve in line:
        if curve.final is None or not curve.rows:
            return None
        # An extended run has iterations after its old final evaluation.
        after = (r for r in curve.rows if r["iteration"] >= curve.final.iteration)
        at = curve.final.env_steps if x == "env_steps" else next(after, curve.rows[-1])[x]
        found.append((at / _X[x][1], curve.final.evaluation))
    if len(found) == 1:
        ((at, one),) = found
        return LinePoint(at, one.mean, one.ci95_low, one.ci95_high)
    return _mean([(at, one.mean) for at, one in found])


def _draw_line(
    axes: "Axes", line: Line, x: X, label: str, rank: int, final_label: str = "_"
) -> None:
    """Draw the evaluations of a line, and the final one as a large hollow marker."""
    points, style = _points(line, x), line_style(rank)
    at = [p.at for p in points]
    low, high = [p.low for p in points], [p.high for p in points]
    axes.fill_between(at, low, high, color=style["color"], alpha=0.2, lw=0)
    means = [p.mean for p in points]
    axes.plot(at, means, label=label, markevery=max(1, len(at) // 10), **style)
    final = _final(line, x)
    if final is None:
        return
    axes.errorbar(
        [final.at], [final.mean], [[final.mean - final.low], [final.high - final.mean]],
        color=style["color"], marker=style["marker"], markersize=9, markerfacecolor="none",
        capsize=3, linestyle="none", label=final_label,
    )  # fmt: skip
