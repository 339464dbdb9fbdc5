"""A SQLite file of sealed rows, with one writing process and any number of readers.

Every change is one transaction, synced before it is acknowledged, so the file is consistent at
every moment. Changed and missing rows are detected.
"""

import fcntl
import os
import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Self, TypeVar

import msgspec

from udrl.atomic_files import replacing
from udrl.errors import ConfigError, DamagedStore, OtherConfiguration, RunInUse, StoreError
from udrl_replay.remedies import database_remedy, primary_code, remedy
from udrl_replay.schema import SCHEMA, SEALED, TABLES, Value, marks, seal
from udrl_replay.tallies import TALLIES, Tallies, Tally

STORE_FILE = "run.sqlite"
LOCK = "lock"
#: Seconds to retry to take the lock; :func:`is_locked` holds it only briefly.
_LOCK_RETRY_S = 0.2

#: Tables whose rows may be replaced.
_REPLACED = {"facts", "evaluations", "versions"}

Fact = TypeVar("Fact")

#: SQLite's codes for a damaged file: malformed, not a database, no such table.
_DAMAGE = {sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_ERROR}


class Database:
    """A run's file: locking, integrity checks, transactions and facts.

    Args:
        run_dir: directory of the run.
        read_only: read a snapshot, without the lock; a replay service may write at the same time.

    Attributes:
        run_dir: directory of the run.
        read_only: as above.

    Raises:
        StoreError: there is no run, or its file cannot be read.
        RunInUse: another replay service has the lock.
        DamagedStore: the file is damaged.
    """

    def __init__(self, run_dir: Path, *, read_only: bool = False) -> None:
        self.run_dir = run_dir
        self._path = run_dir / STORE_FILE
        found = exists(run_dir)
        if not (found and self._path.is_file()):
            why = "is not a file" if found else "is missing"
            raise StoreError(f"{run_dir} holds no run ({STORE_FILE} {why}); check the path")
        self.read_only = read_only
        self._lock = None if read_only else _lock(run_dir)
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        try:
            if self.read_only:
                self._db = self._connect_to_read()
            else:
                self._db = self._connect("mode=rw")
                self._db.execute("PRAGMA journal_mode = WAL")
                self._db.execute("PRAGMA synchronous = FULL")
                # Some builds overwrite deleted content, which takes 13 times as long for 1 MB.
                self._db.execute("PRAGMA secure_delete = OFF")
                # Statement journals are small and need no file.
                self._db.execute("PRAGMA temp_store = MEMORY")
        except sqlite3.Error as error:
            raise self._fault(error) from error
        self._db.create_function("seal", -1, seal, deterministic=True)
        if not self.read_only:
            ((verdict,),) = self._rows("PRAGMA integrity_check(1)")
            if verdict != "ok":
                raise self._damaged(" ".join(verdict.split()))  # it may have several lines
        schema = self.fact("schema", int)
        if schema != SCHEMA:
            raise OtherConfiguration(
                f"{self._path} has schema {schema}, this version of udrl reads {SCHEMA}; "
                f"use the version that wrote it"
            )
        self._check_seals()
        self._check_tallies()

    def _connect(self, how: str) -> sqlite3.Connection:
        # A URI allows a mode, and any character in the path.
        uri = f"{self._path.resolve().as_uri()}?{how}"
        return sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)

    def _connect_to_read(self) -> sqlite3.Connection:
        """Connect and start a transaction, so that all reads see one snapshot."""
        wal = self._path.with_name(f"{STORE_FILE}-wal")
        # While a file is read, SQLite keeps an index beside it. In a read-only directory it can do
        # without (immutable) if no process can change the file.
        may_write = os.access(self.run_dir, os.W_OK)
        is_still = not (wal.exists() and wal.stat().st_size) and not is_locked(self.run_dir)
        db = self._connect("mode=ro" if may_write or not is_still else "mode=ro&immutable=1")
        db.execute("BEGIN")
        db.execute("SELECT 1 FROM facts").fetchone()  # takes the snapshot
        return db

    def _check_seals(self) -> None:
        """Raise :class:`DamagedStore` if a row was changed."""
        for table, columns in SEALED.items():
            key = columns.split(",")[0]
            broken = self._rows(
                f"SELECT {key} FROM {table} WHERE seal IS NOT seal({columns}) LIMIT 1"  # noqa: S608
            )
            if broken:
                raise self._damaged(f"{key} {broken[0][0]!r} of {table} does not match its seal")

    def _check_tallies(self) -> None:
        """Raise :class:`DamagedStore` if a row is missing or was added."""
        try:
            self._tallies = Tallies(self._db)
        except sqlite3.Error as error:
            raise self._fault(error) from error
        written = self.fact(TALLIES, dict[str, Tally])
        for table, tally in self._tallies.held().items():
            expected = written.get(table)
            if tally != expected:
                rows = expected.rows if expected else 0
                raise self._damaged(
                    f"table {table} has {tally.rows} rows that do not match the {rows} written"
                )
        if not self.read_only:
            self._tallies.follow(self._db)

    @classmethod
    def create(cls, run_dir: Path, **facts: object) -> Self:
        """Create a new run's file with some facts.

        Raises:
            StoreError: the directory already holds a run, or cannot be written.
            RunInUse: another replay service has the lock.
        """
        path = run_dir / STORE_FILE
        try:
            _make_directory(run_dir)
            with _lock(run_dir):
                if path.exists():
                    raise StoreError(
                        f"{run_dir} holds a run already; add --resume (in Python: "
                        f"resume=True) to resume it, or use another --run-dir"
                    )
                # Atomic, so that a run's file is always complete.
                with replacing(path) as unfinished:
                    unfinished.unlink(missing_ok=True)
                    with closing(sqlite3.connect(unfinished, isolation_level=None)) as db:
                        _begin(db, {"schema": SCHEMA, **facts})
                _sync(run_dir)
        except (OSError, sqlite3.Error) as error:
            raise _unusable(run_dir, error) from error
        return cls(run_dir)

    def close(self) -> None:
        """Close the file and release the lock."""
        if hasattr(self, "_db"):
            self._db.close()
        if self._lock is not None:
            self._lock.close()

    def delete(self) -> None:
        """Delete the file, and close it: for a run that cannot be created completely."""
        self._db.close()
        # The file itself last: a log of changes without it would be applied to the next one.
        for end in ("-wal", "-shm", ""):
            self._path.with_name(f"{STORE_FILE}{end}").unlink(missing_ok=True)
        self.close()

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Make all changes in the block durable, or none of them.

        Raises:
            StoreError: the changes cannot be written, e.g. because the disk is full.
        """
        try:
            self._db.execute("BEGIN IMMEDIATE")
            before = self._tallies.held()
            try:
                yield
                after = self._tallies.held()
                if after != before:
                    self.set_fact(TALLIES, after)
                self._db.execute("COMMIT")
            except BaseException:
                self._tallies.put_back(before)
                raise
            finally:
                # After some errors SQLite has already rolled back.
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
        except sqlite3.Error as error:
            raise self._fault(error) from error

    def _insert(self, table: str, *values: Value, unsealed: Sequence[bytes] = ()) -> None:
        """Add a row, within a transaction: the sealed columns, the seal, and the unsealed ones."""
        insert = "INSERT OR REPLACE" if table in _REPLACED else "INSERT"
        row = *values, seal(*values), *unsealed
        self._db.execute(f"{insert} INTO {table} VALUES ({marks(row)})", row)

    def _rows(self, query: str, values: Sequence[object] = ()) -> list[Any]:
        try:
            return self._db.execute(query, values).fetchall()
        except sqlite3.Error as error:
            raise self._fault(error) from error

    def _fault(self, error: sqlite3.Error) -> StoreError:
        """Return the error for one of SQLite's, with its remedy."""
        if primary_code(error) in _DAMAGE:
            return self._damaged(error)
        what_to_do = database_remedy(error, read_only=self.read_only)
        if self.read_only:
            return StoreError(f"{self._path} cannot be read: {error}; {what_to_do}")
        return StoreError(
            f"{self._path} cannot be used: {error}; nothing acknowledged is lost: {what_to_do}"
        )

    def _damaged(self, what: object) -> DamagedStore:
        return DamagedStore(f"{self._path}: {what}; restore the run directory from a backup")

    # Facts: named values, as JSON.

    def fact(self, name: str, kind: type[Fact], default: Fact | None = None) -> Fact:
        """Return a named value; the default if it was never set.

        Raises:
            DamagedStore: the value is missing and there is no default, or it is of another type.
        """
        rows = self._rows("SELECT value FROM facts WHERE name = ?", (name,))
        if not rows:
            if default is not None:
                return default
            raise self._damaged(f"fact {name!r} is missing in table facts")
        try:
            return msgspec.json.decode(rows[0][0], type=kind)
        except (msgspec.DecodeError, ConfigError) as error:
            raise self._damaged(f"fact {name!r}: {error}") from error

    def set_fact(self, name: str, value: object) -> None:
        """Set a named value."""
        self._insert("facts", name, msgspec.json.encode(value))


