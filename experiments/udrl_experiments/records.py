"""Tidy tables: a CSV file with a line for each observation, typed and checked when it is read."""

import csv
import io
import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

import msgspec

from udrl.errors import InvalidData

Row = TypeVar("Row", bound=msgspec.Struct)


class Evaluated(msgspec.Struct, frozen=True, kw_only=True):
    """An evaluation of one agent in training (section 3.2).

    Attributes:
        environment: Gymnasium's id.
        algorithm: ``UDRL``, ``DQN`` or ``A2C``.
        variant: what sets the agent apart within the study, e.g. ``lead 2``; may be empty.
        seed: of the run.
        env_steps: training steps before it.
        wall_s: seconds of training and evaluations before it, and its own.
        mean: of the episodes' returns.
        std: standard deviation of the sample of returns.
        episodes: how many.
    """

    environment: str
    algorithm: str
    variant: str
    seed: int
    env_steps: int
    wall_s: float
    mean: float
    std: float
    episodes: int


class Obtained(msgspec.Struct, frozen=True, kw_only=True):
    """What a trained agent obtained when it was told a return (section 3.5), over many episodes.

    Attributes:
        environment: Gymnasium's id.
        seed: of the run.
        env_steps: training steps of the agent.
        desired_return: what it was told.
        desired_horizon: what it was told, in steps.
        mean: of the episodes' returns.
        std: standard deviation of the sample of returns.
        episodes: how many.
    """

    environment: str
    seed: int
    env_steps: int
    desired_return: float
    desired_horizon: int
    mean: float
    std: float
    episodes: int


def put(path: Path, content: bytes) -> None:
    """Write a file; it is there whole or not at all."""
    aside = path.with_name(path.name + ".part")
    aside.write_bytes(content)
    os.replace(aside, path)


def write(path: Path, kind: type[Row], rows: Iterable[Row]) -> None:
    """Write rows, with the field names as the first line; the file is there whole or not at all."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(kind.__struct_fields__)
    writer.writerows(msgspec.structs.astuple(row) for row in rows)
    put(path, text.getvalue().encode())


def read(path: Path, kind: type[Row]) -> list[Row]:
    """Return the rows of a file.

    Raises:
        InvalidData: it is not such a table.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            table = csv.DictReader(file)
            rows = list(table)
        if tuple(table.fieldnames or ()) != kind.__struct_fields__:
            raise ValueError(f"its columns are {table.fieldnames}")  # noqa: TRY301
        # The text "" is none where no text is expected.
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
            f"delete it to have it made again"
        ) from error
    return read
