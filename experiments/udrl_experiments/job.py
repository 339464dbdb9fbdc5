"""One run of a study in a process of its own: ``python -m udrl_experiments.job FOLDER``."""

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

from udrl.config import Budget
from udrl.errors import RunFailed, RunInUse, UdrlError
from udrl_experiments import baselines
from udrl_experiments.jobs import ERROR_PREFIX, Job, read_job
from udrl_experiments.provenance import provenance
from udrl_experiments.records import EvaluationRecord
from udrl_inspect.csv_tables import put, read, write
from udrl_launch.process import die_with_parent, log_to_stderr, run_service
from udrl_launch.settings import Fleet, Settings
from udrl_launch.training_run import train
from udrl_proto.reports import Status


@click.command()
@click.argument("folder", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--parent", type=int)
def main(folder: Path, parent: int | None) -> None:
    """Do the run that FOLDER/job.json describes, or go on with it."""
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
    os._exit(code)  # as the command `udrl` ends, for the same reason


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep other processes from the run; the kernel lets go of it when this one ends."""
    with (folder / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise RunInUse(
                f"another study works on the run in {folder}; wait for it, or name another --folder"
            ) from error
        yield


def run_job(job: Job, folder: Path, stop: threading.Event) -> None:
    """Do the run and leave its evaluations and a note that it is done.

    Raises:
        RunInUse: somebody does it already.
        UdrlError: it failed.
        Interrupted: ``stop`` was set.
    """
    with _locked(folder):
        _run_job(job, folder, stop)


def _run_job(job: Job, folder: Path, stop: threading.Event) -> None:
    if not (folder / "run").exists() and not (folder / "state.safetensors").exists():
        # If only the records of a shorter run were kept, it begins anew.
        (folder / "done.json").unlink(missing_ok=True)
    if job.algorithm == "UDRL":
        settings = Settings(job.config, Budget(max_env_steps=job.max_env_steps), Fleet())
        status = train(settings, folder / "run", stop, resume=True)
        if status.problem:
            raise RunFailed(status.problem)
        table = folder / "evaluations.csv"
        # What closed a run that goes on now was an evaluation too, and stays.
        rows = {row.env_steps: row for row in _evaluations(job, folder / "run", status)}
        if (folder / "done.json").exists():
            rows |= {row.env_steps: row for row in read(table, EvaluationRecord)}
        write(table, EvaluationRecord, (rows[steps] for steps in sorted(rows)))
    else:
        baselines.run(
            baselines.Baseline(
                algorithm=job.algorithm, config=job.config, hyperparameters=job.hyperparameters
            ),
            job.max_env_steps,
            folder,
            stop=stop,
            exploration_steps=job.exploration_steps or None,
        )
    done = {"max_env_steps": job.max_env_steps, **provenance()}
    put(folder / "done.json", msgspec.json.format(msgspec.json.encode(done)) + b"\n")


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
    closing = status.closing_evaluation
    if closing is not None:
        rows.append(row(closing.env_steps, status.wall_s, closing.mean, closing.std))
    return rows


if __name__ == "__main__":
    main()
