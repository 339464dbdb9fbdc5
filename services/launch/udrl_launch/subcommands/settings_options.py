"""Command-line options for settings, and the settings that result from them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from udrl.config import preset_names
from udrl_inspect.inspection import settings_to_resume
from udrl_launch import completions
from udrl_launch.settings import Settings, gather
from udrl_launch.subcommands.options import FILE, STEPS

Decorated = TypeVar("Decorated", bound=Callable[..., Any])


#: Options for the origins of settings.
ORIGINS = (
    click.option("--preset", "preset_name", metavar="NAME", shell_complete=completions.presets,
                 help=f"Settings that ship with udrl: {', '.join(preset_names())}; or none. "
                 "Default: the preset named after ENV, else any."),
    click.option("--config", "file", type=FILE, metavar="FILE",
                 help="Read settings from a TOML file."),
    click.option("--set", "assignments", multiple=True, metavar="NAME=VALUE",
                 shell_complete=completions.settings,
                 help="Set any setting, e.g. --set batch_size=512. May be repeated."),
)  # fmt: skip


def origin_options(command: Decorated) -> Decorated:
    """Add the options for the origins of settings."""
    for option in reversed(ORIGINS):
        command = option(command)
    return command


def settings_options(command: Decorated) -> Decorated:
    """Add the options for settings."""
    options = (
        *ORIGINS,
        click.option("--from-dataset", "dataset", metavar="NAME",
                     help="Start from the episodes of a Minari dataset instead of random ones."),
        click.option("--seed", type=int, metavar="N", help="Random seed of the run."),
        click.option("--lead", type=int, metavar="N",
                     help="Iterations that acting may run ahead of training."),
        click.option("--max-env-steps", type=STEPS,
                     help="Stop after this many env steps, e.g. 3M."),
        click.option("--stop-return", type=float, metavar="NUMBER",
                     help="Stop when an evaluation reaches this mean return."),
        click.option("--eval-every", type=STEPS, help="Env steps between evaluations."),
        click.option("--eval-episodes", type=int, metavar="N", help="Episodes per evaluation."),
    )  # fmt: skip
    for option in reversed(options):
        command = option(command)
    return command


def gather_settings(
    env: str, given: dict[str, Any], run_dir: Path | None, *, resume: bool
) -> Settings:
    """Return the settings of a command from its options."""
    return gather(
        env,
        preset_name=given.pop("preset_name"),
        file=given.pop("file"),
        # As when the run was created, even if the presets have changed since.
        stored=settings_to_resume(run_dir if resume else None),
        assignments=given.pop("assignments"),
        options=given,
    )
