"""Studies that change one setting of UDRL: ``lead``, ``segments``, ``commands``.

The paper has none of them in figures. Section 2.3.3 leaves out all but trailing segments, section 6
calls for a study of other ways to choose exploratory commands, and lead is ours.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from udrl.config import flat
from udrl.strategies import STRATEGIES
from udrl_experiments.comparison import report_curves, report_wall_time
from udrl_experiments.jobs import Job
from udrl_experiments.protocol import StudyPlan, Task
from udrl_experiments.study import Study, StudyFolders

#: Env steps of a run at the small scale.
SMALL_STEPS = 1_000_000

LEADS = (0, 1, 2, 4, 8)


def lead(plan: StudyPlan, tasks: Sequence[Task]) -> Study:
    """Return the study of what asynchrony costs: against env steps, and against wall time."""
    variants = {f"lead {n}": {"lead": n} for n in LEADS}
    return _variants("lead", plan, tasks, variants, wall_time=True)


def segments(plan: StudyPlan, tasks: Sequence[Task]) -> Study:
    """Return the study of trailing segments against all, 0 <= t1 < t2 <= T (section 2.3.3)."""
    # A baseline's labels are of trailing segments only.
    variants = {name: {"segments": name, "baseline": "none"} for name in ("trailing", "all")}
    return _variants("segments", plan, tasks, variants)


def commands(plan: StudyPlan, tasks: Sequence[Task], strategies: Sequence[str]) -> Study:
    """Return the study of strategies for exploratory commands (sections 2.3.4 and 6).

    Args:
        plan: seeds and steps.
        tasks: on which.
        strategies: your own, ``package.module:Class``, besides those of :mod:`udrl.strategies`.
    """
    # The landers declare no greatest return, which `maximum` commands.
    names = (*(name for name in STRATEGIES if name != "maximum"), *strategies)
    return _variants("commands", plan, tasks, {name: {"command_strategy": name} for name in names})


def _variants(
    name: str,
    plan: StudyPlan,
    tasks: Sequence[Task],
    variants: Mapping[str, Mapping[str, Any]],
    *,
    wall_time: bool = False,
) -> Study:
    if plan.scale == "small" and plan.max_env_steps is None:
        plan = plan._replace(max_env_steps=SMALL_STEPS)
    jobs = {
        task: [
            Job(
                algorithm="UDRL",
                settings=flat(plan.config(task, seed, **changes)),
                max_env_steps=plan.steps(task),
                variant=variant,
            )
            for variant, changes in variants.items()
            for seed in plan.seeds_of_runs()
        ]
        for task in tasks
    }

    def report(folders: StudyFolders) -> str:
        said = []
        for task, runs in jobs.items():
            folder = folders.folder if len(jobs) == 1 else folders.folder / task.title
            folder.mkdir(exist_ok=True)
            here = folders._replace(folder=folder)
            title = f"{task.title}: {name}"
            said.append(report_curves(runs, task, title, here))
            if wall_time:
                report_wall_time(runs, task, title, here)
        return "\n".join(said)

    # A time that was measured beside other runs, or by other code, is not comparable.
    every = [job for runs in jobs.values() for job in runs]
    return Study(name, every, report, shares_runs=not wall_time)
