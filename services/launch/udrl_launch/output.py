"""Standard output, kept for JSON where it is asked for, whatever an environment prints."""

import os
import sys
from typing import TextIO

import click
import msgspec

_kept: TextIO | None = None


def keep_for_json() -> None:
    """Let all that is printed go to standard error, except what :func:`print_json` prints.

    Below Python, since simulators print from C too.
    """
    global _kept
    sys.stdout.flush()
    _kept = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)


def print_json(value: object) -> None:
    """Print a value as a line of JSON."""
    click.echo(msgspec.json.encode(value).decode(), file=_kept)


def flush() -> None:
    """Write out what was printed; that nobody reads on is no error."""
    for stream in (sys.stdout, sys.stderr, _kept):
        if stream is not None:
            try:
                stream.flush()
            except BrokenPipeError:
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
