"""Studies: they run jobs, then write tables and figures."""

import importlib.util
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

from udrl.atomic_files import write_atomically
from udrl.errors import ConfigError, InvalidData
from udrl.file_remedies import file_remedy
from udrl.strategies import make_strategy
from udrl_experiments.jobs import Job
from udrl_experiments.processes import run_jobs
from udrl_experiments.protocol import TASKS
from udrl_experiments.provenance import provenance
from udrl_experiments.runs import copy_finished, require_runs


class StudyFolders(NamedTuple):
    """Folders of a study.

    Attributes:
        root: folder of the folder ``runs``, which most studies share.
        folder: the study's own folder, with tables, figures and ``study.json``.
    """

    root: Path
    folder: Path


class Study(NamedTuple):
    """One of the paper's experiments.

    Attributes:
        name: name of the study's folder and command.
        jobs: the runs that the study needs.
        report: writes tables and figures of the finished runs; returns a summary as text.
        run_jobs: runs the jobs; see :func:`udrl_experiments.processes.run_jobs`.
        needs: modules that the study needs, in addition to those of its runs.
        shares_runs: whether the study uses runs of other studies.
        possible: longer runs that the study may choose later. They are copied if they are finished
            elsewhere.
    """

    name: str
    jobs: Sequence[Job]
    report: Callable[[StudyFolders], str]
    run_jobs: Callable[[Sequence[Job], Path, int, threading.Event, Callable[[str], None]], None] = (
        run_jobs
    )
    needs: Sequence[str] = ()
    shares_runs: bool = True
    possible: Sequence[Job] = ()


def run_study(
    study: Study,
    root: Path,
    *,
    side_by_side: int,
    resume: bool,
    stop: threading.Event,
    echo: Callable[[str], None],
    runs_from: Sequence[Path] = (),
) -> str:
    """Run or resume a study, and return its summary.

    Args:
        study: the study.
        root: folder of all studies.
        side_by_side: number of simultaneous runs.
        resume: resume the study if the folder contains it.
        stop: ends the study early.
        echo: called with each line of progress.
        runs_from: other folders of studies, whose finished runs are copied.

    Raises:
        ConfigError: a module is missing, a run is too short for an evaluation, a strategy cannot be
            created, the folder is not writable, or it contains a study but ``resume`` is not set,
            or it contains runs that are not in this study, or one of ``runs_from`` has no runs.
        RunFailed: a run failed.
        Interrupted: ``stop`` was set.
    """
    _check(study)
    root = root.resolve()
    folder = root / study.name
    folders = StudyFolders(root if study.shares_runs else folder, folder)
    try:
        sources = [one if study.shares_runs else one / study.name for one in runs_from]
        require_runs(sources)
        _write_plan(study, folders, resume=resume)
        for jobs in (study.jobs, study.possible):
            copy_finished(jobs, folders.root, sources, echo)
        study.run_jobs(study.jobs, folders.root, side_by_side, stop, echo)
        summary = study.report(folders)
    except OSError as error:
        what_to_do = file_remedy(error, "choose a writable folder")
        raise ConfigError(f"--folder {root}: {error}; {what_to_do}") from error
    echo(f"tables and figures are in {folder}")
    return summary


def _check(study: Study) -> None:
    """Raise :class:`ConfigError` before the first run for errors that would occur later."""
    modules = dict.fromkeys(("matplotlib", *study.needs))
    for job in study.jobs:
        if job.algorithm != "UDRL":
            modules["stable_baselines3"] = None
        for task in TASKS.values():
            if task.environment == job.config.environment:
                modules[task.module] = None
    for module in modules:
        if importlib.util.find_spec(module) is None:
            raise ConfigError(
                f"the study {study.name} needs the module {module}, which is not installed; "
                f'install it with: pip install "udrl[box2d,doom,studies]"'
            )
    for job in study.jobs:
        every = job.config.evaluation.eval_every
        if job.max_env_steps < every:
            raise ConfigError(
                f"a run of {job.max_env_steps:,} env steps has no evaluation, because eval_every = "
                f"{every:,}; raise --max-env-steps or lower eval_every (--set eval_every=STEPS)"
            )
    strategies = {job.config.commands.command_strategy: job.config for job in study.jobs}
    for config in strategies.values():
        make_strategy(config)


def _write_plan(study: Study, folders: StudyFolders, *, resume: bool) -> None:
    """Write ``study.json``. A resumed study may have more runs or steps than before, not fewer."""
    file = folders.folder / "study.json"
    if file.exists():
        if not resume:
            raise ConfigError(
                f"{folders.folder} already contains a study; pass --resume to resume it, or choose "
                f"another --folder"
            )
        planned: dict[tuple[str, str], int] = {}
        for job in study.jobs:
            for variant in (job.variant, ""):  # earlier searches have runs without a variant
                key = job.name, variant
                planned[key] = max(planned.get(key, 0), job.max_env_steps)
        for job in read_study(file):
            if planned.get((job.name, job.variant), 0) < job.max_env_steps:
                raise ConfigError(
                    f"{folders.folder} contains a study with the run {job.described}, which is not "
                    f"in this one; pass the original options, or options for a larger study, or "
                    f"choose another --folder"
                )
    folders.folder.mkdir(parents=True, exist_ok=True)
    about = {"study": study.name, **provenance(), "runs": study.jobs}
    write_atomically(file, msgspec.json.format(msgspec.json.encode(about)) + b"\n")


def read_study(file: Path) -> list[Job]:
    """Return the jobs in a file ``study.json``.

    Raises:
        InvalidData: the file is not a valid ``study.json``.
    """

    class StudyFile(msgspec.Struct):
        runs: list[Job]

    try:
        return msgspec.json.decode(file.read_bytes(), type=StudyFile).runs
    except (OSError, msgspec.DecodeError, ConfigError) as error:
        raise InvalidData(f"{file}: {error}; delete it to start the study again") from error
