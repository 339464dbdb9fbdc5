"""Reading ``metrics.csv`` while the replay service appends to it."""

import csv
import os
from pathlib import Path
from typing import NamedTuple


class NewRows(NamedTuple):
    """Rows that were appended since the last call.

    Attributes:
        is_new_file: whether the file is read for the first time, or was rewritten by a restarted
            replay service.
        rows: values by column.
    """

    is_new_file: bool
    rows: list[dict[str, str]]


class MetricsReader:
    """Reads each row of a run's ``metrics.csv`` once, and again if the file is rewritten.

    Args:
        run_dir: the run's directory.
    """

    def __init__(self, run_dir: Path) -> None:
        self._path = run_dir / "metrics.csv"
        self._position = 0
        self._columns: list[str] = []
        self._file: os.stat_result | None = None

    def read(self) -> NewRows:
        """Return the rows since the last call."""
        try:
            with self._path.open("rb") as file:
                is_new = self._is_new(os.fstat(file.fileno()))
                if is_new:
                    self._position, self._columns = 0, []
                file.seek(self._position)
                text = file.read()
        except FileNotFoundError:  # the replay service has not written it yet
            return NewRows(is_new_file=False, rows=[])
        complete = text[: text.rfind(b"\n") + 1]
        self._position += len(complete)
        rows = []
        for row in csv.reader(complete.decode().splitlines()):
            if self._columns:
                rows.append(dict(zip(self._columns, row, strict=True)))
            else:
                self._columns = row
        return NewRows(is_new, rows)

    def _is_new(self, found: os.stat_result) -> bool:
        before, self._file = self._file, found
        return before is None or before.st_ino != found.st_ino or found.st_size < self._position
