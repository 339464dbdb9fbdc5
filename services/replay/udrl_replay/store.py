"""One SQLite file per run, the only thing in the system that is worth saving.

Every change of a run is one transaction, synced before anything is acknowledged; what is on disk is
consistent at every moment. What it holds is described in :mod:`udrl_replay.tables`.
"""

import fcntl
import os
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec

from udrl.commands import Command
from udrl.config import COMMANDS_PER_ITERATION
from udrl.errors import ConfigError, DamagedStore, OtherConfiguration, RunInUse, StoreError
from udrl.evaluation import Evaluation
from udrl.replay import Entry
from udrl_replay.tables import SCHEMA, SEALED, TABLES, Value, marks, seal, sha256

FILE = "run.sqlite"

#: Tables whose rows may be written again.
_REPLACED = {"facts", "evaluations", "versions"}

Fact = TypeVar("Fact")

#: SQLite's codes for a file that is not what was written: malformed, no database, no such table.
_DAMAGE = {sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_ERROR}


class Pending(NamedTuple):
    """An episode that arrived and is not admitted yet."""

    entry: Entry
    digest: bytes


class Version(NamedTuple):
    """A weights version; blobs are empty where they are no longer kept."""

    version: int
    digest: bytes
    loss: float
    weights: bytes
    optimizer: bytes


class EvaluationRow(NamedTuple):
    """A row of the table ``evaluations``."""

    iteration: int
    closing: bool
    env_steps: int
    desired_return: float
    desired_horizon: int
    evaluation: Evaluation


