"""``udrl check``."""

import shlex
from pathlib import Path

import click

from udrl.config import UNSET
from udrl_inspect.checking import Check, check_environment
from udrl_launch import completions
from udrl_launch.output import print_json, print_text
from udrl_launch.paths import shown
from udrl_launch.settings import gather
from udrl_launch.subcommands.settings_options import origin_options


@click.command()
@click.argument("env", shell_complete=completions.environments)
@origin_options
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def check(
    env: str,
    preset_name: str | None,
    file: Path | None,
    assignments: tuple[str, ...],
    as_json: bool,
) -> int:
    """Check whether an environment can be trained on.

    Also reports its spaces, random returns, speed and memory, and the settings chosen for it.

    Example: udrl check your_package.your_module:YourEnv-v0
    """
    settings = gather(env, preset_name=preset_name, file=file, assignments=assignments, options={})
    found = check_environment(settings.config, settings.automatic)
    if as_json:
        print_json(found)
        return 0
    for name, text in _lines(found):
        print_text(text, f"{name:<13} ")
    given = ["--preset", preset_name] if preset_name else []
    given += ["--config", shown(file)] if file else []
    given += [f"--set={assignment}" for assignment in assignments]
    # Not wrapped, so that it can be copied.
    click.echo(
        f"{'verdict':<13} supported; train with: {shlex.join(['udrl', 'train', env, *given])}"
    )
    return 0


def _lines(found: Check) -> list[tuple[str, str]]:
    observations = " ".join(found.declared_observations.split())  # NumPy aligns bounds in columns
    limit = f"at most {found.max_episode_steps:,} steps"
    if found.max_return is not None:
        limit += f", return at most {found.max_return:g}"
    lines = [
        ("environment", found.environment),
        ("observations", f"{observations}; read as {found.observations}"),
        ("actions", f"{found.declared_actions}; read as {found.actions}"),
        ("episodes", limit),
        (
            "random play",
            f"mean return {found.return_mean:.4g} ({found.return_min:.4g} to "
            f"{found.return_max:.4g}), mean length {found.length_mean:.4g} steps, in "
            f"{found.episodes} episodes",
        ),
        ("reproducible", "yes, from its seed" if found.repeats else "NO"),
        (
            "speed",
            f"{1 / found.step_s:,.0f} steps/s in one process; reset "
            f"{1000 * found.reset_s:.3g} ms, creation {found.make_s:.2g} s",
        ),
        (
            "memory",
            f"{found.step_bytes:,} bytes per step; about {found.memory_mib:g} MiB per environment",
        ),
    ]
    if found.chosen:
        chosen = ", ".join(
            f"{name} = {_as_assigned(value)}" for name, value in found.chosen.items()
        )
        lines.append(("settings", f"{chosen} (chosen from random episodes)"))
    return lines + [("advice", sentence) for sentence in found.advice]


def _as_assigned(value: float | str | None) -> str:
    """Return a setting's value as ``--set`` accepts it."""
    if value is None:
        return UNSET
    return str(value).lower() if isinstance(value, bool) else str(value)
