"""Where a command was started: environments may change the working directory meanwhile."""

import os
import sys
from pathlib import Path

from udrl.errors import ConfigError

STARTED_IN = Path.cwd()

#: Tells a child where its parent looks for modules, after everything that the child knows itself.
_MODULE_PATH = "UDRL_MODULE_PATH"


def shown(path: Path) -> str:
    """Return a path as whoever started the command would write it."""
    return str(path.relative_to(STARTED_IN) if path.is_relative_to(STARTED_IN) else path)


def new_run_dir(name: str) -> Path:
    """Make a directory for a new run in ``./runs``, with a number behind its name if it is taken.

    Raises:
        ConfigError: it cannot be made.
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
        raise ConfigError(f"{runs}: {error}; name a directory with --run-dir") from error


def find_modules_of_the_user() -> None:
    """Let modules be found where the parent finds them and in the working directory, last."""
    given = os.environ.get(_MODULE_PATH, "").split(os.pathsep)
    for folder in [*filter(None, given), str(STARTED_IN)]:
        if folder not in sys.path:
            sys.path.append(folder)


def environment_of_children() -> dict[str, str]:
    """Return the environment variables of a child that finds the same modules."""
    found = [str(Path(folder).absolute()) for folder in sys.path]
    return os.environ | {_MODULE_PATH: os.pathsep.join(found)}
