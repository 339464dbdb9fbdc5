"""The process of a study's run: ``python -m udrl_experiments.job FOLDER``."""

import contextlib
import csv
import fcntl
import logging
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import click
import msgspec

from udrl.atomic_files import write_atomically
from udrl.config import Budget
from udrl.errors import RunFailed, RunInUse, UdrlError
from udrl_experiments import baselines
from udrl_experiments.jobs import Job
from udrl_experiments.processes import ERROR_PREFIX
from udrl_experiments.provenance import provenance
from udrl_experiments.records import EvaluationRecord
from udrl_experiments.runs import has_state, read_job
from udrl_inspect.csv_tables import read, write
from udrl_launch.process import die_with_parent, log_to_stderr, run_service
from udrl_launch.settings import Fleet, Settings
from udrl_launch.training_run import run_training
from udrl_proto.reports import Status


@click.command()
@click.argument("folder", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--parent", type=int)
def main(folder: Path, parent: int | None) -> None:
    """Run the job in FOLDER/job.json, or resume it."""
    if parent is not None:
        die_with_parent(parent)
    log_to_stderr(logging.WARNING)
    try:
        job = read_job(folder)
        code = run_service(lambda stop: run_job(job, folder, stop))
    except UdrlError as error:
        click.echo(f"{ERROR_PREFIX}{error}", err=True)
        code = error.exit_code
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # as the command `udrl` does, for the same reason


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock the run. The kernel releases the lock when the process ends."""
    with (folder / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise RunInUse(
                f"another process is running {folder}; wait for it, or choose another --folder"
            ) from error
        yield


def run_job(job: Job, folder: Path, stop: threading.Event) -> None:
    """Run a job, and write ``evaluations.csv`` and ``done.json``.

    Raises:
        RunInUse: another process is running this job.
        UdrlError: the run failed.
        Interrupted: ``stop`` was set.
    """
    with _locked(folder):
        _run_job(job, folder, stop)


def _run_job(job: Job, folder: Path, stop: threading.Event) -> None:
    if not has_state(folder):
        # Only the records of a shorter run were kept. It cannot be extended, so it starts again.
        (folder / "done.json").unlink(missing_ok=True)
    if job.algorithm == "UDRL":
        settings = Settings(job.config, Budget(max_env_steps=job.max_env_steps), Fleet())
        status = run_training(settings, folder / "run", stop, resume=True)
        if status.problem:
            raise RunFailed(status.problem)
        table = folder / "evaluations.csv"
        # The final evaluation before an extension is only in the table. It is kept unless there is
        # now another one after as many env steps.
        kept = read(table, EvaluationRecord) if (folder / "done.json").exists() else []
        rows = {row.env_steps: row for row in (*kept, *_evaluations(job, folder / "run", status))}
        write(table, EvaluationRecord, (rows[steps] for steps in sorted(rows)))
    else:
        baselines.train_baseline(job, folder, stop)
    done = {"max_env_steps": job.max_env_steps, **provenance()}
    write_atomically(folder / "done.json", msgspec.json.format(msgspec.json.encode(done)) + b"\n")


def _evaluations(job: Job, run_dir: Path, status: Status) -> list[EvaluationRecord]:
    def row(env_steps: int, wall_s: float, mean: float, std: float) -> EvaluationRecord:
        return EvaluationRecord(
            environment=job.config.environment, algorithm=job.algorithm, variant="",
            seed=job.config.seed, env_steps=env_steps, wall_s=wall_s, mean=mean, std=std,
            episodes=job.config.evaluation.eval_episodes,
        )  # fmt: skip

    with (run_dir / "metrics.csv").open(newline="", encoding="utf-8") as file:
        rows = [
            row(int(r["eval_at_env_steps"]), float(r["wall_s"]), float(r["eval_mean"]),
                float(r["eval_std"]))
            for r in csv.DictReader(file) if r["eval_mean"]
        ]  # fmt: skip
    final = status.final_evaluation
    if final is not None:
        rows.append(row(final.env_steps, status.wall_s, final.mean, final.std))
    return rows


if __name__ == "__main__":
    main()
