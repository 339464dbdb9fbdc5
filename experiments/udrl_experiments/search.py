"""Random search over the paper's spaces or over one of your own (Appendix B)."""

import json
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import msgspec

from udrl.acting import EpisodeGenerator
from udrl.actions import Categorical
from udrl.atomic_files import write_atomically
from udrl.automatic_settings import resolve_automatic
from udrl.config import AUTOMATIC, Config, build, change, flat
from udrl.errors import ConfigError
from udrl.spaces import Image, Vector
from udrl_experiments.comparison import baseline
from udrl_experiments.jobs import Job
from udrl_experiments.protocol import (
    EVAL_EVERY,
    PAPER_STEPS,
    Algorithm,
    StudyPlan,
    Task,
    shared,
)
from udrl_experiments.ray_tune import run_jobs_on_ray
from udrl_experiments.search_space import SearchSpace, read_space, shipped_space
from udrl_experiments.statistics import score
from udrl_experiments.study import Study, StudyFolders
from udrl_experiments.tuned import complete
from udrl_inspect.csv_tables import write
from udrl_launch.settings import gather
from udrl_replay.creation import as_toml

#: Configurations per algorithm and env steps per run at the small scale.
SMALL_CONFIGURATIONS = 8
SMALL_SEARCH_STEPS = 500_000


class Scored(msgspec.Struct, frozen=True, kw_only=True):
    """The score of a configuration.

    Attributes:
        environment: Gymnasium's id.
        algorithm: the algorithm.
        configuration: number of the configuration, which determines its settings.
        seeds: number of runs.
        score: mean of the last 20 evaluations (Appendix B), mean over the runs; none if a run
            failed.
        settings: drawn settings, as JSON.
        final_score: the same of the longer runs in the final; none for other configurations.
    """

    environment: str
    algorithm: str
    configuration: int
    seeds: int
    score: float | None
    settings: str
    final_score: float | None = None


class Final(NamedTuple):
    """Longer runs of the best configurations, after the search.

    Attributes:
        configurations: number of configurations per environment and algorithm.
        max_env_steps: length of each run.
    """

    configurations: int
    max_env_steps: int


class Subject(NamedTuple):
    """An environment of a search.

    Attributes:
        space: the search space.
        algorithms: algorithms whose configurations are drawn.
        config: settings of a UDRL run, before a seed and drawn settings are set.
    """

    space: SearchSpace
    algorithms: tuple[Algorithm, ...]
    config: Config


def search_tasks(
    plan: StudyPlan,
    tasks: Sequence[Task],
    algorithms: Sequence[Algorithm] = (),
    configurations: int | None = None,
    final: Final | None = None,
) -> Study:
    """Return the study ``search`` of the paper's tasks, over the spaces of Appendix B.

    Args:
        plan: seeds and steps; at the paper's scale the number of seeds is the space's.
        tasks: tasks to search on.
        algorithms: algorithms to search; none: all in the space.
        configurations: number of configurations per algorithm; None: the scale's.
        final: longer runs of the best configurations; None: none.

    Raises:
        ConfigError: an algorithm is not in the space, or a setting is unknown or invalid.
    """
    subjects = []
    for task in tasks:
        space = shipped_space(task.environment)
        chosen = _chosen(space, algorithms)
        plan.assigned(_drawn_settings(space, chosen))
        config = plan.config(task, 1, paper=True, eval_seeds="search")
        subjects.append(Subject(space, chosen, config))
    return _study("search", plan, subjects, configurations, final)


