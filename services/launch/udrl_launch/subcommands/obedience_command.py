"""``udrl obedience``."""

import sys
from pathlib import Path

import click
import msgspec

from udrl.errors import ConfigError, StoreError
from udrl.file_endings import check_ending
from udrl_inspect import csv_tables, obedience_text
from udrl_inspect import obedience_report as reports
from udrl_inspect.agents import load_agent
from udrl_launch.output import print_json, print_text
from udrl_launch.subcommands.options import (
    FILE,
    GREEDY,
    RETURNS,
    RUN_DIR,
    TEMPERATURE,
    WEIGHTS,
    FiniteRange,
    chosen_temperature,
    version,
)
from udrl_show import pictures
from udrl_show.obedience_picture import draw_obedience

_NAME = Path(reports.FILE)


@click.command()
@click.argument("run_dir", type=RUN_DIR)
@click.option("--episodes", type=click.IntRange(2, 100_000), default=100, show_default=True,
              metavar="N", help="Episodes per command.")  # fmt: skip
@click.option("--points", type=click.IntRange(2, 101), default=11, show_default=True,
              metavar="N", help="Number of desired returns, and of desired horizons.")  # fmt: skip
@click.option("--desired-returns", type=RETURNS, metavar="LOW:HIGH",
              help="Range of desired returns. Default: that of the replay buffer, without the "
              "lowest 5 %.")  # fmt: skip
@click.option("--tolerance", type=FiniteRange(0, 1e9), metavar="NUMBER",
              help="Largest difference between desired and mean obtained return that counts as "
              "obeyed. Default: 10 % of the default range of desired returns.")  # fmt: skip
@TEMPERATURE
@GREEDY
@WEIGHTS
@click.option("--output", "-o", type=FILE, metavar="FILE",
              help="Figure to write: .png, .svg or .pdf. Default: RUN_DIR/obedience.png, if "
              "matplotlib is installed.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
def obedience(
    run_dir: Path,
    episodes: int,
    points: int,
    desired_returns: tuple[float, float] | None,
    tolerance: float | None,
    temperature: float | None,
    greedy: bool,
    weights: str,
    output: Path | None,
    as_json: bool,
) -> int:
    """Measure how well an agent follows its commands.

    Commands a range of returns and horizons, and reports the obtained ones.

    Example: udrl obedience runs/mine
    """
    if output is not None:
        check_ending(output, pictures.ENDINGS)
    agent = load_agent(run_dir, version(weights))
    plan = reports.plan_commands(
        agent, points=points, episodes=episodes,
        temperature=chosen_temperature(temperature, greedy=greedy),
        desired_returns=desired_returns,
    )  # fmt: skip
    if sys.stderr.isatty():
        with click.progressbar(length=plan.total, label="episodes", file=sys.stderr) as bar:
            report = reports.measure(agent, plan, tolerance, lambda: bar.update(1))
    else:
        report = reports.measure(agent, plan, tolerance)
    if as_json:
        document = {
            "run_dir": str(run_dir), "answer": obedience_text.answer(report),
            **msgspec.to_builtins(report),
        }  # fmt: skip
        print_json(document)
    else:
        for paragraph in obedience_text.table(report).splitlines():
            print_text(paragraph)
    for problem in _write_files(run_dir, report, draws=output is None):
        click.echo(problem, err=True)
    if output is not None:
        draw_obedience(report, output)
    return 0


def _write_files(run_dir: Path, report: reports.ObedienceReport, *, draws: bool) -> list[str]:
    """Write the files in the run's directory, and return what went wrong."""
    try:
        reports.save_report(run_dir, report)
        columns, rows = obedience_text.COLUMNS, obedience_text.rows(report)
        csv_tables.write_cells(run_dir / _NAME.with_suffix(".csv"), columns, rows)
    except (OSError, StoreError) as error:
        return [f"the report cannot be written to {run_dir}: {error}"]
    try:
        if draws:
            draw_obedience(report, run_dir / _NAME.with_suffix(".png"))
    except ConfigError as error:
        return [f"no figure: {error}"]
    return []
