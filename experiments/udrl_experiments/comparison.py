"""Figures 4 and 5: UDRL, DQN and A2C under one protocol (sections 3.2 to 3.4)."""

from collections.abc import Sequence

from udrl_experiments import figures
from udrl_experiments.jobs import Job
from udrl_experiments.protocol import TASKS, Algorithm, Plan, Task
from udrl_experiments.records import Evaluated, write
from udrl_experiments.statistics import CurvePoint, Reached, curves, reached
from udrl_experiments.study import Place, Study
from udrl_experiments.tuned import tuned

#: Mean returns whose first evaluation is looked for, in env steps and in seconds.
_THRESHOLDS = (100.0, 150.0, 200.0)


def comparison(name: str, plan: Plan, algorithms: Sequence[Algorithm]) -> Study:
    """Return the study ``lander`` (Figure 4a), ``takecover`` (4b) or ``sparse`` (5).

    Args:
        name: of the task.
        plan: seeds and steps.
        algorithms: who takes part.
    """
    task = TASKS[name]
    jobs = [
        job(task, plan, algorithm, seed)
        for algorithm in algorithms
        for seed in plan.seeds_of_runs()
    ]

    def report(place: Place) -> str:
        return report_curves(jobs, task.title, task.landmarks, place)

    return Study(name, jobs, report)


def job(task: Task, plan: Plan, algorithm: Algorithm, seed: int) -> Job:
    """Return an algorithm's run on a task."""
    return Job(
        algorithm=algorithm,
        config=plan.config(task, seed),
        hyperparameters={} if algorithm == "UDRL" else tuned(algorithm, task.environment),
        max_env_steps=plan.steps(task, algorithm),
    )


def report_curves(
    jobs: Sequence[Job], title: str, landmarks: dict[str, float], place: Place
) -> str:
    """Write all evaluations, their curves, and when returns were reached; draw the curves.

    Returns:
        A line for each curve: where it ends.
    """
    rows: list[Evaluated] = [row for job in jobs for row in job.evaluations(place.root)]
    points = curves(rows, jobs[0].config.eval_every)
    write(place.folder / "evaluations.csv", Evaluated, rows)
    write(place.folder / "curves.csv", CurvePoint, points)
    write(place.folder / "reached.csv", Reached, reached(rows, _THRESHOLDS))
    draw_curves(place, title, landmarks)
    last = {(point.algorithm, point.variant): point for point in points}
    return "\n".join(
        f"{title}: {' '.join(words).strip()}: mean return {end.mean:.1f} after {end.env_steps:,} "
        f"env steps, seeds: {end.seeds}, 95 % interval {end.low:.1f} to {end.high:.1f}"
        for words, end in last.items()
    )


def draw_curves(place: Place, title: str, landmarks: dict[str, float]) -> None:
    """Draw the curves from their table alone."""
    from udrl_experiments.records import read

    points = read(place.folder / "curves.csv", CurvePoint)
    picture = figures.learning_curves(points, title, references=landmarks)
    figures.save(picture, place.folder / "learning-curves")