class Store:
    """The file of one run.

    Args:
        run_dir: its directory.
        read_only: look at it as it is now, beside a service that goes on writing.

    Raises:
        StoreError: there is no run, or its file cannot be read.
        RunInUse: another service writes it.
        DamagedStore: the file is not what was written.
    """

    def __init__(self, run_dir: Path, *, read_only: bool = False) -> None:
        self._path = run_dir / FILE
        if not self._path.exists():
            raise StoreError(f"{run_dir} holds no run ({FILE} is missing); check the path")
        self.read_only = read_only
        self._lock = None if read_only else _lock(run_dir)
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        # As a URI, so that a mode can be named and the path may hold any character.
        uri = f"{self._path.resolve().as_uri()}?mode={'ro' if self.read_only else 'rw'}"
        try:
            self._db = sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)
            if self.read_only:
                self._db.execute("BEGIN")  # all that is read belongs to one moment
            else:
                self._db.execute("PRAGMA journal_mode = WAL")
                self._db.execute("PRAGMA synchronous = FULL")
                # Some builds overwrite what is deleted: thirteen times the time for a megabyte.
                self._db.execute("PRAGMA secure_delete = OFF")
        except sqlite3.Error as error:
            raise self._fault(error) from error
        self._db.create_function("seal", -1, seal, deterministic=True)
        if not self.read_only:
            ((verdict,),) = self._rows("PRAGMA integrity_check(1)")
            if verdict != "ok":
                raise self._damaged(" ".join(verdict.split()))  # SQLite's may have several lines
        schema = self.fact("schema", int)
        if schema != SCHEMA:
            raise OtherConfiguration(
                f"{self._path} has schema {schema}, this version of udrl reads {SCHEMA}; "
                f"use the version that wrote it"
            )
        self._check_seals()

    def _check_seals(self) -> None:
        for table, columns in SEALED.items():
            key = columns.split(",")[0]
            broken = self._rows(
                f"SELECT {key} FROM {table} WHERE seal IS NOT seal({columns}) LIMIT 1"  # noqa: S608
            )
            if broken:
                raise self._damaged(f"{key} {broken[0][0]!r} of {table} is not what was written")

    @classmethod
    def create(cls, run_dir: Path, **facts: object) -> "Store":
        """Make a new run's file, which holds some facts from the beginning.

        Raises:
            StoreError: there is a run already, or the directory cannot be written.
            RunInUse: another service works in it.
        """
        path = run_dir / FILE
        try:
            run_dir.mkdir(parents=True, exist_ok=True)
            with _lock(run_dir):
                if path.exists():
                    raise StoreError(
                        f"{run_dir} holds a run already; add --resume (in Python: "
                        f"resume=True) to go on with it, or name another --run-dir"
                    )
                # Written aside and renamed, so that a run's file is there as a whole or not at all.
                unfinished = path.with_suffix(".new")
                unfinished.unlink(missing_ok=True)
                with closing(sqlite3.connect(unfinished, isolation_level=None)) as db:
                    db.executescript(TABLES)
                    for name, value in {"schema": SCHEMA, **facts}.items():
                        encoded = msgspec.json.encode(value)
                        row = name, encoded, seal(name, encoded)
                        db.execute("INSERT INTO facts VALUES (?, ?, ?)", row)
                unfinished.rename(path)
                _sync(run_dir)
        except (OSError, sqlite3.Error) as error:
            raise StoreError(f"run directory {run_dir}: {error}; name one you may write") from error
        return cls(run_dir)

    def close(self) -> None:
        """Close the file and let others have it."""
        if hasattr(self, "_db"):
            self._db.close()
        if self._lock is not None:
            self._lock.close()

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Make all changes within durable together, or none of them.

        Raises:
            StoreError: they could not be written, e.g. because the disk is full.
        """
        try:
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._db.execute("COMMIT")
            finally:
                # After some errors SQLite has rolled back by itself.
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
        except sqlite3.Error as error:
            raise self._fault(error) from error

    def _insert(self, table: str, *values: Value, unsealed: Sequence[bytes] = ()) -> None:
        """Add a row: what its seal covers, the seal, and the rest."""
        insert = "INSERT OR REPLACE" if table in _REPLACED else "INSERT"
        row = *values, seal(*values), *unsealed
        self._db.execute(f"{insert} INTO {table} VALUES ({marks(row)})", row)

    def _rows(self, query: str, values: Sequence[object] = ()) -> list[Any]:
        try:
            return self._db.execute(query, values).fetchall()
        except sqlite3.Error as error:
            raise self._fault(error) from error

    def _fault(self, error: sqlite3.Error) -> StoreError:
        if getattr(error, "sqlite_errorcode", 0) & 0xFF in _DAMAGE:
            return self._damaged(error)
        return StoreError(
            f"{self._path} cannot be used: {error}; nothing acknowledged is lost: free some disk "
            f"space or repair the disk, and start again with --resume"
        )

    def _damaged(self, what: object) -> DamagedStore:
        return DamagedStore(f"{self._path}: {what}; restore the run directory from a backup")

    # Facts: named values, as JSON.

    def fact(self, name: str, kind: type[Fact], default: Fact | None = None) -> Fact:
        """Return a named value; the default if it was never set.

        Raises:
            DamagedStore: it is missing and there is no default, or it is of another kind.
        """
        rows = self._rows("SELECT value FROM facts WHERE name = ?", (name,))
        if not rows:
            if default is not None:
                return default
            raise self._damaged(f"fact {name!r} is missing")
        try:
            return msgspec.json.decode(rows[0][0], type=kind)
        except (msgspec.DecodeError, ConfigError) as error:
            raise self._damaged(f"fact {name!r}: {error}") from error

    def set_fact(self, name: str, value: object) -> None:
        """Set a named value."""
        self._insert("facts", name, msgspec.json.encode(value))

    # Commands: those that are outstanding or cancelled.

    def add_commands(self, commands: Iterable[Command]) -> None:
        """Add outstanding commands."""
        for command in commands:
            self._insert("commands", command.id, 0, msgspec.msgpack.encode(command))

    def commands(self, *, cancelled: bool) -> list[Command]:
        """Return the outstanding or the cancelled commands, by id."""
        rows = self._rows(
            "SELECT body FROM commands WHERE cancelled = ? ORDER BY id", (int(cancelled),)
        )
        try:
            return [msgspec.msgpack.decode(body, type=Command) for (body,) in rows]
        except msgspec.DecodeError as error:
            raise self._damaged(f"a command: {error}") from error

    def mark_commands(self, ids: Iterable[int], *, cancelled: bool) -> None:
        """Cancel commands, or take that back."""
        self._db.executemany(
            "UPDATE commands SET cancelled = ?1, seal = seal(id, ?1, body) WHERE id = ?2",
            ((int(cancelled), i) for i in ids),
        )

    def remove_commands(self, ids: Iterable[int]) -> None:
        """Forget commands, whose episodes were accepted."""
        self._db.executemany("DELETE FROM commands WHERE id = ?", ((i,) for i in ids))

    # Episodes: pending, in the buffer, or needed for an earlier buffer.

    def add_episode(self, entry: Entry, digest: bytes, body: bytes) -> None:
        """Add an episode that arrived."""
        row = entry.id, entry.episode_return, entry.length, digest, None, None, sha256(body)
        self._insert("episodes", *row)
        self._db.execute("INSERT INTO bodies VALUES (?, ?)", (entry.id, body))

    def episode_digest(self, episode_id: int) -> bytes | None:
        """Return an episode's digest if its row is still there."""
        rows = self._rows("SELECT digest FROM episodes WHERE id = ?", (episode_id,))
        return bytes(rows[0][0]) if rows else None

    def pending(self, iteration: int) -> list[Pending]:
        """Return an iteration's episodes that are not admitted yet, by id."""
        first = iteration * COMMANDS_PER_ITERATION
        rows = self._rows(
            "SELECT episode_return, id, length, digest FROM episodes "
            "WHERE admitted IS NULL AND id >= ? AND id < ? ORDER BY id",
            (first, first + COMMANDS_PER_ITERATION),
        )
        return [Pending(Entry(*entry), digest) for *entry, digest in rows]

    def pending_ids(self) -> set[int]:
        """Return the ids of all episodes that are not admitted yet."""
        rows = self._rows("SELECT id FROM episodes WHERE admitted IS NULL ORDER BY id")
        return {i for (i,) in rows}

    def admit(self, iteration: int, ids: Iterable[int], evicted: Iterable[int]) -> None:
        """Note which episodes entered and left the buffer with an iteration."""
        columns = SEALED["episodes"]
        for column, changed in (("admitted", ids), ("evicted", evicted)):
            self._db.executemany(
                f"UPDATE episodes SET {column} = ?1, "  # noqa: S608
                f"seal = seal({columns.replace(column, '?1')}) WHERE id = ?2",
                ((iteration, i) for i in changed),
            )

    def remove_episodes(self, ids: Iterable[int]) -> None:
        """Forget episodes."""
        rows = [(i,) for i in ids]
        self._db.executemany("DELETE FROM episodes WHERE id = ?", rows)
        self._db.executemany("DELETE FROM bodies WHERE id = ?", rows)

    def remove_evicted(self, until: int) -> None:
        """Forget episodes that no buffer after iteration ``until`` or later holds."""
        rows = self._rows("SELECT id FROM episodes WHERE evicted <= ? ORDER BY id", (until,))
        self.remove_episodes(i for (i,) in rows)

    def buffer(self, iteration: int) -> list[Pending]:
        """Return the buffer as it was after an iteration, least return first."""
        rows = self._rows(
            "SELECT episode_return, id, length, digest FROM episodes "
            "WHERE admitted <= ? AND (evicted IS NULL OR evicted > ?) ORDER BY episode_return, id",
            (iteration, iteration),
        )
        return [Pending(Entry(*entry), digest) for *entry, digest in rows]

    def episode_bodies(self, ids: Sequence[int], limit: int) -> list[bytes]:
        """Return the first of the episodes asked for, up to ``limit`` bytes but at least one.

        Raises:
            DamagedStore: one is not what was written.
        """
        bodies: list[bytes] = []
        for episode_id in ids:
            rows = self._rows(
                "SELECT body, checksum FROM episodes LEFT JOIN bodies USING (id) WHERE id = ?",
                (episode_id,),
            )
            if not rows:
                break
            ((body, checksum),) = rows
            limit -= len(body or b"")
            if bodies and limit < 0:
                break
            if body is None or sha256(body) != checksum:
                raise self._damaged(f"episode {episode_id} is not what was written")
            bodies.append(body)
        return bodies

    # Iterations and evaluations: one row each, kept for good.

    def add_iteration(self, *values: float | None) -> None:
        """Add a row to ``iterations``; values in the order of its columns."""
        self._insert("iterations", *values)

    def issued_in(self, iteration: int) -> int:
        """Return how many commands a completed iteration had."""
        rows = self._rows("SELECT commands FROM iterations WHERE iteration = ?", (iteration,))
        return int(rows[0][0]) if rows else 0

    def env_steps_after(self, iteration: int) -> int:
        """Return the env steps that a completed iteration ended with."""
        rows = self._rows("SELECT env_steps FROM iterations WHERE iteration = ?", (iteration,))
        return int(rows[0][0]) if rows else 0

    def add_evaluation(self, row: EvaluationRow) -> None:
        """Add or replace an evaluation."""
        self._insert("evaluations", *row[:-1], *row.evaluation)

    def last_evaluation(self, *, closing: bool) -> EvaluationRow | None:
        """Return the newest evaluation, of those that close a run or of the others."""
        rows = self._rows(
            "SELECT * FROM evaluations WHERE closing = ? ORDER BY iteration DESC LIMIT 1",
            (int(closing),),
        )
        return _evaluation(rows[0]) if rows else None

    def evaluation_of(self, iteration: int, *, closing: bool) -> EvaluationRow | None:
        """Return the evaluation of an iteration."""
        rows = self._rows(
            "SELECT * FROM evaluations WHERE closing = ? AND iteration = ?",
            (int(closing), iteration),
        )
        return _evaluation(rows[0]) if rows else None

    def best_evaluation(self) -> float | None:
        """Return the greatest mean return of an evaluation, closing ones included."""
        ((best,),) = self._rows("SELECT max(mean) FROM evaluations")
        return None if best is None else float(best)

    def evaluations(self, after: int, until: int) -> list[EvaluationRow]:
        """Return the evaluations of iterations after one, up to another; no closing ones."""
        rows = self._rows(
            "SELECT * FROM evaluations WHERE closing = 0 AND iteration > ? AND iteration <= ? "
            "ORDER BY iteration",
            (after, until),
        )
        return [_evaluation(row) for row in rows]

    def metrics(self, after: int, limit: int = -1) -> list[tuple[Any, ...]]:
        """Return the rows of ``metrics.csv`` of iterations after ``after``; -1: all of them."""
        return self._rows(
            "SELECT i.iteration, i.env_steps, i.eval_env_steps, round(i.wall_s, 3), "
            "e.env_steps, e.mean, e.std, e.ci95_low, e.ci95_high, v.loss, i.weights_version, "
            "i.return_min, i.return_mean, i.return_max, i.explored_return, "
            "e.desired_return, e.desired_horizon, i.commanded_min, i.commanded_max, i.admitted "
            "FROM iterations i "
            "LEFT JOIN evaluations e ON e.iteration = i.iteration AND e.closing = 0 "
            "LEFT JOIN versions v ON v.version = i.weights_version "
            "WHERE i.iteration > ? ORDER BY i.iteration LIMIT ?",
            (after, limit),
        )

    # Weights versions: digest and loss of all, blobs of those that somebody may need.

    def add_version(self, version: Version, train_s: float) -> None:
        """Add a version, or bring back one whose blobs had gone."""
        weights, optimizer = version.weights, version.optimizer
        self._insert(
            "versions", version.version, version.digest, version.loss, train_s,
            sha256(weights) + sha256(optimizer), unsealed=(weights, optimizer),
        )  # fmt: skip

    def version(self, version: int) -> Version | None:
        """Return a version; its optimizer is empty unless it is the newest.

        Raises:
            DamagedStore: the blobs are not those that were written.
        """
        rows = self._rows(
            "SELECT version, digest, loss, ifnull(weights, x''), ifnull(optimizer, x''), checksum "
            "FROM versions WHERE version = ?",
            (version,),
        )
        if not rows:
            return None
        *values, checksum = rows[0]
        found = Version(*values)
        for blob, expected in ((found.weights, checksum[:32]), (found.optimizer, checksum[32:])):
            if blob and sha256(blob) != expected:
                raise self._damaged(f"weights version {version} is not what was written")
        return found

    def versions_kept(self) -> list[int]:
        """Return the versions whose weights are there."""
        rows = self._rows("SELECT version FROM versions WHERE weights IS NOT NULL ORDER BY version")
        return [v for (v,) in rows]

    def drop_weights(self, versions: Iterable[int]) -> None:
        """Forget the blobs of some versions."""
        self._db.executemany(
            "UPDATE versions SET weights = NULL, optimizer = NULL WHERE version = ?",
            ((v,) for v in versions),
        )

    def drop_optimizers(self, before: int) -> None:
        """Forget the optimizer state of versions before one."""
        self._db.execute(
            "UPDATE versions SET optimizer = NULL WHERE version < ? AND optimizer IS NOT NULL",
            (before,),
        )

    def remove_versions(self, after: int) -> None:
        """Forget versions that were trained beyond the end of the run."""
        self._db.execute("DELETE FROM versions WHERE version > ?", (after,))


def _evaluation(row: tuple[Any, ...]) -> EvaluationRow:
    iteration, closing, env_steps, desired_return, desired_horizon, *found, _ = row
    result = Evaluation(*found)
    return EvaluationRow(
        iteration, bool(closing), env_steps, desired_return, desired_horizon, result
    )


def _sync(folder: Path) -> None:
    """Make a renamed file's new name durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _lock(run_dir: Path) -> Any:
    """Return the open lock file of a run directory; it is free again when it is closed."""
    try:
        file = (run_dir / "lock").open("a")
    except OSError as error:
        raise StoreError(f"run directory {run_dir}: {error}; name one you may write") from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.close()
        raise RunInUse(
            f"{run_dir} is in use by another replay service; stop it, or name another --run-dir"
        ) from error
    return file
