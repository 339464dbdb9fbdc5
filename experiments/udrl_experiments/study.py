"""What a study is, and how it is conducted: runs, tables, provenance, pictures."""

import importlib.util
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

from udrl.errors import ConfigError, InvalidData
from udrl.strategies import make_strategy
from udrl_experiments.jobs import Job, copy_finished, run_jobs
from udrl_experiments.protocol import TASKS
from udrl_experiments.provenance import provenance
from udrl_inspect.csv_tables import put


class StudyFolders(NamedTuple):
    """Where a study works.

    Attributes:
        root: where its runs live, in ``runs``; most studies share them.
        folder: its own: tables, pictures, ``study.json``.
    """

    root: Path
    folder: Path


class Study(NamedTuple):
    """One of the paper's experiments.

    Attributes:
        name: of its folder, and of the command.
        jobs: the runs that it needs.
        report: makes tables and pictures of them, once they are done; returns what came of them in
            words.
        run_jobs: does the runs.
        needs: modules that must be there besides those that its runs need.
        shares_runs: whether runs that other studies have made will do.
    """

    name: str
    jobs: Sequence[Job]
    report: Callable[[StudyFolders], str]
    run_jobs: Callable[[Sequence[Job], Path, int, threading.Event, Callable[[str], None]], None] = (
        run_jobs
    )
    needs: Sequence[str] = ()
    shares_runs: bool = True


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
    """Conduct a study, or go on with it where it stopped, and return what came of it in words.

    Args:
        study: what to do.
        root: folder of all studies.
        side_by_side: runs at a time.
        resume: go on if the folder holds this study already.
        stop: ends it early.
        echo: is told how it goes.
        runs_from: folders of other studies; runs that are done there are not made again.

    Raises:
        ConfigError: a package is missing, a strategy cannot be made, the folder cannot be written,
            or it holds a study already: another one, or ``resume`` is not set. Or one of
            ``runs_from`` has no runs.
        RunFailed: a run failed.
        Interrupted: ``stop`` was set.
    """
    _check(study)
    root = root.resolve()
    folder = root / study.name
    folders = StudyFolders(root if study.shares_runs else folder, folder)
    try:
        sources = [one if study.shares_runs else one / study.name for one in runs_from]
        copy_finished(study.jobs, folders.root, sources, echo)
        _write_plan(study, folders, resume=resume)
        study.run_jobs(study.jobs, folders.root, side_by_side, stop, echo)
        said = study.report(folders)
    except OSError as error:
        raise ConfigError(
            f"--folder {root}: {error}; name a folder that you may write, on a disk with room"
        ) from error
    echo(f"tables and pictures are in {folder}")
    return said


def _check(study: Study) -> None:
    """Refuse before the first run what would be missed after the last one."""
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
    """Write down what is about to be done; it may be more than what was begun, but not less."""
    file = folders.folder / "study.json"
    if file.exists():
        if not resume:
            raise ConfigError(
                f"{folders.folder} holds a study already; resume it with --resume; or name another "
                f"--folder"
            )
        planned: dict[tuple[str, str], int] = {}
        for job in study.jobs:
            for variant in (job.variant, ""):  # earlier searches have runs without a variant
                key = job.name, variant
                planned[key] = max(planned.get(key, 0), job.max_env_steps)
        for job in read_study(file):
            if planned.get((job.name, job.variant), 0) < job.max_env_steps:
                raise ConfigError(
                    f"{folders.folder} holds a study with the run {job.described}, which is not in "
                    f"this one; give the options that it was begun with, or ones that ask for "
                    f"more, or name another --folder"
                )
    folders.folder.mkdir(parents=True, exist_ok=True)
    about = {"study": study.name, **provenance(), "runs": study.jobs}
    put(file, msgspec.json.format(msgspec.json.encode(about)) + b"\n")


def read_study(file: Path) -> list[Job]:
    """Return the runs of the study in a file ``study.json``.

    Raises:
        InvalidData: it is something else.
    """

    class About(msgspec.Struct):
        runs: list[Job]

    try:
        return msgspec.json.decode(file.read_bytes(), type=About).runs
    except (OSError, msgspec.DecodeError, ConfigError) as error:
        raise InvalidData(f"{file}: {error}; delete it to begin the study anew") from error
