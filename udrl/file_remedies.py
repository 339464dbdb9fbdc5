"""Remedies if a file cannot be read or written."""

import errno

FREE_DISK = "free some disk space"
_RAISE_LIMIT = "raise the limit of open files, e.g. ulimit -n 4096"
#: Remedies for errors that choosing another file or directory would not fix.
_REMEDIES = {
    errno.ENOSPC: FREE_DISK,
    errno.EDQUOT: FREE_DISK,
    errno.EMFILE: _RAISE_LIMIT,
    errno.ENFILE: _RAISE_LIMIT,
}


def file_remedy(error: OSError, otherwise: str) -> str:
    """Return the remedy for a full disk or too many open files, else ``otherwise``."""
    return _REMEDIES.get(error.errno or 0, otherwise)
