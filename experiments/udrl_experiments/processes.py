"""Processes of runs: one per run. Several run in parallel, and each run can be resumed."""

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable
from pathlib import Path

import msgspec

from udrl.atomic_files import write_atomically
from udrl.errors import Interrupted, RunFailed
from udrl_experiments.jobs import Job
from udrl_experiments.runs import is_finished, unfinished

#: Message of an interrupted study.
INTERRUPTED = "stopped; resume with the same command and --resume"

#: Begins the line of the log with the error of a failed run.
ERROR_PREFIX = "udrl: error: "

_PROGRAM = ("-m", "udrl_experiments.job")
_POLL_S = 0.2
#: Seconds between SIGTERM and SIGKILL.
_END_S = 10.0


def run_jobs(
    jobs: Iterable[Job],
    root: Path,
    side_by_side: int,
    stop: threading.Event,
    echo: Callable[[str], None],
) -> None:
    """Run all jobs that are not finished, several at a time. A failure ends the others.

    Args:
        jobs: the jobs. Those of the same run are merged.
        root: folder of the folder ``runs``.
        side_by_side: number of simultaneous runs.
        stop: ends the runs early. They can be resumed.
        echo: called with each line of progress.

    Raises:
        RunFailed: a run failed.
        Interrupted: ``stop`` was set.
    """
    waiting = unfinished(jobs, root)[::-1]
    jobs_by_name = {job.name: job for job in waiting}
    n, running = len(waiting), dict[str, subprocess.Popen[bytes]]()
    log_sizes: dict[str, int] = {}  # before this process of the run
    try:
        while waiting or running:
            while waiting and len(running) < side_by_side:
                job = waiting.pop()
                echo(f"[{n - len(waiting)}/{n}] {job.described}")
                running[job.name], log_sizes[job.name] = _start(job, root)
            if stop.wait(_POLL_S):
                echo(INTERRUPTED)  # now, because the runs may take seconds to end
                raise Interrupted(INTERRUPTED)
            for name, process in list(running.items()):
                code = process.poll()
                if code is None:
                    continue
                del running[name]
                if code != 0:
                    log = (root / "runs" / name / "log.txt").read_bytes()
                    raise _failure(root / "runs" / name, code, log[log_sizes[name] :])
                if not is_finished(jobs_by_name[name], root):
                    raise RunFailed(
                        f"the run in {root / 'runs' / name} ended without an evaluation within "
                        f"{jobs_by_name[name].max_env_steps:,} env steps; raise --max-env-steps, "
                        f"or lower eval_every or n_warm_up_episodes (--set NAME=VALUE)"
                    )
    finally:
        _terminate(running.values())


def _start(job: Job, root: Path) -> tuple[subprocess.Popen[bytes], int]:
    """Start a process for a run; return it, and the size of the log so far in bytes."""
    folder = job.folder(root)
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / "job.json", msgspec.json.format(msgspec.json.encode(job)))
    with (folder / "log.txt").open("ab") as output:
        size = output.tell()
        process = subprocess.Popen(  # noqa: S603 - our own program
            [sys.executable, *_PROGRAM, str(folder), "--parent", str(os.getpid())],
            stdin=subprocess.DEVNULL, stdout=output, stderr=output, process_group=0,
        )  # fmt: skip
    return process, size


def _failure(folder: Path, code: int, output: bytes) -> RunFailed:
    """Return the error of a failed run, in one line.

    Args:
        folder: folder of the run.
        code: exit code of its process.
        output: what the process wrote to the log.
    """
    log = folder / "log.txt"
    if code < 0:
        return RunFailed(f"the run in {folder} was killed by signal {-code}; see {log}")
    lines = output.decode(errors="replace").split("\n")
    # If there is no error of udrl, the last line is that of a traceback: the exception's message.
    errors = [line for line in lines if line.startswith(ERROR_PREFIX)]
    causes = errors or [line for line in lines if line.strip()] or ["no output"]
    cause = causes[-1].removeprefix(ERROR_PREFIX)
    failure = RunFailed(f"the run in {folder} failed with exit code {code}: {cause}; see {log}")
    failure.exit_code = code
    return failure


def _terminate(processes: Iterable[subprocess.Popen[bytes]]) -> None:
    for process in processes:
        process.terminate()
    for process in processes:
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
