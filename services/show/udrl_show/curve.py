"""Pictures of learning curves, drawn from ``metrics.csv``.

The closing evaluation comes from the store; a directory without one is drawn too.
"""

import csv
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TextIO

from udrl.errors import StoreError
from udrl_replay.store import EvaluationRow, Store
from udrl_show import pictures
from udrl_show.styles import line_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

log = logging.getLogger("udrl")

#: A line of ``metrics.csv``; what is missing is NaN.
Row = Mapping[str, float]

_COLUMNS = (
    "env_steps", "wall_s", "return_mean", "explored_return", "eval_at_env_steps", "eval_mean",
    "eval_ci95_low", "eval_ci95_high",
)  # fmt: skip

_X = {"env_steps": ("env steps", 1.0), "wall_s": ("wall time, minutes", 60.0)}


def draw(run_dir: Path, title: str) -> Path:
    """Draw a run's returns against env steps into its directory; return the picture.

    Raises:
        ConfigError: matplotlib is not installed.
        StoreError: the run has no metrics.
    """
    rows = _read(run_dir)
    figure, (axes,) = pictures.empty()
    steps = [r["env_steps"] for r in rows]
    for name, label, style in (
        ("return_mean", "mean of the replay buffer", "--"),
        ("explored_return", "exploratory episodes, mean of an iteration", ":"),
    ):
        axes.plot(steps, [r[name] for r in rows], style, color="0.6", label=label, lw=1)
    _evaluations(axes, rows, "env_steps", "evaluation, mean and 95 % interval", rank=1)
    _closing(axes, run_dir, rows, "env_steps", rank=1, label="closing evaluation")
    axes.set(xlabel="env steps", ylabel="return", title=title)
    axes.legend(fontsize="small")
    picture = run_dir / "learning_curve.png"
    pictures.save(figure, picture)
    return picture


def compare(
    run_dirs: Sequence[Path], picture: Path, x: Literal["env_steps", "wall_s"] = "env_steps"
) -> None:
    """Draw the evaluations of several runs into one picture.

    Args:
        run_dirs: at least one; the lines are labelled with as much of the names as tells them
            apart.
        picture: ``.png``, ``.svg`` or ``.pdf``.
        x: what the returns are drawn against.

    Raises:
        ConfigError: matplotlib is not installed, or another kind of file.
        StoreError: a run has no metrics, or none has been evaluated.
    """
    pictures.check_name(picture)
    runs = {run_dir: _read(run_dir) for run_dir in run_dirs}
    if not any(_evaluated(rows) or _closing_evaluation(d) for d, rows in runs.items()):
        names = ", ".join(map(str, run_dirs))
        raise StoreError(
            f"nothing to draw: {names}: no evaluation in metrics.csv yet; there is one every "
            f"eval_every env steps"
        )
    figure, (axes,) = pictures.empty()
    for rank, (label, run_dir) in enumerate(zip(_labels(list(runs)), runs, strict=True)):
        _evaluations(axes, runs[run_dir], x, label, rank)
        _closing(axes, run_dir, runs[run_dir], x, rank)
    axes.set(xlabel=_X[x][0], ylabel="mean return of an evaluation, 95 % interval")
    axes.legend(fontsize="small", handlelength=3.5)
    pictures.save(figure, picture)


def _labels(run_dirs: Sequence[Path]) -> list[str]:
    """Return names that tell runs apart: as few of the last parts of their paths as do."""
    parts = [run_dir.resolve().parts for run_dir in run_dirs]
    for n in range(1, max(map(len, parts))):
        labels = ["/".join(p[-n:]) for p in parts]
        if len(set(labels)) == len(set(parts)):
            return labels
    return [str(run_dir) for run_dir in run_dirs]


def _read(run_dir: Path) -> list[Row]:
    path = run_dir / "metrics.csv"
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return [{name: float(row[name] or "nan") for name in _COLUMNS} for row in _rows(file)]
    except OSError as error:
        raise StoreError(f"{path}: {error.strerror}; name the directory of a run") from error
    except (KeyError, ValueError, csv.Error) as error:
        raise StoreError(
            f"{path} is not what a run writes ({error}); it is written anew when the run goes on"
        ) from error


def _rows(file: TextIO) -> Iterator[dict[str, str]]:
    for row in csv.DictReader(file):
        if None in row.values():
            raise ValueError("a line is too short")
        yield row


def _evaluated(rows: Sequence[Row]) -> list[Row]:
    return [r for r in rows if not math.isnan(r["eval_mean"])]


def _evaluations(axes: "Axes", rows: Sequence[Row], x: str, label: str, rank: int) -> None:
    """Draw the mean returns of a run's evaluations with their intervals."""
    evaluated = _evaluated(rows)
    unit = _X[x][1]
    column = "eval_at_env_steps" if x == "env_steps" else x
    at = [r[column] / unit for r in evaluated]
    low, mean, high = (
        [r[n] for r in evaluated] for n in ("eval_ci95_low", "eval_mean", "eval_ci95_high")
    )
    style = line_style(rank)
    axes.fill_between(at, low, high, color=style["color"], alpha=0.2, lw=0)
    axes.plot(at, mean, label=label, markevery=max(1, len(at) // 10), **style)


def _closing(
    axes: "Axes",
    run_dir: Path,
    rows: Sequence[Row],
    x: str,
    rank: int,
    label: str = "",
) -> None:
    """Draw the evaluation that closed a run, large and hollow, if there is one."""
    row = _closing_evaluation(run_dir)
    if row is None or not rows:
        return
    at = row.env_steps if x == "env_steps" else rows[-1][x] / _X[x][1]
    found = row.evaluation
    style = line_style(rank)
    axes.errorbar(
        [at], [found.mean],
        [[found.mean - found.ci95_low], [found.ci95_high - found.mean]],
        color=style["color"], marker=style["marker"], markersize=9, markerfacecolor="none",
        capsize=3, linestyle="none", label=label or "_",
    )  # fmt: skip


def _closing_evaluation(run_dir: Path) -> EvaluationRow | None:
    try:
        with closing(Store(run_dir, read_only=True)) as store:
            return store.last_evaluation(closing=True)
    except StoreError as error:
        log.debug("no closing evaluation of %s: %s", run_dir, error)
        return None
