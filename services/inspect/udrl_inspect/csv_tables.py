"""CSV files with typed rows, which are checked when they are read."""

import csv
import io
import math
from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

import msgspec

from udrl.atomic_files import write_atomically
from udrl.errors import InvalidData

AnyRow = TypeVar("AnyRow", bound=msgspec.Struct)


def write(path: Path, kind: type[AnyRow], rows: Iterable[AnyRow]) -> None:
    """Write rows below a header with the field names; the file is written atomically.

    Raises:
        OSError: the file cannot be written; an existing file is unchanged.
    """
    write_cells(path, kind.__struct_fields__, map(msgspec.structs.astuple, rows))


def write_cells(path: Path, columns: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """Write rows below a header; the file is written atomically.

    Raises:
        OSError: the file cannot be written; an existing file is unchanged.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    write_atomically(path, text.getvalue().encode())


def read(path: Path, kind: type[AnyRow]) -> list[AnyRow]:
    """Return the rows of a file.

    Args:
        path: the file.
        kind: type of the rows, whose fields are the columns.

    Raises:
        InvalidData: the file cannot be read, has other columns, or has an invalid value.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            table = csv.DictReader(file)
            rows = list(table)
        if tuple(table.fieldnames or ()) != kind.__struct_fields__:
            raise ValueError(f"its columns are {table.fieldnames}")  # noqa: TRY301
        # An empty cell is None unless it is text.
        words = {f.name for f in msgspec.structs.fields(kind) if f.type is str}
        read = [
            msgspec.convert(
                {name: value if value or name in words else None for name, value in row.items()},
                kind,
                strict=False,
            )
            for row in rows
        ]
        if not all(
            math.isfinite(value)
            for row in read
            for value in msgspec.structs.astuple(row)
            if isinstance(value, float)
        ):
            raise ValueError("a number is not finite")  # noqa: TRY301
    except (OSError, ValueError, csv.Error, msgspec.ValidationError) as error:
        raise InvalidData(
            f"{path}: {error}; expected a CSV file with {', '.join(kind.__struct_fields__)}; "
            f"delete it, and it will be written again"
        ) from error
    return read