def _begin(db: sqlite3.Connection, facts: dict[str, object]) -> None:
    """Create the tables of a new run, with some facts."""

    def add(name: str, value: object) -> None:
        encoded = msgspec.json.encode(value)
        row = name, encoded, seal(name, encoded)
        db.execute("INSERT INTO facts VALUES (?, ?, ?)", row)

    db.executescript(TABLES)
    db.create_function("seal", -1, seal, deterministic=True)
    for name, value in facts.items():
        add(name, value)
    add(TALLIES, Tallies(db).held())


def _make_directory(run_dir: Path) -> None:
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        run_dir.stat()  # raises the actual error of a broken or circular link
        raise


def _sync(folder: Path) -> None:
    """Make the renaming of a file durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _unusable(run_dir: Path, error: OSError | sqlite3.Error) -> StoreError:
    what_to_do = remedy(error, "use a writable directory")
    reason = error.strerror if isinstance(error, OSError) else error
    return StoreError(f"run directory {run_dir}: {reason}; {what_to_do}")


def exists(run_dir: Path) -> bool:
    """Return whether a directory holds a run.

    Raises:
        StoreError: the directory cannot be read.
    """
    try:
        (run_dir / STORE_FILE).stat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as error:
        what_to_do = remedy(error, "name a directory that you can read")
        raise StoreError(f"run directory {run_dir}: {error.strerror}; {what_to_do}") from error
    return True


def is_locked(run_dir: Path) -> bool:
    """Return whether a service has the lock, on this machine or another that shares its disk.

    Also true if the lock file cannot be read.
    """
    try:
        with (run_dir / LOCK).open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False


def _lock(run_dir: Path) -> Any:
    """Lock a run directory; return the open lock file, which is released when it is closed."""
    try:
        file = (run_dir / LOCK).open("a")
    except OSError as error:
        raise _unusable(run_dir, error) from error
    deadline = time.monotonic() + _LOCK_RETRY_S
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            if time.monotonic() < deadline:  # is_locked() in another process may hold it briefly
                time.sleep(_LOCK_RETRY_S / 10)
                continue
            file.close()
            raise RunInUse(
                f"{run_dir} is in use by another replay service; stop it, or use another --run-dir"
            ) from error
        except OSError as error:
            file.close()
            raise StoreError(
                f"{run_dir} cannot be locked: its file system does not support locks ({error}); "
                f"use a --run-dir on a local disk"
            ) from error
        return file
