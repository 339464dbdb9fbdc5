"""The command ``udrl``."""

import logging
import os
import sys
import threading
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

import click
import msgspec

import udrl
from udrl.config import preset_names
from udrl.errors import ConfigError, EnvironmentFault, InexactArithmetic, UdrlError
from udrl.numerics import STRICT_MKL
from udrl_launch import inspection, roles
from udrl_launch.curve import draw
from udrl_launch.display import Display, panel
from udrl_launch.process import die_with_parent, log_to_stderr, run_service
from udrl_launch.settings import Settings, gather
from udrl_launch.training import train as run_training
from udrl_proto.messages import Status
from udrl_proto.session import check_endpoint
from udrl_replay.creation import create, directory_name, exists, resume, write_config

log = logging.getLogger("udrl")

Command = TypeVar("Command", bound=Callable[..., Any])


def main() -> None:
    """Run the command line; errors of ours are one line, without a traceback."""
    try:
        code = cli(standalone_mode=False)
    except UdrlError as error:
        click.echo(f"udrl: error: {error}", err=True)
        code = error.exit_code
    except click.ClickException as error:
        error.show()
        code = error.exit_code
    except click.Abort:
        code = 130
    sys.stdout.flush()
    sys.exit(code)


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(udrl.__version__, prog_name="udrl")
def cli() -> None:
    """Upside-Down Reinforcement Learning, exact and distributed."""


def _settings_options(command: Command) -> Command:
    """Add the options that settings come from."""
    options = (
        click.option("--preset", "preset_name", metavar="NAME",
                     help=f"Shipped settings: {', '.join(preset_names())}. "
                     "Default: the one named like ENV, if any."),
        click.option("--config", "file", type=click.Path(path_type=Path), metavar="FILE",
                     help="Settings from a TOML file."),
        click.option("--set", "assignments", multiple=True, metavar="HYPERPARAMETER=VALUE",
                     help="Set any setting, e.g. --set batch_size=512; may be repeated."),
        click.option("--seed", type=int, help="Seed of the run."),
        click.option("--lead", type=int, help="Iterations that acting may run ahead of training."),
        click.option("--max-env-steps", type=int, help="Budget in env steps."),
        click.option("--stop-return", type=float,
                     help="End when an evaluation reaches this mean return."),
        click.option("--eval-every", type=int, help="Env steps between evaluations."),
        click.option("--eval-episodes", type=int, help="Episodes in an evaluation."),
    )  # fmt: skip
    for option in reversed(options):
        command = option(command)
    return command


_RUN_DIR = click.Path(path_type=Path, file_okay=False)


def _gather(env: str, given: dict[str, Any], run_dir: Path | None, *, go_on: bool) -> Settings:
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


@cli.command()
@click.argument("env")
@_settings_options
@click.option("--actors", type=int, help="Actor processes on this machine.")
@click.option("--envs-per-actor", type=int, help="Environments that each actor steps at once.")
@click.option("--run-dir", type=_RUN_DIR, help="The run's directory. Default: a new one in ./runs.")
@click.option("--resume", is_flag=True, help="Go on with the run in --run-dir, if there is one.")
@click.option("--in-process", is_flag=True, help="All services in one process.")
@click.option(
    "--listen",
    metavar="ENDPOINT",
    help="Endpoint, e.g. tcp/127.0.0.1:7447. Default: a free loopback port.",
)
@click.option("--insecure", is_flag=True, help="Listen beyond loopback without authentication.")
@click.option("--allow-inexact", is_flag=True, help="Accept actors that round differently.")
@click.option(
    "--json", "as_json", is_flag=True, help="End with the final status as a line of JSON."
)
def train(
    env: str,
    run_dir: Path | None,
    resume: bool,
    in_process: bool,
    listen: str | None,
    insecure: bool,
    allow_inexact: bool,
    as_json: bool,
    **given: Any,
) -> int:
    """Train an agent on this machine: replay, learner and actors.

    Example: udrl train LunarLander-v3 --max-env-steps 2000000 --seed 7
    """
    if resume and run_dir is None:
        raise ConfigError("--resume needs --run-dir: the directory of the run to go on with")
    settings = _gather(env, given, run_dir, go_on=resume)
    run_dir = run_dir or _new_run_dir(settings)
    log_to_stderr(logging.WARNING)
    _warn_of_idle_actors(settings)

    def service(stop: threading.Event) -> None:
        with Display() as display:
            status = run_training(
                settings, run_dir, stop, go_on=resume, in_process=in_process,
                allow_inexact=allow_inexact, listen=listen, insecure=insecure, display=display,
            )  # fmt: skip
        _finish(run_dir, status)
        if as_json:
            click.echo(msgspec.json.encode(status).decode())
        if status.problem:
            raise UdrlError(status.problem)

    return run_service(service)


def _new_run_dir(settings: Settings) -> Path:
    """Return a directory for a new run."""
    return Path("runs") / directory_name(settings.config)


