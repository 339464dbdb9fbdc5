"""Studies of one setting of UDRL: ``lead``, ``segments``, ``commands``.

The paper has no figures of them. It trains on trailing segments only (section 2.3.3), and suggests
a study of other strategies for exploratory commands (section 6). ``lead`` is not in the paper.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from udrl.strategies import STRATEGIES
from udrl_experiments.comparison import report_curves, report_wall_time
from udrl_experiments.jobs import make_job
from udrl_experiments.protocol import StudyPlan, Task
from udrl_experiments.study import Study, StudyFolders

#: Env steps of a run at the small scale.
SMALL_STEPS = 1_000_000

LEADS = (0, 1, 2, 4, 8)


def lead_study(plan: StudyPlan, tasks: Sequence[Task]) -> Study:
    """Return the study of the cost of asynchrony, by env steps and by wall time."""
    variants = {f"lead {n}": {"lead": n} for n in LEADS}
    return _variants("lead", plan, tasks, variants, wall_time=True)


def segments_study(plan: StudyPlan, tasks: Sequence[Task]) -> Study:
    """Return the study of trailing and all segments, 0 <= t1 < t2 <= T (section 2.3.3)."""
    # A baseline allows trailing segments only.
    variants = {name: {"segments": name, "baseline": "none"} for name in ("trailing", "all")}
    return _variants("segments", plan, tasks, variants)


def commands_study(plan: StudyPlan, tasks: Sequence[Task], strategies: Sequence[str]) -> Study:
    """Return the study of strategies for exploratory commands (sections 2.3.4 and 6).

    Args:
        plan: seeds and steps.
        tasks: tasks to train on.
        strategies: additional strategies, ``package.module:Class``, to those of
            :mod:`udrl.strategies`.
    """
    # `maximum` commands the highest possible return, which the landers do not declare.
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
            make_job("UDRL", plan.config(task, seed, **changes), plan.steps(task), variant=variant)
            for variant, changes in variants.items()
            for seed in plan.seeds_of_runs()
        ]
        for task in tasks
    }

    def report(folders: StudyFolders) -> str:
        lines = []
        for task, runs in jobs.items():
            folder = folders.folder if len(jobs) == 1 else folders.folder / task.title
            folder.mkdir(exist_ok=True)
            here = folders._replace(folder=folder)
            title = f"{task.title}: {name}"
            lines.append(report_curves(runs, task, title, here))
            if wall_time:
                report_wall_time(runs, task, title, here)
        return "\n".join(lines)

    # Wall times are only comparable if the same study measured them.
    all_jobs = [job for runs in jobs.values() for job in runs]
    return Study(name, all_jobs, report, shares_runs=not wall_time)