def search_environment(
    plan: StudyPlan,
    environment: str,
    file: Path,
    algorithms: Sequence[Algorithm] = (),
    configurations: int | None = None,
    final: Final | None = None,
) -> Study:
    """Return the study ``search-ENV`` of any environment, over a space in a file.

    Settings that are not drawn are those of ``udrl train``: the preset named after the environment,
    or ``any``. Its ``auto`` settings are chosen once for all runs, with seed 1.

    Args:
        plan: as for :func:`search_tasks`; its assignments change the preset.
        environment: Gymnasium's id.
        file: file with the space (:mod:`udrl_experiments.search_space`).
        algorithms: as for :func:`search_tasks`.
        configurations: as for :func:`search_tasks`.
        final: as for :func:`search_tasks`.

    Raises:
        ConfigError: as for :func:`search_tasks`, or the file is not a valid space, or an algorithm
            does not support the environment.
        UnsupportedEnvironment: the environment cannot be created or is not supported.
        EnvironmentFault: the environment failed repeatedly.
    """
    space = read_space(environment, file)
    chosen = _chosen(space, algorithms)
    plan.assigned(_drawn_settings(space, chosen))
    own = {"seed": 1, "eval_seeds": "search", "eval_every": EVAL_EVERY}
    # A drawn setting must not be `auto`. Any of its values will do here.
    drawn = {
        name: values[0] for name, values in space.lists.get("UDRL", {}).items() if name in AUTOMATIC
    }
    with space.errors_of("UDRL"):
        build(Config, {"environment": environment} | drawn)
    settings = gather(environment, options=own | drawn, assignments=plan.assignments)
    config = resolve_automatic(settings.config, settings.automatic)
    others = [algorithm for algorithm in chosen if algorithm != "UDRL"]
    with closing(EpisodeGenerator(shared(config) if others else config, 1)) as generator:
        spec = generator.spec
    if others and not (
        isinstance(spec.action_space, Categorical)
        and isinstance(spec.observation_space, Vector | Image)
    ):
        raise ConfigError(
            f"{environment} with {', '.join(others)}: expected discrete actions and one vector or "
            f"image as observation; search with --algorithm UDRL"
        )
    subject = Subject(space, chosen, config)
    return _study(f"search-{_file_name(environment)}", plan, [subject], configurations, final)


def _chosen(space: SearchSpace, algorithms: Sequence[Algorithm]) -> tuple[Algorithm, ...]:
    for algorithm in algorithms:
        if algorithm not in space.lists:
            raise ConfigError(
                f"--algorithm {algorithm}: the space of {space.environment} has "
                f"{', '.join(space.lists)}; choose one of these, or search over a space of your "
                f"own: udrl study search ENV --space FILE"
            )
    return tuple(dict.fromkeys(algorithms)) or tuple(space.lists)


def _drawn_settings(space: SearchSpace, algorithms: Sequence[Algorithm]) -> set[str]:
    """Return the settings of UDRL that the search sets, so that ``--set`` must not."""
    drawn = space.lists["UDRL"].keys() if "UDRL" in algorithms else ()
    return {"environment", "seed", "eval_seeds", *space.networks, *drawn}


def _study(
    name: str,
    plan: StudyPlan,
    subjects: Sequence[Subject],
    configurations: int | None,
    final: Final | None,
) -> Study:
    """Return the study of a search; for the arguments see :func:`search_tasks`."""
    by_environment = {subject.space.environment: subject for subject in subjects}

    def runs_of(environment: str, algorithm: Algorithm, number: int, steps: StudyPlan) -> list[Job]:
        subject = by_environment[environment]
        seeds = _seeds(plan, subject.space)
        return [_job(steps, subject, algorithm, number, seed) for seed in seeds]

    jobs = {
        (environment, algorithm, number): runs_of(environment, algorithm, number, plan)
        for environment, subject in by_environment.items()
        for algorithm in subject.algorithms
        for number in range(_configurations(plan, subject.space, configurations))
    }

    longest = max((run.max_env_steps for runs in jobs.values() for run in runs), default=0)
    if final is not None and final.max_env_steps <= longest:
        raise ConfigError(
            f"--final-env-steps {final.max_env_steps}: expected more than the {longest:,} of each "
            f"configuration before; raise it, or lower --max-env-steps"
        )

    def in_final(environment: str, algorithm: Algorithm, number: int) -> list[Job]:
        if final is None:
            return []
        longer = plan._replace(max_env_steps=final.max_env_steps)
        return runs_of(environment, algorithm, number, longer)

    def run_all(
        planned: Sequence[Job],
        root: Path,
        side_by_side: int,
        stop: threading.Event,
        echo: Callable[[str], None],
    ) -> None:
        run_jobs_on_ray(planned, root, side_by_side, stop, echo)
        if final is not None and (best := _finalists(jobs, final.configurations, root)):
            longer = [run for key in best for run in in_final(*key)]
            run_jobs_on_ray(longer, root, side_by_side, stop, echo)

    def report(folders: StudyFolders) -> str:
        # A finalist's score also counts evaluations of its longer run, so the finalists may differ
        # from those that were run. What was run is reported.
        rows = [
            Scored(
                environment=environment,
                algorithm=algorithm,
                configuration=number,
                seeds=len(runs),
                score=_score(runs, folders.root),
                settings=json.dumps(by_environment[environment].space.draw(algorithm, number)),
                final_score=_score(in_final(environment, algorithm, number), folders.root),
            )
            for (environment, algorithm, number), runs in jobs.items()
        ]
        write(folders.folder / "scores.csv", Scored, rows)
        return "\n".join(
            _write_preset(folders.folder, rows, subject, algorithm)
            for subject in subjects
            for algorithm in subject.algorithms
        )

    planned = [run for runs in jobs.values() for run in runs]
    possible = [run for key in jobs for run in in_final(*key)]
    return Study(name, planned, report, run_all, needs=("ray",), possible=possible)


