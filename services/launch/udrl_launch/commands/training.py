"""``udrl train``."""

import logging
import threading
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import click

from udrl.errors import ConfigError, UdrlError
from udrl.evaluation import return_text
from udrl_launch.commands.options import AUDIT, KEYS, METRICS_HOST, RUN_DIR
from udrl_launch.commands.settings import gather_settings, settings_options
from udrl_launch.output import print_json
from udrl_launch.paths import new_run_dir, shown
from udrl_launch.process import PARENTS_GRACE_S, log_to_stderr, run_service
from udrl_launch.settings import Settings
from udrl_launch.training import Adviser, Watchers
from udrl_launch.training import train as run_training
from udrl_proto.reports import Status
from udrl_proto.text import printable
from udrl_replay.creation import directory_name
from udrl_show.curve import draw
from udrl_show.display import Display
from udrl_show.event_files import EventFiles
from udrl_show.prometheus import Exporter

log = logging.getLogger("udrl")


@click.command()
@click.argument("env")
@settings_options
@click.option("--actors", type=int, help="Actor processes on this machine.")
@click.option("--envs-per-actor", type=int, help="Environments that each actor steps at once.")
@click.option("--hang-timeout", type=click.FloatRange(1),
              help="Seconds of one round of steps after which an actor is started again.  "
              "[default: 60]")  # fmt: skip
@click.option("--run-dir", type=RUN_DIR, help="The run's directory. Default: a new one in ./runs.")
@click.option("--resume", is_flag=True, help="Go on with the run in --run-dir, if there is one.")
@click.option("--in-process", is_flag=True, help="All services in one process.")
@click.option(
    "--listen",
    metavar="ENDPOINT",
    help="Endpoint, e.g. tcp/127.0.0.1:7447. Default: a free loopback port.",
)
@click.option("--insecure", is_flag=True, help="Listen beyond loopback without authentication.")
@KEYS
@click.option("--allow-inexact", is_flag=True, help="Accept actors that round differently.")
@AUDIT
@click.option("--tensorboard", is_flag=True, help="Write event files into RUN_DIR/tensorboard.")
@click.option("--metrics-port", type=click.IntRange(0, 65_535), metavar="PORT",
              help="Tell Prometheus how the run is doing at this port.")  # fmt: skip
@METRICS_HOST
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
    keys: Path | None,
    allow_inexact: bool,
    audit: float,
    tensorboard: bool,
    metrics_port: int | None,
    metrics_host: str,
    as_json: bool,
    **given: Any,
) -> int:
    """Train an agent on this machine: replay, learner and actors.

    Example: udrl train LunarLander-v3 --max-env-steps 2M --seed 7
    """
    if resume and run_dir is None:
        raise ConfigError("--resume needs --run-dir: the directory of the run to go on with")
    settings = gather_settings(env, given, run_dir, go_on=resume)
    run_dir = run_dir or new_run_dir(directory_name(settings.config))
    log_to_stderr(logging.WARNING)
    warn_of_idle_environments(settings)

    def service(stop: threading.Event) -> None:
        with ExitStack() as stack:
            watchers = Watchers()
            if metrics_port is not None:
                exporter = Exporter(watchers.latest, metrics_host, metrics_port)
                stack.enter_context(closing(exporter))
                click.echo(f"metrics: http://{metrics_host}:{exporter.port}/metrics", err=True)
            if tensorboard:
                watchers.add(stack.enter_context(closing(EventFiles(run_dir))))
            watchers.add(stack.enter_context(Display()))
            watchers.add(Adviser())
            status = run_training(
                settings, run_dir, stop, go_on=resume, in_process=in_process,
                allow_inexact=allow_inexact, listen=listen, insecure=insecure, keys=keys,
                audit=audit, watcher=watchers,
            )  # fmt: skip
            watchers.show(status)
        _finish(run_dir, status)
        if as_json:
            print_json(status)
        if status.problem:
            raise UdrlError(printable(status.problem))

    return run_service(service, PARENTS_GRACE_S)


def warn_of_idle_environments(settings: Settings) -> None:
    """Warn if somebody asked for more environments than exploring can keep busy."""
    config, _, fleet, left_open = settings
    if "n_episodes_per_iter" in left_open:
        return
    useful = config.commands.n_episodes_per_iter * (config.lead + 1)
    asked_for = fleet.actors * (fleet.envs_per_actor or 1)
    if asked_for > 2 * useful:
        log.warning(
            "%d environments, but at most %d episodes can run at once (n_episodes_per_iter x "
            "(lead + 1)); but for warm-up and evaluations the others will be idle",
            asked_for, useful,
        )  # fmt: skip


def _finish(run_dir: Path, status: Status) -> None:
    """Write the weights and the picture, and say where everything is."""
    closing = status.closing_evaluation
    if not status.problem:
        click.echo(f"ended:          {status.ended_because}")
    if closing is not None:
        click.echo(
            f"final evaluation: mean return {return_text(closing.mean)} (95 % interval "
            f"{return_text(closing.ci95_low)} to {return_text(closing.ci95_high)}, "
            f"{closing.episodes} episodes) after {status.env_steps:,} env steps, "
            f"{status.wall_s:.0f} s"
        )
    if status.weights_version:
        weights = run_dir / "weights.safetensors"
        click.echo(f"weights:        {shown(weights)} (version {status.weights_version})")
    else:
        click.echo("weights:        none; the budget was spent in the warm-up")
    click.echo(f"metrics:        {shown(run_dir / 'metrics.csv')}")
    try:
        click.echo(f"learning curve: {shown(draw(run_dir, status.environment))}")
    except ConfigError as error:
        click.echo(f"learning curve: {error}")
