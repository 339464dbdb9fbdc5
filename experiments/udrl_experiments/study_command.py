"""The command ``udrl study``."""

import logging
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import click
from click.shell_completion import CompletionItem

from udrl.errors import ConfigError
from udrl_experiments.comparison import comparison
from udrl_experiments.protocol import (
    DEFAULT_PARTICIPANTS,
    TASKS,
    Algorithm,
    Participant,
    StudyPlan,
    StudyScale,
    parse_seeds,
    tasks,
)
from udrl_experiments.search import Final, search_environment, search_tasks
from udrl_experiments.sensitivity import EPISODES, sensitivity_study
from udrl_experiments.study import Study, run_study
from udrl_experiments.study_progress import progress_table, studies
from udrl_experiments.variants import commands_study, lead_study, segments_study
from udrl_launch import completions
from udrl_launch.process import log_to_stderr, run_service
from udrl_launch.subcommands.options import FILE, STEPS

Decorated = TypeVar("Decorated", bound=Callable[..., Any])
Participants = tuple[tuple[Participant, int | None], ...]


class _Entry(click.ParamType):  # type: ignore[type-arg]
    """A participant of a comparison, alone or with its number of env steps: ``A2C=3M``."""

    name = "algorithm"
    _names = click.Choice(get_args(Participant))

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        return self._names.shell_complete(ctx, param, incomplete)

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[Participant, int | None]:
        name, separator, steps = str(value).partition("=")
        participant: Any = self._names.convert(name, param, ctx)
        return participant, STEPS.convert(steps, param, ctx) if separator else None


_FOLDER = click.option(
    "--folder", type=click.Path(path_type=Path, file_okay=False), default=Path("runs/studies"),
    show_default=True, metavar="DIR", help="Folder of all studies, which share their runs.",
)  # fmt: skip


@click.group()
def study() -> None:
    """Run one of the paper's experiments.

    Example: udrl study lander --seeds 1-3 --max-env-steps 3M
    """


def _options(command: Decorated) -> Decorated:
    """Add the options of all studies."""
    options = (
        click.option("--scale", type=click.Choice(get_args(StudyScale)), default="small",
                     show_default=True, help="Number of seeds and steps: small takes an evening on "
                     "two cores."),
        click.option("--seeds", metavar="SEEDS", help="Seeds of the runs, e.g. 1-20 or 1,2,7-9."),
        click.option("--max-env-steps", type=STEPS, help="Env steps per run, e.g. 500K or 10M."),
        click.option("--set", "assignments", multiple=True, metavar="NAME=VALUE",
                     help="Change a setting of all UDRL runs. May be repeated."),
        _FOLDER,
        click.option("--side-by-side", type=click.IntRange(1, 1024), metavar="N",
                     help="Runs at a time. Default: one for every two cores."),
        click.option("--resume", is_flag=True, help="Resume the study in the folder."),
    )  # fmt: skip
    for option in reversed(options):
        command = option(command)
    return command


def _runs_from(command: Decorated) -> Decorated:
    """Add the option ``--runs-from``."""
    return click.option(
        "--runs-from", multiple=True, metavar="DIR",
        type=click.Path(path_type=Path, file_okay=False),
        help="Use finished runs from another folder of studies too. May be repeated.",
    )(command)  # fmt: skip


def _tasks(*default: str) -> Callable[[Decorated], Decorated]:
    """Add the option ``--task``."""
    return click.option(
        "--task", "names", multiple=True, type=click.Choice(list(TASKS)), default=default,
        show_default=True, help="Task to run. May be repeated.",
    )  # fmt: skip


def _participants(command: Decorated) -> Decorated:
    """Add the option ``--algorithm`` of comparisons."""
    return click.option(
        "--algorithm", "participants", multiple=True, type=_Entry(),
        metavar=f"{'|'.join(get_args(Participant))}[=STEPS]",
        default=DEFAULT_PARTICIPANTS, show_default=True,
        help="Algorithm to run, e.g. A2C, or A2C=3M for another number of env steps. May be "
        "repeated. UDRL-paper is UDRL with the preset ENV-paper.",
    )(command)  # fmt: skip


