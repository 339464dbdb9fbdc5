"""``udrl runs`` and ``udrl plot``: listing and comparing runs."""

import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import click

from udrl.evaluation import return_text
from udrl_inspect.run_list import Summary, find
from udrl_launch.output import print_json
from udrl_launch.subcommands.options import FILE, RUN_DIR
from udrl_proto.text import printable
from udrl_show import curve
from udrl_show.display import duration, wrapped

_HEAD = "state", "environment", "seed", "env steps", "best return", "changed", "reason", "run"


@click.command()
@click.argument("folder", type=click.Path(path_type=Path), default=Path("runs"))
@click.option("--json", "as_json", is_flag=True, help="Print one line of JSON per run.")
def runs(folder: Path, as_json: bool) -> int:
    """List runs, newest first.

    Shows state and best return of the runs in FOLDER, which is ./runs by default.

    Example: udrl runs
    """
    found = find(folder)
    if as_json:
        for summary in found:
            print_json(summary)
        return 0
    if not found:
        click.echo(f"no runs in {folder}; start one with: udrl train LunarLander-v3", err=True)
        return 0
    rows = [_HEAD, *([printable(cell) for cell in _cells(summary)] for summary in found)]
    columns = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  ".join(cell.ljust(n) for cell, n in zip(row, columns, strict=True)).rstrip()
        for row in rows
    ]
    width = shutil.get_terminal_size().columns
    if sys.stdout.isatty() and max(map(len, lines)) > width:
        lines = [line for row in rows[1:] for line in _narrow(row, width)]
    for line in lines:
        click.echo(line)
    for summary in found:
        if summary.problem:
            click.echo(printable(f"{summary.run_dir}: {summary.problem}"), err=True)
    return 0


def _narrow(row: Sequence[str], width: int) -> list[str]:
    """Return a row of the table as lines for a narrow terminal."""
    state, environment, seed, steps, best, changed, reason, run_dir = row
    phrases = [f"{state}: {reason}" if reason else state]
    if environment:
        phrases += [environment, f"seed {seed}", f"{steps} env steps", f"best return {best}"]
    phrases.append(f"changed {changed}")
    ends = [";"] * (len(phrases) - 1) + [""]
    parts = [f"{phrase}{end}" for phrase, end in zip(phrases, ends, strict=True)]
    return [run_dir, *(f"  {line}" for line in wrapped(parts, width - 2))]


def _cells(summary: Summary) -> tuple[str, ...]:
    """Return a row of the table; the directory, which may be long, is last."""
    ago = f"{duration(max(0.0, time.time() - summary.changed))} ago"
    if summary.state == "unreadable":
        return summary.state, "", "", "", "", ago, "", summary.run_dir
    best = "none yet" if summary.best_return is None else return_text(summary.best_return)
    steps = f"{summary.env_steps:,} of {summary.max_env_steps:,}"
    seed = str(summary.seed)
    reason = summary.ended_because.partition(":")[0]  # the rest is printed below
    return summary.state, summary.environment, seed, steps, best, ago, reason, summary.run_dir


@click.command()
@click.argument("run_dirs", metavar="RUN_DIR...", type=RUN_DIR, nargs=-1, required=True)
@click.option("--output", "-o", type=FILE, metavar="FILE",
              default=Path("learning_curves.png"), show_default=True,
              help="Figure to write: .png, .svg or .pdf.")  # fmt: skip
@click.option("--x", type=click.Choice(["env_steps", "wall_s"]), default="env_steps",
              show_default=True, help="Quantity on the x-axis.")  # fmt: skip
def plot(run_dirs: tuple[Path, ...], output: Path, x: Literal["env_steps", "wall_s"]) -> int:
    """Plot the learning curves of several runs.

    Draws a panel for each environment. Each RUN_DIR is a line. A folder of runs is drawn as a line
    for each configuration: the mean over its seeds.

    Example: udrl plot runs --output all.svg
    """
    for note in curve.compare(run_dirs, output, x):
        click.echo(f"not drawn: {note}", err=True)
    click.echo(f"figure: {output}")
    return 0
