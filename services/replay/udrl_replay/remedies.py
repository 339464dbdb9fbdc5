"""Remedies if a file of a run cannot be read or written."""

import errno
import os
import sqlite3
from pathlib import Path

from udrl.errors import StoreError
from udrl.file_remedies import FREE_DISK, file_remedy

_FORBIDDEN = {errno.EACCES, errno.EPERM, errno.EROFS}

_CLOSE = "close the other program that uses the file"
_PERMIT = "make the file and its directory readable and writable"
_CHECK = "check the disk and the file"
#: By SQLite's primary result codes, what to do before the file can be used again.
_REMEDIES = {
    sqlite3.SQLITE_BUSY: _CLOSE,
    sqlite3.SQLITE_LOCKED: _CLOSE,
    sqlite3.SQLITE_PROTOCOL: _CLOSE,
    sqlite3.SQLITE_PERM: _PERMIT,
    sqlite3.SQLITE_READONLY: _PERMIT,
    sqlite3.SQLITE_CANTOPEN: _PERMIT,
    sqlite3.SQLITE_FULL: FREE_DISK,
    sqlite3.SQLITE_IOERR: "repair the disk, or raise its quota",
    sqlite3.SQLITE_NOMEM: "free some memory",
}


def remedy(error: OSError | sqlite3.Error, otherwise: str) -> str:
    """Return the remedy for too many open files or a full disk, else ``otherwise``."""
    if isinstance(error, OSError):
        return file_remedy(error, otherwise)
    if primary_code(error) == sqlite3.SQLITE_FULL:
        return FREE_DISK
    try:  # SQLite does not say why it could not open a file
        os.close(os.open(os.devnull, os.O_RDONLY))
    except OSError as probe:
        return file_remedy(probe, otherwise)
    return otherwise


def database_remedy(error: sqlite3.Error, *, read_only: bool) -> str:
    """Return the remedy if a run's file cannot be used.

    Args:
        error: the reason.
        read_only: whether the file was only to be read, e.g. by ``udrl status``.
    """
    code = primary_code(error)
    if code == sqlite3.SQLITE_TOOBIG:  # it would be as big again
        return (
            "a row has at most 1 GB; start a new run with a smaller network or shorter episodes, "
            "in another --run-dir"
        )
    first = remedy(error, _REMEDIES.get(code, _CHECK))
    return f"{first}, and {'try again' if read_only else 'restart with --resume'}"


def primary_code(error: sqlite3.Error) -> int:
    """Return SQLite's primary result code; 0: the error is not SQLite's."""
    return getattr(error, "sqlite_errorcode", 0) & 0xFF


def unwritable(path: Path, error: OSError) -> StoreError:
    """Return the error for a file beside the store."""
    what_to_do = remedy(error, _PERMIT if error.errno in _FORBIDDEN else _CHECK)
    return StoreError(
        f"{path} cannot be written: {error.strerror}; {what_to_do}, and restart with --resume; "
        f"nothing is lost"
    )
