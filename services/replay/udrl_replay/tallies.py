"""How many rows each table has and the sum of their seals: what shows that a row is gone.

A seal shows that a row has become another one, not that one is missing or came from elsewhere. So
each table has a tally, which is kept with the facts and checked when the file is opened. Triggers
of the connection that writes keep it up to date, a row at a time; who else changes a table leaves
its tally as it was.
"""

import sqlite3
from typing import NamedTuple

from udrl_replay.schema import SEALED

#: The fact that holds them; it is the only row that no tally counts.
TALLIES = "tallies"

#: What stands for a row: its seal, and where that covers less, what else must be there.
_STANDS_FOR_ROW = dict.fromkeys(SEALED, "{row}seal") | {
    "facts": f"CASE {{row}}name WHEN '{TALLIES}' THEN NULL ELSE {{row}}seal END",
    "bodies": "seal({row}id)",
    "versions": "seal({row}seal, {row}weights IS NULL, {row}optimizer IS NULL)",
}


class Tally(NamedTuple):
    """The tally of a table.

    Attributes:
        rows: how many it has.
        total: the sum of what stands for them, as far as it fits 128 bits, in hexadecimal.
    """

    rows: int
    total: str


class Tallies:
    """The tallies of a file's tables, as one connection sees them.

    Args:
        db: the connection, with the function ``seal``.
    """

    def __init__(self, db: sqlite3.Connection) -> None:
        self._rows = dict.fromkeys(_STANDS_FOR_ROW, 0)
        self._totals = dict.fromkeys(_STANDS_FOR_ROW, 0)
        for table, expression in _STANDS_FOR_ROW.items():
            stand_ins = db.execute(f"SELECT {expression.format(row='')} FROM {table}")  # noqa: S608
            for (stand_in,) in stand_ins:
                self._note(table, stand_in, 1)

    def _note(self, table: str, stand_in: bytes | None, sign: int) -> None:
        if stand_in is not None:
            self._rows[table] += sign
            self._totals[table] += sign * int.from_bytes(stand_in, "big")

    def follow(self, db: sqlite3.Connection) -> None:
        """Note every row that a connection adds, changes or removes from now on."""
        db.create_function("note", 3, self._note)
        db.execute("PRAGMA recursive_triggers = ON")  # else no trigger sees what REPLACE removes
        for table, expression in _STANDS_FOR_ROW.items():
            gone = f"SELECT note('{table}', {expression.format(row='OLD.')}, -1);"
            new = f"SELECT note('{table}', {expression.format(row='NEW.')}, 1);"
            for event, noted in (("INSERT", new), ("DELETE", gone), ("UPDATE", gone + new)):
                db.execute(
                    f"CREATE TEMP TRIGGER {table}_{event} AFTER {event} ON main.{table} "
                    f"BEGIN {noted} END"
                )

    def held(self) -> dict[str, Tally]:
        """Return the tallies as they are now, by table."""
        return {
            table: Tally(rows, f"{self._totals[table] % 2**128:032x}")
            for table, rows in self._rows.items()
        }

    def put_back(self, tallies: dict[str, Tally]) -> None:
        """Return to what was held before a transaction that changed nothing in the end."""
        for table, tally in tallies.items():
            self._rows[table], self._totals[table] = tally.rows, int(tally.total, 16)
