"""Results and errors of commands.

Standard output is reserved for JSON if that was requested, even if environments print.
"""

import io
import os
import shutil
import sys
import textwrap
from typing import TYPE_CHECKING, TextIO

import click

from udrl_proto.text import as_json

if TYPE_CHECKING:
    from rich.table import Table

#: The original standard output, while :func:`keep_for_json` redirects it.
_kept: TextIO | None = None

#: Width of a table that is not printed to a terminal, in characters; texts of a status are shorter.
_FILE_WIDTH = 10_000


def keep_for_json() -> None:
    """Redirect standard output to standard error, except for :func:`print_json`.

    At the level of file descriptors, because simulators print from C too.
    """
    global _kept
    sys.stdout.flush()
    _kept = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)


def escape_unprintable() -> None:
    """Escape what standard output cannot encode, e.g. in names of files, as standard error does."""
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")


def print_json(value: object) -> None:
    """Print a value as a line of JSON."""
    click.echo(as_json(value).decode(), file=_kept)


def print_text(text: str, label: str = "") -> None:
    """Print text after a label. In a terminal, lines end between words."""
    width = shutil.get_terminal_size().columns
    if sys.stdout.isatty():
        text = textwrap.fill(
            text, max(width, len(label) + 20), initial_indent=label,
            subsequent_indent=" " * len(label), break_long_words=False, break_on_hyphens=False,
        )  # fmt: skip
        click.echo(text)
    else:
        click.echo(label + text)


def print_table(table: "Table") -> None:
    """Print a table.

    Unless standard output is a terminal, lines are not padded, and only wrapped at ``_FILE_WIDTH``.
    """
    from rich.console import Console  # it takes a tenth of a second to import

    if sys.stdout.isatty():
        Console().print(table)
        return
    text = io.StringIO()
    Console(file=text, width=_FILE_WIDTH).print(table)
    for line in text.getvalue().splitlines():
        click.echo(line.rstrip())


def print_error(error: object) -> None:
    """Print an error. All commands print their errors in this form."""
    click.echo(f"udrl: error: {error}", err=True)


def flush() -> None:
    """Flush all output; a closed pipe is not an error."""
    for stream in (sys.stdout, sys.stderr, _kept):
        if stream is not None:
            try:
                stream.flush()
            except BrokenPipeError:
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
