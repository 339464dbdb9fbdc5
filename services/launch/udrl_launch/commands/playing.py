"""``udrl play``."""

from pathlib import Path

import click

from udrl.evaluation import return_text
from udrl_inspect.agents import evaluation_commands, load_agent
from udrl_inspect.greedy import caution
from udrl_launch.commands.options import (
    FILE,
    GREEDY,
    RETURN,
    RUN_DIR,
    TEMPERATURE,
    WEIGHTS,
    chosen_temperature,
    version,
)
from udrl_launch.output import print_json
from udrl_launch.paths import shown
from udrl_show.playing import play as play_episodes
from udrl_show.playing import with_seeds
from udrl_show.window import KEYS_HELP, Window


@click.command()
@click.argument("run_dir", type=RUN_DIR)
@click.option("--desired-return", type=RETURN, metavar="R", help="Default: as in section 2.3.6.")
@click.option("--desired-horizon", type=click.IntRange(1, 2**31 - 1), metavar="H",
              help="In how many steps. Default: likewise.")  # fmt: skip
@click.option("--episodes", type=click.IntRange(1, 100_000), default=3, show_default=True,
              help="Episodes to play.")  # fmt: skip
@click.option("--seed", type=click.IntRange(0, 2**31 - 1),
              help="Of the first episode, one more for each that follows: command, weights and "
              "seed decide an episode. Default: those of the run's closing "
              "evaluation.")  # fmt: skip
@TEMPERATURE
@GREEDY
@WEIGHTS
@click.option("--video", type=FILE, metavar="FILE",
              help="Film them: FILE.mp4 or FILE.gif.")  # fmt: skip
@click.option(
    "--window", "opens_window", is_flag=True,
    help=f"Watch, and change the command on the way. {KEYS_HELP.capitalize()}.",
)  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print a line of JSON for each episode.")
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
    """Give a trained agent an order, and watch.

    Example: udrl play runs/mine --desired-return 200 --desired-horizon 300 --video landing.mp4
    """
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
    told = commands[0]
    if not as_json:
        click.echo(
            f"asked for a return of {return_text(told.desired_return)} within "
            f"{told.desired_horizon} steps (temperature {told.temperature:g}, weights version "
            f"{agent.version})"
        )
    screen = Window if opens_window else None
    obtained: list[float] = []
    for rollout in play_episodes(agent, commands, video=video, open_screen=screen):
        obtained.append(rollout.episode_return)
        if as_json:
            report = {
                "environment_seed": rollout.command.environment_seed,
                "weights_version": agent.version,
                "temperature": told.temperature,
                "desired_return": told.desired_return,
                "desired_horizon": told.desired_horizon,
                "episode_return": rollout.episode_return,
                "length": rollout.steps,
                "terminated": rollout.terminated,
                "truncated": rollout.truncated,
            }
            print_json(report)
        else:
            ending = "" if rollout.terminated else ", cut by its time limit"
            click.echo(
                f"seed {rollout.command.environment_seed}: obtained "
                f"{return_text(rollout.episode_return)} in {rollout.steps} steps{ending}"
            )
    if said := caution(agent, run_dir, told, obtained):
        click.echo(said, err=True)
    if video is not None and not as_json:
        click.echo(f"film: {shown(video)}")
    return 0