def _warn_of_idle_actors(settings: Settings) -> None:
    config, _, fleet = settings
    useful = config.n_episodes_per_iter * (config.lead + 1)
    environments = fleet.actors * fleet.envs_per_actor
    if environments > 2 * useful:
        log.warning(
            "%d environments, but at most %d episodes can run at once (n_episodes_per_iter x "
            "(lead + 1)); the others will be idle",
            environments, useful,
        )  # fmt: skip


def _finish(run_dir: Path, status: Status) -> None:
    """Write the weights and the picture, and say where everything is."""
    closing = status.closing_evaluation
    if closing is not None:
        click.echo(
            f"final evaluation: mean return {closing.mean:.1f} "
            f"(95 % interval {closing.ci95_low:.1f} to {closing.ci95_high:.1f}, "
            f"{closing.episodes} episodes) after {status.env_steps:,} env steps, "
            f"{status.wall_s:.0f} s"
        )
    if status.weights_version:
        weights = run_dir / "weights.safetensors"
        weights.write_bytes(inspection.load_agent(run_dir).weights)
        click.echo(f"weights:        {weights} (version {status.weights_version})")
    else:
        click.echo("weights:        none; the budget was spent in the warm-up")
    click.echo(f"metrics:        {run_dir / 'metrics.csv'}")
    try:
        click.echo(f"learning curve: {draw(run_dir, status.environment)}")
    except ConfigError as error:
        click.echo(f"learning curve: {error}")


_PARENT = click.option("--parent", type=int, hidden=True)
_PATIENCE = click.option("--patience", type=click.FloatRange(0), default=3.0, show_default=True,
                         help="Seconds to look for the run.")  # fmt: skip
_RUN = click.option(
    "--run", "run_id", metavar="RUN_ID", help="Which run, where a router carries several."
)


def _as_service(parent: int | None, service: Callable[[threading.Event], None]) -> int:
    if parent is not None:
        die_with_parent(parent)
    log_to_stderr()
    return run_service(service)


@cli.command()
@click.argument("env")
@_settings_options
@click.option(
    "--listen", metavar="ENDPOINT", help="Host the run's Zenoh endpoint, e.g. tcp/127.0.0.1:7447."
)
@click.option("--connect", metavar="ENDPOINT", help="Use the router at this endpoint instead.")
@click.option("--run-dir", type=_RUN_DIR, help="The run's directory. Default: a new one in ./runs.")
@click.option("--resume", is_flag=True, help="Go on with the run in --run-dir, if there is one.")
@click.option("--insecure", is_flag=True, help="Listen beyond loopback without authentication.")
@click.option("--allow-inexact", is_flag=True, help="Accept actors that round differently.")
@_PARENT
def replay(
    env: str,
    listen: str | None,
    connect: str | None,
    run_dir: Path | None,
    resume: bool,
    insecure: bool,
    allow_inexact: bool,
    parent: int | None,
    **given: Any,
) -> int:
    """Start the replay service of a run: the only store, and its Zenoh endpoint.

    Example: udrl replay LunarLander-v3 --listen tcp/127.0.0.1:7447 --run-dir runs/mine
    """
    if (listen is None) == (connect is None):
        raise ConfigError("give either --listen ENDPOINT or --connect ENDPOINT")
    check_endpoint(listen or connect or "")
    settings = _gather(env, given, run_dir, go_on=resume)
    run_dir = run_dir or _new_run_dir(settings)

    def service(stop: threading.Event) -> None:
        log.info("the run's directory is %s", run_dir)
        store = _open(run_dir, settings, go_on=resume, allow_inexact=allow_inexact)
        roles.replay(
            run_dir, store, settings.budget, stop, listen=listen, connect=connect, insecure=insecure
        )

    return _as_service(parent, service)


def _open(run_dir: Path, settings: Settings, *, go_on: bool, allow_inexact: bool) -> Any:
    if go_on and exists(run_dir):
        store = resume(run_dir, settings.config, allow_inexact=allow_inexact)
    else:
        store = create(run_dir, settings.config, allow_inexact=allow_inexact)
    write_config(run_dir, settings.config, settings.budget)
    return store


@cli.command()
@click.option(
    "--connect",
    metavar="ENDPOINT",
    required=True,
    help="Where the run is, e.g. tcp/127.0.0.1:7447.",
)
@_PATIENCE
@_RUN
@_PARENT
def learner(connect: str, patience: float, run_id: str | None, parent: int | None) -> int:
    """Start the learner of a run.

    Example: udrl learner --connect tcp/127.0.0.1:7447
    """
    address = roles.Address(check_endpoint(connect), run_id, patience)
    return _as_service(parent, partial(roles.learner, address))


@cli.command()
@click.option(
    "--connect",
    metavar="ENDPOINT",
    required=True,
    help="Where the run is, e.g. tcp/127.0.0.1:7447.",
)
@click.option("--envs", type=click.IntRange(1, 4096), default=16, show_default=True,
              help="Environments to step at once.")  # fmt: skip
