"""Atomic writes: a reader sees either the old or the new content of a file."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a path to write to; at the end of the block, that file replaces ``path``.

    If the block raises, ``path`` is unchanged, and nothing else remains.

    Raises:
        OSError: the file cannot be renamed, e.g. because it was not written.
    """
    unfinished = path.with_name(f"{path.name}.part")
    try:
        yield unfinished
        unfinished.replace(path)
    except BaseException:
        with suppress(OSError):  # the first error counts
            unfinished.unlink(missing_ok=True)
        raise


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file.

    Raises:
        OSError: the file cannot be written; an existing file is unchanged.
    """
    with replacing(path) as unfinished:
        unfinished.write_bytes(content)
