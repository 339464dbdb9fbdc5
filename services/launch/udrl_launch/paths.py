"""Paths relative to where a command was started; environments may change the directory."""

import os
import sys
from pathlib import Path

from udrl.errors import ConfigError

#: Working directory at the start of the command.
STARTED_IN = Path.cwd()

#: Environment variable with the parent's module search path, which a child appends to its own.
_MODULE_PATH = "UDRL_MODULE_PATH"


def shown(path: Path) -> str:
    """Return a path relative to where the command was started, if it is below that."""
    return str(path.relative_to(STARTED_IN) if path.is_relative_to(STARTED_IN) else path)


def new_run_dir(name: str) -> Path:
    """Create a directory for a new run in ``./runs``; a number is appended if the name is taken.

    Raises:
        ConfigError: it cannot be created.
    """
    runs, number = Path("runs").absolute(), 1
    try:
        runs.mkdir(exist_ok=True)
        while True:
            path = runs / (name if number == 1 else f"{name}-{number}")
            try:
                path.mkdir()
            except FileExistsError:
                number += 1
            else:
                return path
    except OSError as error:
        raise ConfigError(
            f"{runs}: {error.strerror}; choose another directory with --run-dir"
        ) from error


def extend_module_path() -> None:
    """Append the parent's module search path and the working directory to our own."""
    given = os.environ.get(_MODULE_PATH, "").split(os.pathsep)
    for folder in [*filter(None, given), str(STARTED_IN)]:
        if folder not in sys.path:
            sys.path.append(folder)


def child_environment_variables() -> dict[str, str]:
    """Return environment variables for a child, so that it finds the same modules."""
    found = [str(Path(folder).absolute()) for folder in sys.path]
    return os.environ | {_MODULE_PATH: os.pathsep.join(found)}