@click.option("--nice", type=click.IntRange(0, 19), default=0, help="Yield to other processes.")
@click.option("--hang-timeout", type=click.FloatRange(1), default=60.0, show_default=True,
              help="Seconds of one round of steps after which the process ends.")  # fmt: skip
@_PATIENCE
@_RUN
@_PARENT
def actor(
    connect: str,
    envs: int,
    nice: int,
    hang_timeout: float,
    patience: float,
    run_id: str | None,
    parent: int | None,
) -> int:
    """Start an actor; the run tells it everything else.

    Example: udrl actor --connect tcp/127.0.0.1:7447 --envs 16
    """
    os.nice(nice)
    address = roles.Address(check_endpoint(connect), run_id, patience)
    code = _as_service(parent, partial(roles.actor, address, envs, hang_s=hang_timeout))
    if code == InexactArithmetic.exit_code and not STRICT_MKL.items() <= os.environ.items():
        log.warning("starting again with slower arithmetic that is exact")
        command = [sys.executable, "-m", "udrl_launch", *sys.argv[1:]]
        os.execve(sys.executable, command, os.environ | STRICT_MKL)  # noqa: S606 - ourselves
    return code


def _version(text: str) -> int | Literal["latest", "best"]:
    if text == "latest" or text == "best":
        return text  # type: ignore[return-value]
    if text.isdecimal():
        return int(text)
    raise ConfigError(f"--weights {text}: expected latest, best or a version number")


@cli.command()
@click.argument("run_dir", type=_RUN_DIR)
@click.option("--episodes", type=click.IntRange(1, 100_000), default=100, show_default=True,
              help="Episodes to run.")  # fmt: skip
@click.option("--greedy/--sampled", default=None,
              help="Act by the mode of the action distribution, or sample. Default: as the run's "
              "evaluations.")  # fmt: skip
@click.option("--desired-return", type=float, help="Default: as in section 2.3.6.")
@click.option("--desired-horizon", type=click.IntRange(1, 2**31 - 1), help="Default: likewise.")
@click.option("--weights", default="latest", show_default=True, metavar="latest|best|VERSION",
              help="Which of the versions that the run keeps.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def evaluate(
    run_dir: Path,
    episodes: int,
    greedy: bool | None,
    desired_return: float | None,
    desired_horizon: int | None,
    weights: str,
    as_json: bool,
) -> int:
    """Evaluate a trained agent, with the run's command or one of your own.

    Example: udrl evaluate runs/mine --greedy --desired-return 200 --desired-horizon 300
    """
    agent = inspection.load_agent(run_dir, _version(weights))
    result = inspection.evaluate(
        agent, episodes=episodes, greedy=greedy, desired_return=desired_return,
        desired_horizon=desired_horizon,
    )  # fmt: skip
    if as_json:
        report = {
            "run_dir": str(run_dir), "weights_version": agent.version, "greedy": result.greedy,
            "desired_return": result.desired_return, "desired_horizon": result.desired_horizon,
            **result.evaluation._asdict(), "returns": result.returns,
        }  # fmt: skip
        click.echo(msgspec.json.encode(report).decode())
        return 0
    found = result.evaluation
    click.echo(
        f"commanded return {result.desired_return:.1f} within {result.desired_horizon} steps, "
        f"{'greedy' if result.greedy else 'sampled'}, weights version {agent.version}: mean return "
        f"{found.mean:.1f} (95 % interval {found.ci95_low:.1f} to {found.ci95_high:.1f}), "
        f"standard deviation {found.std:.1f}, {found.episodes} episodes"
    )
    return 0


@cli.command()
@click.argument("run_dir", type=_RUN_DIR)
@click.argument("command_id", type=click.IntRange(0))
def reproduce(run_dir: Path, command_id: int) -> int:
    """Carry out one outstanding command of a run here, to see why it fails.

    Example: udrl reproduce runs/mine 12000003
    """
    try:
        episode = inspection.reproduce(run_dir, command_id)
    except EnvironmentFault as fault:
        traceback.print_exception(fault.__cause__)
        raise
    click.echo(
        f"command {command_id} gave an episode of {episode.length} steps with return "
        f"{episode.episode_return}; nothing was changed"
    )
    return 0


@cli.command()
@click.argument("run_dir", type=_RUN_DIR, required=False)
@click.option("--connect", metavar="ENDPOINT", help="Endpoint of the run, e.g. tcp/127.0.0.1:7447.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@_RUN
def status(run_dir: Path | None, connect: str | None, as_json: bool, run_id: str | None) -> int:
    """Say how a run is doing, by its directory or its endpoint.

    Example: udrl status runs/mine
    """
    if (run_dir is None) == (connect is None):
        raise ConfigError("give either RUN_DIR or --connect ENDPOINT")
    if run_dir is not None:
        found = inspection.status_of(run_dir)
    else:
        found = inspection.status_at(check_endpoint(connect or ""), run_id)
    if as_json:
        click.echo(msgspec.json.encode(found).decode())
    else:
        from rich.console import Console

        Console(soft_wrap=True).print(panel(found))
    return 0
