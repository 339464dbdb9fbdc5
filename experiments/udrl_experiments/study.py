"""What a study is, and how it is conducted: runs, tables, provenance, pictures."""

import importlib.metadata
import importlib.util
import os
import platform
import subprocess
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

import udrl
from udrl.errors import ConfigError, InvalidData
from udrl_experiments.jobs import Job, carry_out

#: Packages whose version may change a result.
_PACKAGES = ("eclipse-zenoh", "gymnasium", "numpy", "ray", "stable-baselines3", "torch", "vizdoom")


class Place(NamedTuple):
    """Where a study works.

    Attributes:
        root: of all studies, which share their runs.
        folder: this study's: tables, pictures, ``study.json``.
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
        carry_out: does the runs.
        needs: modules that must be there besides those that its runs need.
    """

    name: str
    jobs: Sequence[Job]
    report: Callable[[Place], str]
    carry_out: Callable[
        [Sequence[Job], Path, int, threading.Event, Callable[[str], None]], None
    ] = carry_out
    needs: Sequence[str] = ()


def conduct(
    study: Study,
    root: Path,
    *,
    side_by_side: int,
    resume: bool,
    stop: threading.Event,
    say: Callable[[str], None],
) -> str:
    """Conduct a study, or go on with it where it stopped, and return what came of it in words.

    Args:
        study: what to do.
        root: folder of all studies.
        side_by_side: runs at a time.
        resume: go on if the folder holds this study already.
        stop: ends it early.
        say: is told how it goes.

    Raises:
        ConfigError: a package is missing, or the folder holds a study already: another one, or
            ``resume`` is not set.
        RunFailed: a run failed.
        Interrupted: ``stop`` was set.
    """
    _require(study)
    place = Place(root, root / study.name)
    _open(study, place, resume=resume)
    study.carry_out(study.jobs, root, side_by_side, stop, say)
    said = study.report(place)
    say(f"tables and pictures are in {place.folder}")
    return said


def _require(study: Study) -> None:
    """Refuse before the first run what would be missed after the last one."""
    others = {job.algorithm for job in study.jobs} - {"UDRL"}
    for module in ("matplotlib", *(["stable_baselines3"] if others else []), *study.needs):
        if importlib.util.find_spec(module) is None:
            raise ConfigError(
                f"the study {study.name} needs the module {module}, which is not installed; "
                f'install it with: pip install "udrl[studies]"'
            )


def _open(study: Study, place: Place, *, resume: bool) -> None:
    """Write down what is about to be done; it may be more than what was begun, but not less."""
    file = place.folder / "study.json"
    if file.exists():
        if not resume:
            raise ConfigError(
                f"{place.folder} holds a study already; go on with it: --resume; or name another "
                f"--folder"
            )
        planned: dict[tuple[str, str], int] = {}
        for job in study.jobs:
            key = job.name, job.variant
            planned[key] = max(planned.get(key, 0), job.max_env_steps)
        for job in _begun(file):
            if planned.get((job.name, job.variant), 0) < job.max_env_steps:
                raise ConfigError(
                    f"{place.folder} holds a study with the run {job.described}, which is not in "
                    f"this one; give the options that it was begun with, or ones that ask for "
                    f"more, or name another --folder"
                )
    place.folder.mkdir(parents=True, exist_ok=True)
    about = {"study": study.name, **provenance(), "runs": study.jobs}
    aside = file.with_suffix(".part")
    aside.write_bytes(msgspec.json.format(msgspec.json.encode(about)) + b"\n")
    os.replace(aside, file)


def _begun(file: Path) -> list[Job]:
    class About(msgspec.Struct):
        runs: list[Job]

    try:
        return msgspec.json.decode(file.read_bytes(), type=About).runs
    except (OSError, msgspec.DecodeError) as error:
        raise InvalidData(f"{file}: {error}; delete it to begin the study anew") from error


def provenance() -> dict[str, Any]:
    """Return what software and what kind of machine results come from."""
    versions = {"udrl": udrl.__version__, "python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return {
        "commit": _commit(),
        "versions": versions,
        "machine": {"processor": _processor(), "cores": len(os.sched_getaffinity(0)),
                    "system": f"{platform.system()} {platform.machine()}"},
    }  # fmt: skip


def _commit() -> str:
    """Return the commit of the code, if Git keeps it here."""
    here = Path(__file__)

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(here.parent), *arguments]
        return subprocess.run(  # noqa: S603 - git, with our own arguments
            command, capture_output=True, text=True, check=True, timeout=10
        ).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", here.name)  # not a checkout that we are installed in
        changed = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "HEAD") + (" and changes" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return ""


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    named = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.processor())
