"""The options that settings come from, and the settings that they give."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from udrl.config import preset_names
from udrl_inspect import inspection
from udrl_launch.commands.options import FILE, STEPS
from udrl_launch.settings import Settings, gather
from udrl_replay.creation import exists

Command = TypeVar("Command", bound=Callable[..., Any])


def settings_options(command: Command) -> Command:
    """Add the options that settings come from."""
    options = (
        click.option("--preset", "preset_name", metavar="NAME",
                     help=f"Shipped settings: {', '.join(preset_names())}. "
                     "Or none. Default: the one named like ENV, else any."),
        click.option("--config", "file", type=FILE, metavar="FILE",
                     help="Settings from a TOML file."),
        click.option("--set", "assignments", multiple=True, metavar="HYPERPARAMETER=VALUE",
                     help="Set any setting, e.g. --set batch_size=512; may be repeated."),
        click.option("--from-dataset", "dataset", metavar="NAME",
                     help="Begin with the episodes of a Minari dataset, not with random ones."),
        click.option("--seed", type=int, help="Seed of the run."),
        click.option("--lead", type=int, help="Iterations that acting may run ahead of training."),
        click.option("--max-env-steps", type=STEPS, help="Budget in env steps, e.g. 3M."),
        click.option("--stop-return", type=float,
                     help="End when an evaluation reaches this mean return."),
        click.option("--eval-every", type=STEPS, help="Env steps between evaluations."),
        click.option("--eval-episodes", type=int, help="Episodes in an evaluation."),
    )  # fmt: skip
    for option in reversed(options):
        command = option(command)
    return command


def gather_settings(
    env: str, given: dict[str, Any], run_dir: Path | None, *, go_on: bool
) -> Settings:
    """Return the settings of a command from what was given on its line."""
    going_on = go_on and run_dir is not None and exists(run_dir)
    return gather(
        env,
        preset_name=given.pop("preset_name"),
        file=given.pop("file"),
        # What the run was created with, also if the presets have changed since.
        stored=inspection.settings_of(run_dir) if going_on and run_dir is not None else None,
        assignments=given.pop("assignments"),
        options=given,
    )
