"""Figures 4 and 5: UDRL and other algorithms under one protocol (sections 3.2 to 3.4)."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

from udrl_experiments import figures
from udrl_experiments.jobs import Job, make_job
from udrl_experiments.protocol import TASKS, Participant, StudyPlan, Task
from udrl_experiments.records import PAPER, EvaluationRecord, agent_name
from udrl_experiments.runs import finished_run
from udrl_experiments.statistics import CurvePoint, Reached, curves, reached
from udrl_experiments.study import Study, StudyFolders
from udrl_experiments.tuned import tuned
from udrl_inspect.csv_tables import read, write

#: File names, without suffix, of the table and the figure for each x axis.
_FILES = {
    "env_steps": ("curves", "learning-curves"),
    "wall_s": ("curves-wall-time", "learning-curves-wall-time"),
}


def comparison(name: str, plan: StudyPlan, participants: Mapping[Participant, int | None]) -> Study:
    """Return the study ``lander`` (Figure 4a), ``takecover`` (4b) or ``sparse`` (5).

    Args:
        name: name of the task.
        plan: seeds and steps.
        participants: one line of the figure each, with the env steps of its runs. None: the plan's.
    """
    task = TASKS[name]
    jobs = [
        job(task, plan._replace(max_env_steps=steps or plan.max_env_steps), participant, seed)
        for participant, steps in participants.items()
        for seed in plan.seeds_of_runs()
    ]

    def report(folders: StudyFolders) -> str:
        summary = report_curves(jobs, task, task.title, folders)
        report_wall_time(jobs, task, task.title, folders)
        return summary

    return Study(name, jobs, report)


def job(task: Task, plan: StudyPlan, participant: Participant, seed: int) -> Job:
    """Return a participant's run on a task."""
    if participant == "UDRL" or participant == "UDRL-paper":
        paper = participant == "UDRL-paper"
        config = plan.config(task, seed, paper=paper)
        return make_job("UDRL", config, plan.steps(task), variant=PAPER if paper else "")
    chosen = tuned(participant, task.environment)
    return make_job(
        participant,
        plan.config(task, seed, defaults=chosen.networks),
        plan.steps(task, participant),
        hyperparameters=chosen.hyperparameters,
    )


def report_curves(jobs: Sequence[Job], task: Task, title: str, folders: StudyFolders) -> str:
    """Write the tables of evaluations, curves and reached thresholds, and draw the curves.

    Returns:
        One line for each curve, with its last point.
    """
    rows = [row for job in jobs for row in finished_run(job, folders.root).evaluations]
    points = curves(rows, jobs[0].config.evaluation.eval_every)
    write(folders.folder / "evaluations.csv", EvaluationRecord, rows)
    write(folders.folder / "curves.csv", CurvePoint, points)
    write(folders.folder / "reached.csv", Reached, reached(rows, task.thresholds))
    draw_curves(folders.folder, title, task)
    last = {(point.algorithm, point.variant): point for point in points}
    return "\n".join(
        f"{title}: {agent_name(*agent)}: mean return {end.mean:.1f} after {end.env_steps:,} "
        f"env steps, seeds: {end.seeds}, 95 % interval {end.low:.1f} to {end.high:.1f}"
        for agent, end in last.items()
    )


def report_wall_time(jobs: Sequence[Job], task: Task, title: str, folders: StudyFolders) -> None:
    """Write and draw the curves against wall time for runs on the most frequent kind of machine.

    The figure names the machine. Nothing is written if no run's machine is known.
    """
    runs = [finished_run(job, folders.root) for job in jobs]
    known = Counter(run.machine for run in runs if run.machine is not None)
    if not known:
        return
    ((machine, _),) = known.most_common(1)
    rows = [row for run in runs if run.machine == machine for row in run.evaluations]
    points = curves(rows, jobs[0].config.evaluation.eval_every)
    write(folders.folder / "curves-wall-time.csv", CurvePoint, points)
    draw_curves(folders.folder, f"{title}\nruns on: {machine}", task, "wall_s")


def draw_curves(
    folder: Path,
    title: str,
    task: Task,
    x: Literal["env_steps", "wall_s"] = "env_steps",
) -> None:
    """Draw the curves from their table."""
    table, picture = _FILES[x]
    points = read(folder / f"{table}.csv", CurvePoint)
    figure = figures.learning_curves(
        points, title, x=x, references=task.landmarks, lowest=task.lowest
    )
    figures.save(figure, folder / picture)
