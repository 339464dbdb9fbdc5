"""The tables of a run's file, and the seals of their rows.

SQLite detects a malformed file, but not a changed value. So each row has a seal: a digest of its
columns, except those with their own checksum. All columns are documented in
``docs/operations-reference.md``.
"""

import hashlib
from collections.abc import Iterable

import msgspec
from msgspec import inspect

from udrl_proto.reports import IterationStatus

SCHEMA = 7


def _declared(kind: type[msgspec.Struct]) -> str:
    """Return the SQL columns for the fields of a message of integers and floats."""
    columns = []
    info = inspect.type_info(kind)
    assert isinstance(info, inspect.StructType)
    for field in info.fields:
        types = field.type.types if isinstance(field.type, inspect.UnionType) else (field.type,)
        sql = "INTEGER" if isinstance(types[0], inspect.IntType) else "REAL"
        columns.append(f"{field.name} {sql}{'' if len(types) > 1 else ' NOT NULL'}")
    return ", ".join(columns)


#: SQLite rewrites a whole row when a column changes its size, so an episode's body, which may be a
#: megabyte and never changes, has its own table. Elsewhere large columns are last, so that reading
#: the others does not read them.
TABLES = f"""
CREATE TABLE facts (name TEXT PRIMARY KEY, value BLOB NOT NULL, seal BLOB NOT NULL) WITHOUT ROWID;
CREATE TABLE commands (
    id INTEGER PRIMARY KEY, cancelled INTEGER NOT NULL, body BLOB NOT NULL, seal BLOB NOT NULL);
CREATE TABLE episodes (
    id INTEGER PRIMARY KEY, episode_return REAL NOT NULL, length INTEGER NOT NULL,
    digest BLOB NOT NULL, admitted INTEGER, evicted INTEGER, checksum BLOB NOT NULL,
    seal BLOB NOT NULL);
CREATE TABLE bodies (id INTEGER PRIMARY KEY, body BLOB NOT NULL);
CREATE INDEX pending ON episodes (id) WHERE admitted IS NULL;
CREATE INDEX evictions ON episodes (evicted) WHERE evicted IS NOT NULL;
CREATE TABLE iterations ({_declared(IterationStatus)}, seal BLOB NOT NULL, PRIMARY KEY (iteration));
CREATE TABLE evaluations (
    iteration INTEGER NOT NULL, is_final INTEGER NOT NULL, env_steps INTEGER NOT NULL,
    desired_return REAL NOT NULL, desired_horizon INTEGER NOT NULL,
    mean REAL NOT NULL, std REAL NOT NULL, ci95_low REAL NOT NULL, ci95_high REAL NOT NULL,
    episodes INTEGER NOT NULL, seal BLOB NOT NULL, PRIMARY KEY (is_final, iteration)) WITHOUT ROWID;
CREATE TABLE versions (
    version INTEGER PRIMARY KEY, digest BLOB NOT NULL, loss REAL NOT NULL, train_s REAL NOT NULL,
    checksum BLOB NOT NULL, seal BLOB NOT NULL, weights BLOB, optimizer BLOB);
CREATE INDEX weights_kept ON versions (version) WHERE weights IS NOT NULL;
CREATE INDEX optimizers_kept ON versions (version) WHERE optimizer IS NOT NULL;
"""

#: The sealed columns of each table, the row's key first.
SEALED = {
    "facts": "name, value",
    "commands": "id, cancelled, body",
    "episodes": "id, episode_return, length, digest, admitted, evicted, checksum",
    "iterations": ", ".join(IterationStatus.__struct_fields__),
    "evaluations": "iteration, is_final, env_steps, desired_return, desired_horizon, mean, std, "
    "ci95_low, ci95_high, episodes",
    "versions": "version, digest, loss, train_s, checksum",
}

Value = int | float | str | bytes | None


def seal(*values: Value) -> bytes:
    """Return the seal of a row's values, integers as floats because SQLite may convert them."""
    plain = [float(v) if isinstance(v, int) else v for v in values]
    return sha256(repr(plain).encode())[:16]


def sha256(blob: bytes) -> bytes:
    """Return the SHA-256 digest of a large value."""
    return hashlib.sha256(blob).digest()


def marks(values: Iterable[object]) -> str:
    """Return SQL placeholders for values."""
    return ", ".join("?" for _ in values)
