"""Runs of studies on disk: their records and their state."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

from udrl.atomic_files import write_atomically
from udrl.errors import ConfigError, InvalidData
from udrl_experiments.jobs import Job, merge_jobs
from udrl_experiments.provenance import Machine
from udrl_experiments.records import EvaluationRecord
from udrl_inspect.csv_tables import read

#: Files with a run's settings and results. The others are its state, which is needed to extend the
#: run or to use its agent.
RECORDS = "job.json", "evaluations.csv", "done.json"


class FinishedRun(NamedTuple):
    """The results of a finished run.

    Attributes:
        evaluations: the evaluations up to the job's ``max_env_steps``, at least one.
        machine: the kind of machine of the run, or of its last part; None if unknown.
    """

    evaluations: Sequence[EvaluationRecord]
    machine: Machine | None


class _DoneRecord(msgspec.Struct, frozen=True):
    """The fields of ``done.json`` that are read."""

    max_env_steps: int
    machine: Machine | None = None


def finished_run(job: Job, root: Path) -> FinishedRun:
    """Return the results of a job.

    An evaluation counts at the multiple of ``eval_every`` that it was due at.

    Args:
        job: the job.
        root: folder of the folder ``runs``.

    Raises:
        InvalidData: the run has other settings, or fewer env steps than the job, or no evaluation
            within them, or its records cannot be read.
    """
    folder, every = job.folder(root), job.config.evaluation.eval_every
    try:
        done = msgspec.json.decode(
            (folder / "done.json").read_bytes(), type=_DoneRecord, strict=False
        )
        config = read_job(folder).config
        rows = [
            msgspec.structs.replace(row, variant=job.variant)
            for row in read(folder / "evaluations.csv", EvaluationRecord)
            if row.env_steps // every * every <= job.max_env_steps
        ]
    except (OSError, msgspec.DecodeError, InvalidData) as error:
        raise InvalidData(f"{folder} is not a finished run: {error}; resume the study") from error
    if done.max_env_steps < job.max_env_steps or config != job.config or not rows:
        raise InvalidData(
            f"{folder}: expected {job.described}, with an evaluation; found {len(rows)} "
            f"evaluations in {done.max_env_steps:,} env steps, or other settings; resume the study"
        )
    return FinishedRun(rows, done.machine)


def is_finished(job: Job, root: Path) -> bool:
    """Return whether :func:`finished_run` has results."""
    try:
        finished_run(job, root)
    except InvalidData:
        return False
    return True


def unfinished(jobs: Iterable[Job], root: Path) -> list[Job]:
    """Return the jobs that are not finished, one per run (:func:`merge_jobs`)."""
    return [job for job in merge_jobs(jobs) if not is_finished(job, root)]


def has_state(folder: Path) -> bool:
    """Return whether a run's folder has the state to continue it, not only its records."""
    return (folder / "run").exists() or (folder / "state.safetensors").exists()


def read_job(folder: Path) -> Job:
    """Return the job in a folder.

    Raises:
        InvalidData: ``job.json`` is missing or invalid.
    """
    try:
        return msgspec.json.decode((folder / "job.json").read_bytes(), type=Job)
    except (OSError, msgspec.DecodeError, ConfigError) as error:
        raise InvalidData(f"{folder / 'job.json'}: {error}; expected the job of a study") from error


def require_runs(sources: Iterable[Path]) -> None:
    """Require folders of studies, which contain the folder ``runs``.

    Raises:
        ConfigError: one is not such a folder.
    """
    for source in sources:
        if not (source / "runs").is_dir():
            raise ConfigError(
                f"--runs-from {source}: expected a folder of studies, which contains the folder "
                f"runs; name the --folder of another study"
            )


def copy_finished(
    jobs: Iterable[Job], root: Path, sources: Sequence[Path], echo: Callable[[str], None]
) -> None:
    """Copy the records of runs that are finished in other folders of studies but not in this one.

    Args:
        jobs: the jobs.
        root: folder of the folder ``runs``.
        sources: the other folders. The first with the finished run is used.
        echo: called with a line for each copied run.
    """
    for job in unfinished(jobs, root):
        finished = next((source for source in sources if is_finished(job, source)), None)
        # A run with a state of its own is continued: the records would not be of this state.
        if finished is None or has_state(job.folder(root)):
            continue
        echo(f"copied from {finished}: {job.described}")
        job.folder(root).mkdir(parents=True, exist_ok=True)
        for name in RECORDS:
            write_atomically(job.folder(root) / name, (job.folder(finished) / name).read_bytes())
