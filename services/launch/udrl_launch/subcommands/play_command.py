"""``udrl play``."""

from pathlib import Path

import click

from udrl.evaluation import return_text
from udrl.file_endings import check_ending
from udrl.rollout import Rollout
from udrl_inspect.agents import Agent, evaluation_commands, load_agent
from udrl_inspect.greedy import caution
from udrl_launch.output import print_json, print_text
from udrl_launch.paths import shown
from udrl_launch.signals import terminable
from udrl_launch.subcommands.options import (
    DESIRED_HORIZON,
    DESIRED_RETURN,
    FILE,
    GREEDY,
    RUN_DIR,
    TEMPERATURE,
    WEIGHTS,
    chosen_temperature,
    version,
)
from udrl_show import film
from udrl_show.playing import play_episodes, with_seeds
from udrl_show.window import KEYS_HELP, Window


@click.command()
@click.argument("run_dir", type=RUN_DIR)
@DESIRED_RETURN
@DESIRED_HORIZON
@click.option("--episodes", type=click.IntRange(1, 100_000), default=3, show_default=True,
              metavar="N", help="Number of episodes.")  # fmt: skip
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), metavar="N",
              help="Reset seed of the first episode; each further one adds 1. Default: the seeds "
              "of the run's final evaluation.")  # fmt: skip
@TEMPERATURE
@GREEDY
@WEIGHTS
@click.option("--video", type=FILE, metavar="FILE",
              help="Record a video: FILE.mp4 or FILE.gif.")  # fmt: skip
@click.option(
    "--window", "opens_window", is_flag=True,
    help=f"Show the episodes in a window. Keys: {KEYS_HELP}.",
)  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print one line of JSON per episode.")
def play(
    run_dir: Path,
    desired_return: float | None,
    desired_horizon: int | None,
    episodes: int,
    seed: int | None,
    temperature: float | None,
    greedy: bool,
    weights: str,
    video: Path | None,
    opens_window: bool,
    as_json: bool,
) -> int:
    """Play episodes with a command of your choice.

    Prints the return of each, and can show them in a window or record a video.

    Example: udrl play runs/mine --desired-return 200 --desired-horizon 300 --video landing.mp4
    """
    if video is not None:
        check_ending(video, film.ENDINGS)
    agent = load_agent(run_dir, version(weights))
    commands = with_seeds(
        evaluation_commands(
            agent,
            episodes=episodes,
            temperature=chosen_temperature(temperature, greedy=greedy),
            desired_return=desired_return,
            desired_horizon=desired_horizon,
        ),
        seed,
    )
    command = commands[0]
    if not as_json:
        print_text(
            f"desired return {return_text(command.desired_return)} within "
            f"{command.desired_horizon} steps (temperature {command.temperature:g}, "
            f"weights version {agent.version})"
        )
    screen = Window if opens_window else None
    obtained: list[float] = []
    with terminable():
        for rollout in play_episodes(agent, commands, video=video, open_screen=screen):
            obtained.append(rollout.episode_return)
            if as_json:
                print_json(_record(agent, rollout))
            else:
                click.echo(_line(rollout))
    if warning := caution(agent, run_dir, command, obtained):
        click.echo(warning, err=True)
    if video is not None and not as_json:
        click.echo(f"video: {shown(video)}")
    return 0


def _record(agent: Agent, rollout: Rollout) -> dict[str, float]:
    """Return an episode as a line of ``--json``."""
    command = rollout.command
    return {
        "environment_seed": command.environment_seed,
        "weights_version": agent.version,
        "temperature": command.temperature,
        "desired_return": command.desired_return,
        "desired_horizon": command.desired_horizon,
        "episode_return": rollout.episode_return,
        "length": rollout.steps,
        "terminated": rollout.terminated,
        "truncated": rollout.truncated,
    }


def _line(rollout: Rollout) -> str:
    """Return an episode as a line of text."""
    ending = "" if rollout.terminated else " (step limit reached)"
    return (
        f"seed {rollout.command.environment_seed}: return "
        f"{return_text(rollout.episode_return)} in {rollout.steps} steps{ending}"
    )
