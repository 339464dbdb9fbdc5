"""``udrl train``."""

import logging
import threading
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import click

from udrl.errors import ConfigError, UdrlError
from udrl.evaluation import return_text
from udrl_launch import completions
from udrl_launch.output import print_json, print_text
from udrl_launch.paths import new_run_dir, shown
from udrl_launch.process import PARENTS_GRACE_S, log_to_stderr, run_service
from udrl_launch.settings import Settings
from udrl_launch.subcommands.options import (
    ALLOW_INEXACT,
    AUDIT,
    INSECURE,
    KEYS,
    METRICS_HOST,
    RESUME,
    RUN_DIR_OPTION,
    FiniteRange,
)
from udrl_launch.subcommands.settings_options import gather_settings, settings_options
from udrl_launch.training_run import Adviser, Watchers, run_training
from udrl_proto.reports import Status
from udrl_proto.text import printable
from udrl_replay.creation import directory_name
from udrl_replay.database import exists
from udrl_show.curve import draw_curve
from udrl_show.display import Display
from udrl_show.prometheus import Exporter
from udrl_show.run_log import RunLog
from udrl_show.run_logs import WRITERS, opened

log = logging.getLogger("udrl")

_COMMAND_LINE = click.core.ParameterSource.COMMANDLINE
#: Options that the run directory does not store, so that the command to resume repeats them.
_NOT_STORED = {
    "actors", "envs_per_actor", "hang_timeout", "in_process", "listen", "insecure", "keys", "audit",
    "logs", "metrics_port", "metrics_host", "as_json",
}  # fmt: skip


@click.command()
@click.argument("env", shell_complete=completions.environments)
@settings_options
@click.option("--actors", type=int, metavar="N", help="Actor processes on this machine.")
@click.option("--envs-per-actor", type=int, metavar="N",
              help="Environments that each actor steps at once.")  # fmt: skip
@click.option("--hang-timeout", type=FiniteRange(1), metavar="SECONDS",
              help="Restart an actor if one round of environment steps takes longer than this. "
              "Default: 60.")  # fmt: skip
@RUN_DIR_OPTION
@RESUME
@click.option("--in-process", is_flag=True, help="Run all services in one process.")
@click.option(
    "--listen",
    metavar="ENDPOINT",
    help="Endpoint to listen on, e.g. tcp/127.0.0.1:7447. Default: a free loopback port.",
)
@INSECURE
@KEYS
@ALLOW_INEXACT
@AUDIT
@click.option("--log", "logs", type=click.Choice(tuple(WRITERS)), multiple=True,
              help="Also log metrics and settings to this program. May be repeated.")  # fmt: skip
@click.option("--metrics-port", type=click.IntRange(0, 65_535), metavar="PORT",
              help="Serve metrics for Prometheus on this port; 0 = any free port.")  # fmt: skip
@METRICS_HOST
@click.option("--json", "as_json", is_flag=True,
              help="Print the final status as one line of JSON.")  # fmt: skip
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
    logs: tuple[str, ...],
    metrics_port: int | None,
    metrics_host: str,
    as_json: bool,
    **given: Any,
) -> int:
    """Train an agent on this machine.

    Starts a replay service, a learner and actors, and restarts those that die.

    Example: udrl train LunarLander-v3 --max-env-steps 2M --seed 7
    """
    if resume and run_dir is None:
        raise ConfigError("--resume needs --run-dir, the directory of the run to resume")
    settings = gather_settings(env, given, run_dir, resume=resume)
    run_dir = run_dir or new_run_dir(directory_name(settings.config))
    if resume and not exists(run_dir):
        click.echo(f"there is no run in {shown(run_dir)} to resume; starting a new one", err=True)
    log_to_stderr(logging.WARNING)
    warn_of_idle_environments(settings)

    def service(stop: threading.Event) -> None:
        with ExitStack() as stack:
            watchers = Watchers()
            if metrics_port is not None:
                exporter = Exporter(watchers.latest, metrics_host, metrics_port)
                stack.enter_context(closing(exporter))
                click.echo(f"metrics: {exporter.address}", err=True)
            run_logs = stack.enter_context(opened(logs, run_dir))
            for run_log in run_logs:
                watchers.add(run_log)
            watchers.add(stack.enter_context(Display()))
            watchers.add(Adviser())
            status = run_training(
                settings, run_dir, stop, resume=resume, in_process=in_process,
                allow_inexact=allow_inexact, listen=listen, insecure=insecure, keys=keys,
                audit=audit, watcher=watchers, resume_options=_options_to_repeat(),
            )  # fmt: skip
            watchers.show(status)
        _finish(run_dir, status, run_logs)
        if as_json:
            print_json(status)
        if status.problem:
            raise UdrlError(printable(status.problem))

    return run_service(service, PARENTS_GRACE_S)


def _options_to_repeat() -> list[str]:
    """Return the options of this command that the run directory does not remember."""
    context = click.get_current_context()
    words = []
    for option in context.command.params:
        name = option.name or ""
        if name not in _NOT_STORED or context.get_parameter_source(name) is not _COMMAND_LINE:
            continue
        value = context.params[name]
        for one in value if isinstance(value, tuple) else (value,):
            words += [option.opts[0]] if one is True else [option.opts[0], str(one)]
    return words


def warn_of_idle_environments(settings: Settings) -> None:
    """Warn if there are far more environments than exploration can keep busy."""
    config, fleet = settings.config, settings.fleet
    if config.commands.n_steps_per_iter is not None:
        return  # the number of episodes depends on their lengths
    useful = config.commands.n_episodes_per_iter * (config.lead + 1)
    environments = fleet.actors * (fleet.envs_per_actor or 1)
    if environments > 2 * useful:
        log.warning(
            "%d environments, but at most %d episodes can run at once (n_episodes_per_iter x "
            "(lead + 1)); the others are idle except during warm-up and evaluations",
            environments, useful,
        )  # fmt: skip


def _finish(run_dir: Path, status: Status, run_logs: Sequence[RunLog]) -> None:
    """Draw the learning curve, and print the result and the paths of all files."""
    final = status.final_evaluation
    lines = []
    if not status.problem:
        lines.append(("ended", status.ended_because))
    if final is not None:
        lines.append((
            "final evaluation",
            f"mean return {return_text(final.mean)} (95 % interval "
            f"{return_text(final.ci95_low)} to {return_text(final.ci95_high)}, "
            f"{final.episodes} episodes) after {status.env_steps:,} env steps, "
            f"{status.wall_s:.0f} s",
        ))  # fmt: skip
    if status.weights_version:
        weights = shown(run_dir / "weights.safetensors")
        lines.append(("weights", f"{weights} (version {status.weights_version})"))
    else:
        lines.append(("weights", "none: the warm-up spent the budget; raise --max-env-steps"))
    lines.append(("metrics", shown(run_dir / "metrics.csv")))
    try:
        curve = shown(draw_curve(run_dir, status.environment))
    except UdrlError as error:
        curve = str(error)
    lines.append(("learning curve", curve))
    for run_log in run_logs:
        if run_log.place:
            place = Path(run_log.place)
            lines.append((run_log.name, shown(place) if place.exists() else run_log.place))
    for label, text in lines:
        print_text(text, f"{label + ':':<18}")
