"""Standard output, reserved for JSON if that was requested, even if environments print."""

import os
import sys
from typing import TextIO

import click
import msgspec

_kept: TextIO | None = None


def keep_for_json() -> None:
    """Redirect standard output to standard error, except for :func:`print_json`.

    At the level of file descriptors, because simulators print from C too.
    """
    global _kept
    sys.stdout.flush()
    _kept = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)


def print_json(value: object) -> None:
    """Print a value as a line of JSON."""
    click.echo(msgspec.json.encode(value).decode(), file=_kept)


def flush() -> None:
    """Flush all output; a closed pipe is not an error."""
    for stream in (sys.stdout, sys.stderr, _kept):
        if stream is not None:
            try:
                stream.flush()
            except BrokenPipeError:
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
