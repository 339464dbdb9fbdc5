"""Tallies: the number of a table's rows and the sum of their seals, to detect missing rows.

A seal detects a changed row, but not one that is missing or copied from elsewhere. So each table
has a tally, which is stored as a fact and checked when the file is opened. Triggers of the writing
connection keep it up to date; changes by other programs do not update it.
"""

import sqlite3
from typing import NamedTuple

from udrl_replay.schema import SEALED

#: Name of the fact that holds the tallies, the only row that is not counted.
TALLIES = "tallies"

#: SQL expression of a row's summand, by table: its seal, extended where that covers too little.
_SUMMANDS = dict.fromkeys(SEALED, "{row}seal") | {
    "facts": f"CASE {{row}}name WHEN '{TALLIES}' THEN NULL ELSE {{row}}seal END",
    "bodies": "seal({row}id)",
    "versions": "seal({row}seal, {row}weights IS NULL, {row}optimizer IS NULL)",
}


class Tally(NamedTuple):
    """The tally of a table.

    Attributes:
        rows: number of its rows.
        total: sum of the rows' summands modulo 2^128, in hexadecimal.
    """

    rows: int
    total: str


class Tallies:
    """The tallies of a file's tables, as seen by one connection.

    Args:
        db: the connection, with the SQL function ``seal``.
    """

    def __init__(self, db: sqlite3.Connection) -> None:
        self._rows = dict.fromkeys(_SUMMANDS, 0)
        self._totals = dict.fromkeys(_SUMMANDS, 0)
        for table, expression in _SUMMANDS.items():
            summands = db.execute(f"SELECT {expression.format(row='')} FROM {table}")  # noqa: S608
            for (summand,) in summands:
                self._note(table, summand, 1)

    def _note(self, table: str, summand: bytes | None, sign: int) -> None:
        if summand is not None:
            self._rows[table] += sign
            self._totals[table] += sign * int.from_bytes(summand, "big")

    def follow(self, db: sqlite3.Connection) -> None:
        """Update the tallies on every change that a connection makes from now on."""
        db.create_function("note", 3, self._note)
        db.execute("PRAGMA recursive_triggers = ON")  # else REPLACE fires no delete triggers
        for table, expression in _SUMMANDS.items():
            gone = f"SELECT note('{table}', {expression.format(row='OLD.')}, -1);"
            new = f"SELECT note('{table}', {expression.format(row='NEW.')}, 1);"
            for event, noted in (("INSERT", new), ("DELETE", gone), ("UPDATE", gone + new)):
                db.execute(
                    f"CREATE TEMP TRIGGER {table}_{event} AFTER {event} ON main.{table} "
                    f"BEGIN {noted} END"
                )

    def held(self) -> dict[str, Tally]:
        """Return the current tallies, by table."""
        return {
            table: Tally(rows, f"{self._totals[table] % 2**128:032x}")
            for table, rows in self._rows.items()
        }

    def put_back(self, tallies: dict[str, Tally]) -> None:
        """Restore the tallies of before a transaction that was rolled back."""
        for table, tally in tallies.items():
            self._rows[table], self._totals[table] = tally.rows, int(tally.total, 16)