def _finalists(
    jobs: Mapping[tuple[str, Algorithm, int], Sequence[Job]], most: int, root: Path
) -> list[tuple[str, Algorithm, int]]:
    """Return the configurations with the best scores, ``most`` of each environment and algorithm.

    Args:
        jobs: runs of each configuration, ordered by environment and algorithm.
        most: number of configurations.
        root: folder of the runs.
    """
    found: list[tuple[str, Algorithm, int]] = []
    for _, keys in groupby(jobs, key=itemgetter(0, 1)):
        scores = {key: value for key in keys if (value := _score(jobs[key], root)) is not None}
        found += sorted(scores, key=lambda key: -scores[key])[:most]
    return found


def _seeds(plan: StudyPlan, space: SearchSpace) -> tuple[int, ...]:
    if plan.seeds is not None:
        return plan.seeds
    return tuple(range(1, 1 + (space.seeds if plan.scale == "paper" else 1)))


def _configurations(plan: StudyPlan, space: SearchSpace, given: int | None) -> int:
    if given is not None:
        return given
    return (space.configurations if plan.scale == "paper" else None) or SMALL_CONFIGURATIONS


def _job(plan: StudyPlan, subject: Subject, algorithm: Algorithm, number: int, seed: int) -> Job:
    """Return the run of a configuration with one seed."""
    steps = plan.max_env_steps or (PAPER_STEPS if plan.scale == "paper" else SMALL_SEARCH_STEPS)
    space, variant = subject.space, f"configuration {number}"
    drawn = space.draw(algorithm, number)
    networks = {name: drawn.pop(name) for name in space.networks}
    with space.errors_of("networks"):
        config = change(subject.config, seed=seed, **networks)
    with space.errors_of(algorithm):
        if algorithm == "UDRL":
            settings = flat(change(config, **drawn))
            return Job(algorithm=algorithm, settings=settings, max_env_steps=steps, variant=variant)
        complete(algorithm, drawn)
    return baseline(algorithm, shared(config), drawn, steps, variant)


def _score(runs: Sequence[Job], root: Path) -> float | None:
    """Return the mean score of a configuration's runs; None if there are none, or one failed."""
    if not runs or not all(run.done(root) for run in runs):
        return None
    return fmean(score([row.mean for row in run.evaluations(root)]) for run in runs)


def _write_preset(
    folder: Path, rows: Sequence[Scored], subject: Subject, algorithm: Algorithm
) -> str:
    """Write the best configuration to a TOML file, and return its text.

    UDRL's can be passed to ``udrl train --config``. It has all settings but the seeds, because the
    environment's preset may differ from the one of the search.
    """
    environment = subject.space.environment
    kind = (environment, algorithm)
    of_kind = [row for row in rows if (row.environment, row.algorithm) == kind]
    scored = [(row.final_score, row) for row in of_kind if row.final_score is not None] or [
        (row.score, row) for row in of_kind if row.score is not None
    ]
    if not scored:
        return f"# {algorithm}, {environment}: every configuration has a failed run"
    value, best = max(scored, key=lambda pair: pair[0])
    drawn = json.loads(best.settings)
    if algorithm == "UDRL":
        settings = flat(change(subject.config, **drawn))
        values = {name: v for name, v in settings.items() if name not in ("seed", "eval_seeds")}
    else:
        values = {"environment": environment, **drawn}
    text = f"# Configuration {best.configuration}: score {value:.1f}, seeds: {best.seeds}.\n"
    text += "".join(f"{name} = {as_toml(value)}\n" for name, value in values.items())
    path = folder / f"{algorithm.lower()}-{_file_name(environment)}.toml"
    write_atomically(path, text.encode())
    return f"# {path}\n{text}"


def _file_name(environment: str) -> str:
    """Return an environment's id as part of a file name."""
    return re.sub(r"[^\w.-]+", "-", environment)
