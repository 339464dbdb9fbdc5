"""Jobs: the runs of a study. Each is a process; several run in parallel, and each can be resumed.

A run is a function of its settings, so studies share runs: jobs with equal settings are the same
run. A study uses the evaluations of a run up to the number of steps that it needs.
"""

import hashlib
import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import msgspec

from udrl.atomic_files import write_atomically
from udrl.config import Config, Configured, FlatSettings, flat
from udrl.errors import ConfigError, Interrupted, InvalidData, RunFailed
from udrl_experiments.protocol import Algorithm
from udrl_experiments.provenance import Machine
from udrl_experiments.records import EvaluationRecord, agent_name
from udrl_inspect.csv_tables import read

#: Message of an interrupted study.
INTERRUPTED = "stopped; resume with the same command and --resume"

#: Files with a run's settings and results. The others are its state, which is needed to extend the
#: run or to use its agent.
RECORDS = "job.json", "evaluations.csv", "done.json"

#: Begins the line of the log with the error of a failed run.
ERROR_PREFIX = "udrl: error: "

_PROGRAM = ("-m", "udrl_experiments.job")
_POLL_S = 0.2
#: Seconds between SIGTERM and SIGKILL.
_END_S = 10.0


class Job(Configured, msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A run that a study needs.

    Attributes:
        algorithm: the algorithm.
        settings: settings of UDRL. Other algorithms use its environment, networks and evaluations.
        hyperparameters: hyperparameters of other algorithms.
        exploration_steps: env steps over which DQN's exploration rate decreases; 0 for others.
        max_env_steps: length of the run.
        variant: label that distinguishes agents of a study; not part of the run's identity.
    """

    algorithm: Algorithm
    settings: FlatSettings = msgspec.field(name="config")
    hyperparameters: dict[str, bool | int | float | str] = {}
    exploration_steps: int = 0
    max_env_steps: int
    variant: str = ""

    @property
    def name(self) -> str:
        """Name of the run, with a hash of its settings: equal settings, equal names.

        Defaults are not hashed, so that a new setting does not change the names of kept runs.
        """
        config = self.config
        defaults = flat(Config(environment=config.environment))
        settings = {name: v for name, v in flat(config).items() if v != defaults[name]}
        identity = msgspec.json.encode(
            [self.algorithm, settings, self.hyperparameters, self.exploration_steps], order="sorted"
        )
        digest = hashlib.sha256(identity).hexdigest()[:12]
        environment = re.sub(r"[^a-z0-9]+", "-", self.config.environment.lower()).strip("-")
        return f"{self.algorithm.lower()}-{environment}-seed{self.config.seed}-{digest}"

    @property
    def described(self) -> str:
        """Description in one line."""
        return (
            f"{agent_name(self.algorithm, self.variant)}, {self.config.environment}, "
            f"seed {self.config.seed}: {self.max_env_steps:,} env steps"
        )

    def folder(self, root: Path) -> Path:
        """Return the folder of the run."""
        return root / "runs" / self.name

    def done(self, root: Path) -> bool:
        """Return whether the run is finished, with at least ``max_env_steps`` and an evaluation."""
        done = self._done(root)
        try:
            return (
                done is not None
                and done.max_env_steps >= self.max_env_steps
                and read_job(self.folder(root)).config == self.config
                and bool(self.evaluations(root))
            )
        except InvalidData:
            return False

    def machine(self, root: Path) -> Machine | None:
        """Return the kind of machine of the run, or of its last part; None if unknown."""
        done = self._done(root)
        return None if done is None else done.machine

    def _done(self, root: Path) -> "_DoneRecord | None":
        try:
            return msgspec.json.decode(
                (self.folder(root) / "done.json").read_bytes(), type=_DoneRecord, strict=False
            )
        except (OSError, msgspec.DecodeError):
            return None

    def evaluations(self, root: Path) -> list[EvaluationRecord]:
        """Return the run's evaluations up to ``max_env_steps``.

        An evaluation counts at the multiple of ``eval_every`` that it was due at.

        Raises:
            InvalidData: the table cannot be read.
        """
        every = self.config.evaluation.eval_every
        return [
            msgspec.structs.replace(row, variant=self.variant)
            for row in read(self.folder(root) / "evaluations.csv", EvaluationRecord)
            if row.env_steps // every * every <= self.max_env_steps
        ]


class _DoneRecord(msgspec.Struct, frozen=True):
    """The fields of ``done.json`` that are read."""

    max_env_steps: int
    machine: Machine | None = None


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


def run_jobs(
    jobs: Iterable[Job],
    root: Path,
    side_by_side: int,
    stop: threading.Event,
    echo: Callable[[str], None],
) -> None:
    """Run all jobs that are not done, several at a time. A failure ends the others.

    Args:
        jobs: the jobs. Those of the same run are merged (:func:`merge_jobs`).
        root: folder of the folder ``runs``.
        side_by_side: number of simultaneous runs.
        stop: ends the runs early. They can be resumed.
        echo: called with each line of progress.

    Raises:
        RunFailed: a run failed.
        Interrupted: ``stop`` was set.
    """
    waiting = [job for job in merge_jobs(jobs) if not job.done(root)][::-1]
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
                if not jobs_by_name[name].done(root):
                    raise RunFailed(
                        f"the run in {root / 'runs' / name} ended without an evaluation within "
                        f"{jobs_by_name[name].max_env_steps:,} env steps; raise --max-env-steps, "
                        f"or lower eval_every or n_warm_up_episodes (--set NAME=VALUE)"
                    )
    finally:
        _terminate(running.values())


def merge_jobs(jobs: Iterable[Job]) -> Sequence[Job]:
    """Return one job per run, the longest, in the order of first appearance."""
    merged: dict[str, Job] = {}
    for job in jobs:
        kept = merged.setdefault(job.name, job)
        if job.max_env_steps > kept.max_env_steps:
            merged[job.name] = job
    return list(merged.values())


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
        jobs: as for :func:`run_jobs`.
        root: folder of the folder ``runs``.
        sources: the other folders. The first with the finished run is used.
        echo: called with a line for each copied run.
    """
    for job in merge_jobs(jobs):
        finished = next((source for source in sources if job.done(source)), None)
        # A run with a state of its own is continued: the records would not be of this state.
        if finished is None or job.done(root) or has_state(job.folder(root)):
            continue
        echo(f"copied from {finished}: {job.described}")
        job.folder(root).mkdir(parents=True, exist_ok=True)
        for name in RECORDS:
            write_atomically(job.folder(root) / name, (job.folder(finished) / name).read_bytes())


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
