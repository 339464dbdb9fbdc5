"""``udrl evaluate``, ``udrl reproduce`` and ``udrl status``."""

import traceback
from pathlib import Path

import click

from udrl.errors import EnvironmentFault
from udrl.evaluation import return_text
from udrl_inspect import agents, inspection
from udrl_inspect.greedy import caution
from udrl_launch.output import print_json, print_table, print_text
from udrl_launch.subcommands.options import (
    CONNECT,
    DESIRED_HORIZON,
    DESIRED_RETURN,
    GREEDY,
    KEYS,
    RUN,
    RUN_DIR,
    TEMPERATURE,
    WEIGHTS,
    chosen_temperature,
    place,
    version,
)
from udrl_show.display import panel


@click.command()
@click.argument("run_dir", type=RUN_DIR)
@click.option("--episodes", type=click.IntRange(1, 100_000), default=100, show_default=True,
              metavar="N", help="Number of episodes.")  # fmt: skip
@TEMPERATURE
@GREEDY
@DESIRED_RETURN
@DESIRED_HORIZON
@WEIGHTS
@click.option("--envs", type=click.IntRange(1, 4096), default=16, show_default=True, metavar="N",
              help="Environments to step at once; 1 if only one copy can run.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def evaluate(
    run_dir: Path,
    episodes: int,
    temperature: float | None,
    greedy: bool,
    desired_return: float | None,
    desired_horizon: int | None,
    weights: str,
    envs: int,
    as_json: bool,
) -> int:
    """Evaluate a trained agent.

    Reports the mean return for the command of the run's evaluations, or for one of your own.

    Example: udrl evaluate runs/mine --desired-return 200 --desired-horizon 300
    """
    agent = agents.load_agent(run_dir, version(weights))
    commands = agents.evaluation_commands(
        agent, episodes=episodes, temperature=chosen_temperature(temperature, greedy=greedy),
        desired_return=desired_return, desired_horizon=desired_horizon,
    )  # fmt: skip
    result = agents.evaluate(agent, commands, envs)
    if warning := caution(agent, run_dir, commands[0], result.returns):
        click.echo(warning, err=True)
    if as_json:
        report = {
            "run_dir": str(run_dir), "weights_version": agent.version,
            "temperature": result.temperature, "desired_return": result.desired_return,
            "desired_horizon": result.desired_horizon,
            **result.evaluation._asdict(), "returns": result.returns,
        }  # fmt: skip
        print_json(report)
        return 0
    found = result.evaluation
    print_text(
        f"desired return {return_text(result.desired_return)} within "
        f"{result.desired_horizon} steps, "
        f"temperature {result.temperature:g}, weights version {agent.version}: mean return "
        f"{return_text(found.mean)} (95 % interval {return_text(found.ci95_low)} to "
        f"{return_text(found.ci95_high)}), standard deviation {return_text(found.std)}, "
        f"{found.episodes} episodes"
    )
    return 0


@click.command()
@click.argument("run_dir", type=RUN_DIR)
@click.argument("command_id", type=click.IntRange(0))
def reproduce(run_dir: Path, command_id: int) -> int:
    """Run one outstanding command of a run to debug a failure.

    Executes it in this process and prints the traceback. The run is not changed.

    Example: udrl reproduce runs/mine 12000003
    """
    try:
        episode = agents.reproduce(run_dir, command_id)
    except EnvironmentFault as fault:
        traceback.print_exception(fault.__cause__)
        raise
    click.echo(
        f"command {command_id} succeeded: an episode of {episode.length} steps with return "
        f"{episode.episode_return}; if it failed in the run, the failure did not recur; the run "
        f"was not changed"
    )
    return 0


@click.command()
@click.argument("run_dir", type=RUN_DIR, required=False)
@CONNECT
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@KEYS
@RUN
def status(
    run_dir: Path | None, connect: str | None, as_json: bool, keys: Path | None, run_id: str | None
) -> int:
    """Show the status of a run.

    Pass either RUN_DIR or --connect ENDPOINT.

    Example: udrl status runs/mine
    """
    found = inspection.status_from(
        place(run_dir, connect, run_id, keys), keys, lambda why: click.echo(why, err=True)
    )
    if as_json:
        print_json(found)
    else:
        print_table(panel(found))
    return 0
