"""Remedies if a file of a run cannot be written."""

import errno
import os
import sqlite3
from pathlib import Path

from udrl.errors import StoreError

_OUT_OF_FILES = {errno.EMFILE, errno.ENFILE}


def remedy(error: OSError | sqlite3.Error, otherwise: str) -> str:
    """Return the remedy for an error: ``otherwise``, unless there are too many open files."""
    if _is_out_of_files(error):
        return "raise the limit of open files, e.g. ulimit -n 4096"
    return otherwise


def _is_out_of_files(error: OSError | sqlite3.Error) -> bool:
    if isinstance(error, OSError):
        return error.errno in _OUT_OF_FILES
    try:  # SQLite does not say why it could not open a file
        os.close(os.open(os.devnull, os.O_RDONLY))
    except OSError as probe:
        return probe.errno in _OUT_OF_FILES
    return False


def unwritable(path: Path, error: OSError) -> StoreError:
    """Return the error for a file beside the store."""
    what_to_do = remedy(error, "free some disk space")
    return StoreError(
        f"{path} cannot be written: {error}; {what_to_do}, and restart with --resume; nothing is "
        f"lost"
    )
