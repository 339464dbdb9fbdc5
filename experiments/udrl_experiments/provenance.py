"""Provenance of results: versions of software, commit, kind of machine."""

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import msgspec

from udrl.version import __version__

#: Packages whose version may affect a result.
_PACKAGES = (
    "Box2D", "box2d-py", "eclipse-zenoh", "gymnasium", "numpy", "ray", "stable-baselines3", "torch",
    "vizdoom",
)  # fmt: skip


class Machine(msgspec.Struct, frozen=True):
    """A kind of machine.

    Attributes:
        processor: name of the processor.
        cores: number of cores that the process may use.
        system: operating system and architecture.
    """

    processor: str
    cores: int
    system: str

    def __str__(self) -> str:
        return f"{self.processor}, {self.cores} {'core' if self.cores == 1 else 'cores'}"


def provenance() -> dict[str, Any]:
    """Return commit, versions and kind of machine, for ``study.json`` and ``done.json``."""
    versions = {"udrl": __version__, "python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return {
        "commit": _commit(),
        "versions": versions,
        "machine": Machine(_processor(), len(os.sched_getaffinity(0)),
                           f"{platform.system()} {platform.machine()}"),
    }  # fmt: skip


def _commit() -> str:
    """Return the commit of the code; empty outside a Git checkout."""
    here = Path(__file__)

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(here.parent), *arguments]
        return subprocess.run(  # noqa: S603 - git, with our own arguments
            command, capture_output=True, text=True, check=True, timeout=10
        ).stdout.strip()

    try:
        # Fails if this is an installation in an ignored folder of another checkout.
        git("ls-files", "--error-unmatch", here.name)
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
