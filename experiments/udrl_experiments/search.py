"""Random search over the paper's spaces or over one of your own (Appendix B)."""

import threading
from collections.abc import Callable, Sequence
from contextlib import closing
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from udrl.acting import EpisodeGenerator
from udrl.actions import Categorical
from udrl.automatic_settings import resolve_automatic
from udrl.config import AUTOMATIC, Config, build, change
from udrl.errors import ConfigError
from udrl.spaces import Image, Vector
from udrl_experiments.contest import Configuration, Contest, Scored, file_name
from udrl_experiments.jobs import Job, make_job
from udrl_experiments.protocol import EVAL_EVERY, PAPER_STEPS, Algorithm, StudyPlan, Task, shared
from udrl_experiments.ray_tune import run_jobs_on_ray
from udrl_experiments.search_space import SearchSpace, read_space, shipped_space
from udrl_experiments.study import Study, StudyFolders
from udrl_inspect.csv_tables import write
from udrl_launch.settings import gather

#: Configurations per algorithm and env steps per run at the small scale.
SMALL_CONFIGURATIONS = 8
SMALL_SEARCH_STEPS = 500_000


class Final(NamedTuple):
    """Longer runs of the best configurations, after the search.

    Attributes:
        configurations: number of configurations per environment and algorithm.
        max_env_steps: length of each run.
    """

    configurations: int
    max_env_steps: int


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
    contests: list[Contest] = []
    for task in dict.fromkeys(tasks):
        space = shipped_space(task.environment)
        chosen = _chosen(space, algorithms)
        plan.assigned(_drawn_settings(space, chosen))
        config = plan.config(task, 1, paper=True, eval_seeds="search")
        contests += _contests(plan, space, config, chosen, configurations, final)
    return _study("search", contests, final)


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
    contests = _contests(plan, space, config, chosen, configurations, final)
    return _study(f"search-{file_name(environment)}", contests, final)


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


def _contests(
    plan: StudyPlan,
    space: SearchSpace,
    config: Config,
    algorithms: Sequence[Algorithm],
    configurations: int | None,
    final: Final | None,
) -> list[Contest]:
    """Return a contest for each algorithm; for the arguments see :func:`search_tasks`."""
    paper = plan.scale == "paper"
    steps = plan.max_env_steps or (PAPER_STEPS if paper else SMALL_SEARCH_STEPS)
    if final is not None and final.max_env_steps <= steps:
        raise ConfigError(
            f"--final-env-steps {final.max_env_steps}: expected more than the {steps:,} of each "
            f"configuration before; raise it, or lower --max-env-steps"
        )
    n = configurations or (space.configurations if paper else None) or SMALL_CONFIGURATIONS

    def runs(algorithm: Algorithm, number: int, max_env_steps: int) -> list[Job]:
        return [
            _job(space, config, algorithm, number, seed, max_env_steps)
            for seed in plan.seeds_of_runs(space.seeds, 1)
        ]

    return [
        Contest(config, algorithm, [
            Configuration(
                number,
                space.draw(algorithm, number),
                runs(algorithm, number, steps),
                [] if final is None else runs(algorithm, number, final.max_env_steps),
            )
            for number in range(n)
        ])
        for algorithm in algorithms
    ]  # fmt: skip


def _study(name: str, contests: Sequence[Contest], final: Final | None) -> Study:
    """Return the study of a search."""

    def run_all(
        planned: Sequence[Job],
        root: Path,
        side_by_side: int,
        stop: threading.Event,
        echo: Callable[[str], None],
    ) -> None:
        run_jobs_on_ray(planned, root, side_by_side, stop, echo)
        if final is not None:
            best = [one for contest in contests for one in contest.best(final.configurations, root)]
            longer = [run for one in best for run in one.longer_runs]
            run_jobs_on_ray(longer, root, side_by_side, stop, echo)

    def report(folders: StudyFolders) -> str:
        # A finalist's score also counts evaluations of its longer run, so the finalists may differ
        # from those that were run. What was run is reported.
        rows = [contest.scores(folders.root) for contest in contests]
        write(folders.folder / "scores.csv", Scored, chain.from_iterable(rows))
        return "\n".join(
            contest.write_preset(folders.folder, scores)
            for contest, scores in zip(contests, rows, strict=True)
        )

    drawn = [one for contest in contests for one in contest.configurations]
    planned = [run for one in drawn for run in one.runs]
    possible = [run for one in drawn for run in one.longer_runs]
    return Study(name, planned, report, run_all, needs=("ray",), possible=possible)


def _job(
    space: SearchSpace,
    config: Config,
    algorithm: Algorithm,
    number: int,
    seed: int,
    max_env_steps: int,
) -> Job:
    """Return the run of a configuration with one seed."""
    drawn = space.draw(algorithm, number)
    networks = {name: drawn.pop(name) for name in space.networks}
    with space.errors_of("networks"):
        config = change(config, seed=seed, **networks)
    with space.errors_of(algorithm):
        if algorithm == "UDRL":
            config, drawn = change(config, **drawn), {}
        return make_job(
            algorithm, config, max_env_steps,
            hyperparameters=drawn, variant=f"configuration {number}",
        )  # fmt: skip
