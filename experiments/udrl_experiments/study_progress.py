"""Progress of studies and their runs (``udrl study show``)."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Literal, NamedTuple

from udrl.errors import ConfigError, InvalidData, UdrlError
from udrl.evaluation import return_text
from udrl_experiments.jobs import Job, merge_jobs
from udrl_experiments.records import EvaluationRecord, agent_name
from udrl_experiments.runs import finished_run
from udrl_experiments.study import read_study
from udrl_inspect.csv_tables import read
from udrl_inspect.inspection import read_status
from udrl_show.display import duration

_HEAD = "state", "env steps", "wall time", "mean return", "run"


class JobProgress(NamedTuple):
    """Progress of a run.

    Attributes:
        job: the run.
        state: ``done``; ``unfinished``: in progress or interrupted; ``not begun``.
        env_steps: env steps so far, at most the job's.
        wall_s: seconds of training and evaluations so far.
        mean: mean return of the last evaluation; None: no evaluation yet.
    """

    job: Job
    state: Literal["done", "unfinished", "not begun"]
    env_steps: int = 0
    wall_s: float = 0.0
    mean: float | None = None


def job_progress(job: Job, root: Path) -> JobProgress:
    """Return the progress of a run. Only reads files.

    Args:
        job: the run.
        root: folder of the folder ``runs``.
    """
    folder = job.folder(root)
    with suppress(InvalidData):  # not finished
        last = finished_run(job, root).evaluations[-1]
        steps = min(last.env_steps, job.max_env_steps)
        return JobProgress(job, "done", steps, last.wall_s, last.mean)
    try:
        if job.algorithm == "UDRL":
            status = read_status(folder / "run")
            mean = None if status.evaluation is None else status.evaluation.mean
            return JobProgress(job, "unfinished", status.env_steps, status.wall_s, mean)
        last = read(folder / "evaluations.csv", EvaluationRecord)[-1]
        return JobProgress(job, "unfinished", last.env_steps, last.wall_s, last.mean)
    except (UdrlError, IndexError):  # no store or table yet
        return JobProgress(job, "unfinished" if folder.exists() else "not begun")


def studies(folder: Path, names: Sequence[str]) -> Iterator[tuple[str, list[JobProgress]]]:
    """Yield the studies in a folder, each with its runs.

    Args:
        folder: folder of all studies.
        names: names of studies; none: all studies in the folder.

    Raises:
        ConfigError: the folder does not contain the study.
        InvalidData: a study cannot be read.
    """
    found = sorted(file.parent.name for file in folder.glob("*/study.json"))
    if not found:
        raise ConfigError(f"{folder} contains no study; start one, e.g. udrl study lander")
    for name in names:
        if name not in found:
            raise ConfigError(
                f"{folder} contains no study {name}; expected one of {', '.join(found)}"
            )
    for name in names or found:
        own = folder / name / "runs"  # if the study does not share its runs
        root = own.parent if own.is_dir() else folder
        runs = merge_jobs(read_study(folder / name / "study.json"))
        yield name, [job_progress(job, root) for job in runs]


def progress_table(name: str, runs: Sequence[JobProgress]) -> list[str]:
    """Return the lines of a study: a summary, then one line per run."""
    done = [run for run in runs if run.state == "done"]
    steps, planned = sum(run.env_steps for run in runs), sum(run.job.max_env_steps for run in runs)
    rows = [_HEAD, *map(_cells, runs)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        f"{name}: {len(done)} of {len(runs)} runs done, {steps:,} of {planned:,} env steps, "
        f"wall time {duration(sum(run.wall_s for run in runs))}",
        *(
            "  ".join(cell.ljust(n) for cell, n in zip(row, widths, strict=True)).rstrip()
            for row in rows
        ),
    ]


def _cells(run: JobProgress) -> tuple[str, ...]:
    job = run.job
    agent = agent_name(job.algorithm, job.variant)
    return (
        run.state,
        f"{run.env_steps:,} of {job.max_env_steps:,}",
        duration(run.wall_s) if run.wall_s else "",
        "" if run.mean is None else return_text(run.mean),
        f"{agent} {job.config.environment} seed {job.config.seed}",
    )