def _run(
    make: Callable[[StudyPlan], Study],
    *,
    scale: StudyScale,
    seeds: str | None,
    max_env_steps: int | None,
    assignments: tuple[str, ...],
    folder: Path,
    side_by_side: int | None,
    resume: bool,
    runs_from: tuple[Path, ...] = (),
) -> int:
    log_to_stderr(logging.WARNING)
    plan = StudyPlan(
        scale,
        None if seeds is None else parse_seeds(seeds),
        max_env_steps,
        assignments,
    )
    planned = make(plan)
    cores = len(os.sched_getaffinity(0))

    def service(stop: threading.Event) -> None:
        summary = run_study(
            planned, folder, side_by_side=side_by_side or max(1, cores // 2), resume=resume,
            stop=stop, echo=lambda text: click.echo(text, err=True), runs_from=runs_from,
        )  # fmt: skip
        click.echo(summary)

    return run_service(service)


@study.command()
@click.argument("names", nargs=-1, metavar="STUDY...")
@_FOLDER
def show(names: tuple[str, ...], folder: Path) -> int:
    """Show the progress of studies, run by run.

    Shows all studies in the folder, or those named. Starts no runs.

    Example: udrl study show lander --folder runs/studies
    """
    for number, (name, runs) in enumerate(studies(folder, names)):
        lines = progress_table(name, runs)
        click.echo("\n".join(["", *lines] if number else lines))
    return 0


@study.command()
@_options
@_runs_from
@_participants
def lander(participants: Participants, **options: Any) -> int:
    """Figure 4a: UDRL, DQN and A2C on LunarLander.

    Example: udrl study lander --algorithm UDRL --algorithm UDRL-paper
    """
    return _run(lambda plan: comparison("lander", plan, dict(participants)), **options)


@study.command()
@_options
@_runs_from
@_participants
def takecover(participants: Participants, **options: Any) -> int:
    """Figure 4b: UDRL, DQN and A2C on TakeCover.

    Example: udrl study takecover --algorithm UDRL
    """
    return _run(lambda plan: comparison("takecover", plan, dict(participants)), **options)


@study.command()
@_options
@_runs_from
@_participants
def sparse(participants: Participants, **options: Any) -> int:
    """Figure 5: UDRL, DQN and A2C on LunarLanderSparse.

    Example: udrl study sparse --scale paper
    """
    return _run(lambda plan: comparison("sparse", plan, dict(participants)), **options)


@study.command()
@_options
@_tasks(*TASKS)
@click.option(
    "--algorithm",
    "participant",
    type=click.Choice(["UDRL", "UDRL-paper"]),
    default="UDRL",
    show_default=True,
    help="Agents of the preset ENV, or with UDRL-paper of ENV-paper.",
)
@click.option("--episodes", type=click.IntRange(1, 100_000), default=EPISODES, show_default=True,
              metavar="N", help="Episodes per desired return.")  # fmt: skip
def sensitivity(
    names: tuple[str, ...],
    participant: Literal["UDRL", "UDRL-paper"],
    episodes: int,
    **options: Any,
) -> int:
    """Figure 6: desired and obtained returns of trained agents.

    Example: udrl study sensitivity --task lander --task sparse
    """
    return _run(
        lambda plan: sensitivity_study(plan, tasks(names), participant, episodes), **options
    )


@study.command()
@_options
@_runs_from
@_tasks("lander")
def lead(names: tuple[str, ...], **options: Any) -> int:
    """Cost of asynchrony: lead 0, 1, 2, 4 and 8, by env steps and by wall time.

    Example: udrl study lead --side-by-side 1
    """
    return _run(lambda plan: lead_study(plan, tasks(names)), **options)


@study.command()
@_options
@_runs_from
@_tasks("lander", "sparse")
def segments(names: tuple[str, ...], **options: Any) -> int:
    """Trailing segments and segments of all lengths (section 2.3.3).

    Example: udrl study segments --task sparse
    """
    return _run(lambda plan: segments_study(plan, tasks(names)), **options)


@study.command()
@_options
@_runs_from
@_tasks("lander", "sparse")
@click.option("--strategy", "strategies", multiple=True, metavar="PACKAGE.MODULE:CLASS",
              help="Strategy of your own to add. May be repeated.")  # fmt: skip
def commands(names: tuple[str, ...], strategies: tuple[str, ...], **options: Any) -> int:
    """Strategies for exploratory commands (sections 2.3.4 and 6).

    Example: udrl study commands --strategy mine.strategies:Patient
    """
    return _run(lambda plan: commands_study(plan, tasks(names), strategies), **options)


@study.command()
@_options
@_runs_from
@click.argument("env", required=False, shell_complete=completions.environments)
@_tasks()
@click.option("--space", "file", type=FILE, metavar="FILE",
              help="Search ENV over the space in a TOML file.")  # fmt: skip
@click.option("--algorithm", "algorithms", multiple=True, type=click.Choice(get_args(Algorithm)),
              help="Algorithm to run. May be repeated. Default: all in the space.")  # fmt: skip
@click.option("--configurations", type=click.IntRange(1, 100_000), metavar="N",
              help="Configurations per algorithm. Default: 8, or the paper's number.")  # fmt: skip
@click.option("--finalists", type=click.IntRange(1, 100_000), metavar="N",
              help="Run the N best configurations again for --final-env-steps.")  # fmt: skip
@click.option("--final-env-steps", type=STEPS, metavar="STEPS",
              help="Env steps per run of the finalists, e.g. 3M.")  # fmt: skip
def search(
    env: str | None,
    file: Path | None,
    names: tuple[str, ...],
    algorithms: tuple[Algorithm, ...],
    configurations: int | None,
    finalists: int | None,
    final_env_steps: int | None,
    **options: Any,
) -> int:
    """Appendix B: random search with Ray Tune.

    Searches over the paper's spaces on its tasks (--task, lander by default), or on ENV over a
    space of your own (--space).

    Example: udrl study search CartPole-v1 --space mine.toml
    """
    final = None
    if finalists is not None and final_env_steps is not None:
        final = Final(finalists, final_env_steps)
    elif finalists is not None or final_env_steps is not None:
        raise ConfigError("--finalists N and --final-env-steps STEPS need each other")
    if (env is None) != (file is None):
        given, missing = ("--space", "ENV") if env is None else (f"ENV {env}", "--space FILE")
        raise ConfigError(f"{given} needs {missing}: udrl study search ENV --space FILE")
    if env is None or file is None:
        return _run(
            lambda plan: search_tasks(
                plan, tasks(names or ("lander",)), algorithms, configurations, final
            ),
            **options,
        )
    if names:
        raise ConfigError(
            f"--task {names[0]}: cannot be combined with ENV and --space; leave out one of them"
        )
    return _run(
        lambda plan: search_environment(plan, env, file, algorithms, configurations, final),
        **options,
    )
