"""Figure 6: desired and obtained returns of trained agents (section 3.5)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from udrl.errors import StoreError
from udrl.obedience_statistics import correlation
from udrl_experiments import figures
from udrl_experiments.comparison import job
from udrl_experiments.jobs import Job
from udrl_experiments.protocol import StudyPlan, Task
from udrl_experiments.records import Obtained
from udrl_experiments.study import Study, StudyFolders
from udrl_inspect.agents import evaluate_all, evaluation_commands, load_agent
from udrl_inspect.csv_tables import read, write
from udrl_inspect.inspection import read_status

#: Episodes per desired return.
EPISODES = 100


def sensitivity_study(
    plan: StudyPlan,
    tasks: Sequence[Task],
    participant: Literal["UDRL", "UDRL-paper"] = "UDRL",
    episodes: int = EPISODES,
) -> Study:
    """Return the study ``sensitivity``, which uses the agents of Figures 4 and 5.

    Args:
        plan: seeds and steps.
        tasks: tasks of the agents.
        participant: which agents.
        episodes: episodes per desired return.
    """
    jobs = {
        task: [job(task, plan, participant, seed) for seed in plan.seeds_of_runs()]
        for task in tasks
    }

    def report(folders: StudyFolders) -> str:
        lines = []
        for task, runs in jobs.items():
            table = folders.folder / f"{task.title}.csv"
            rows = [
                row for run in runs for row in _evaluate_agent(run, folders.root, task, episodes)
            ]
            write(table, Obtained, rows)
            draw_sensitivity(table, f"{task.title}, {participant}")
            lines += _summary(task, rows)
        return "\n".join(lines)

    name = "sensitivity" + participant.removeprefix("UDRL")
    return Study(name, [run for runs in jobs.values() for run in runs], report)


def _summary(task: Task, rows: Sequence[Obtained]) -> list[str]:
    """Return one line per agent, with the correlation of desired and obtained returns."""
    lines = []
    for seed in dict.fromkeys(row.seed for row in rows):
        mine = [row for row in rows if row.seed == seed]
        desired, obtained = [row.desired_return for row in mine], [row.mean for row in mine]
        lines.append(
            f"{task.title}, seed {seed}: desired {min(desired):.0f} to {max(desired):.0f}, "
            f"obtained {min(obtained):.1f} to {max(obtained):.1f}, "
            f"correlation {correlation(desired, obtained):.2f}"
        )
    return lines


def _evaluate_agent(run: Job, root: Path, task: Task, episodes: int) -> list[Obtained]:
    """Evaluate the agent of a run, which another study may have trained for more steps."""
    run_dir = run.folder(root) / "run"
    try:
        agent, env_steps = load_agent(run_dir), read_status(run_dir).env_steps
    except StoreError as error:
        raise StoreError(
            f"{run.described}: the agent cannot be loaded: {error}; if only the records of the run "
            f"were kept, delete {run.folder(root)} to repeat it"
        ) from error
    commands = [
        evaluation_commands(agent, episodes=episodes, desired_return=desired)
        for desired in task.desired_returns
    ]
    return [
        Obtained(
            environment=agent.config.environment,
            seed=agent.config.seed,
            env_steps=env_steps,
            desired_return=result.desired_return,
            desired_horizon=result.desired_horizon,
            mean=result.evaluation.mean,
            std=result.evaluation.std,
            episodes=result.evaluation.episodes,
        )
        for result in evaluate_all(agent, commands)
    ]


def draw_sensitivity(table: Path, title: str) -> None:
    """Draw the figure from its table."""
    figures.save(figures.sensitivity_figure(read(table, Obtained), title), table.with_suffix(""))
