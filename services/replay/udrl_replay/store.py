"""The store: one SQLite file per run, with all its persistent state.

The tables are defined in :mod:`udrl_replay.schema`; :mod:`udrl_replay.database` handles locking,
transactions and integrity checks.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import msgspec

from udrl.commands import Command
from udrl.config import COMMANDS_PER_ITERATION
from udrl.evaluation import Evaluation
from udrl.replay_buffer import Entry
from udrl_proto.reports import IterationStatus
from udrl_replay.database import Database
from udrl_replay.schema import SEALED, sha256

_ITERATION_COLUMNS = IterationStatus.__struct_fields__
#: Columns of evaluations in ``metrics.csv``, and in the store.
EVALUATION_COLUMNS = {
    "eval_at_env_steps": "env_steps",
    "eval_desired_return": "desired_return",
    "eval_desired_horizon": "desired_horizon",
    "eval_mean": "mean",
    "eval_std": "std",
    "eval_ci95_low": "ci95_low",
    "eval_ci95_high": "ci95_high",
}
#: All columns of ``metrics.csv``.
COLUMNS = (*_ITERATION_COLUMNS, *EVALUATION_COLUMNS)


class StoredEpisode(NamedTuple):
    """A stored episode, without its steps."""

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
    is_final: bool
    env_steps: int
    desired_return: float
    desired_horizon: int
    evaluation: Evaluation


class Store(Database):
    """Commands, episodes, iterations, evaluations and weights versions of one run.

    Methods that read raise :class:`~udrl.errors.DamagedStore` if the file is damaged.
    """

    # Commands of iterations that are not complete, and cancelled ones.

    def add_commands(self, commands: Iterable[Command]) -> None:
        """Add outstanding commands."""
        for command in commands:
            self._insert("commands", command.id, 0, msgspec.msgpack.encode(command))

    def commands(self, *, cancelled: bool) -> list[Command]:
        """Return the cancelled commands, or those of incomplete iterations, by id."""
        rows = self._rows(
            "SELECT body FROM commands WHERE cancelled = ? ORDER BY id", (int(cancelled),)
        )
        try:
            return [msgspec.msgpack.decode(body, type=Command) for (body,) in rows]
        except msgspec.DecodeError as error:
            raise self._damaged(f"a command: {error}") from error

    def mark_commands(self, ids: Iterable[int], *, cancelled: bool) -> None:
        """Cancel commands, or undo that."""
        self._db.executemany(
            "UPDATE commands SET cancelled = ?1, seal = seal(id, ?1, body) WHERE id = ?2",
            ((int(cancelled), i) for i in ids),
        )

    def remove_commands(self, ids: Iterable[int]) -> None:
        """Delete commands."""
        self._db.executemany("DELETE FROM commands WHERE id = ?", ((i,) for i in ids))

    # Episodes: pending, in the buffer, or needed for an earlier buffer.

    def add_episode(self, entry: Entry, digest: bytes, body: bytes) -> None:
        """Add an accepted episode, not admitted yet."""
        row = entry.id, entry.episode_return, entry.length, digest, None, None, sha256(body)
        self._insert("episodes", *row)
        self._db.execute("INSERT INTO bodies VALUES (?, ?)", (entry.id, body))

    def episode_digest(self, episode_id: int) -> bytes | None:
        """Return the digest of an episode; None if it is not kept."""
        rows = self._rows("SELECT digest FROM episodes WHERE id = ?", (episode_id,))
        return bytes(rows[0][0]) if rows else None

    def pending(self, iteration: int) -> list[StoredEpisode]:
        """Return an iteration's episodes that are not admitted yet, by id."""
        first = iteration * COMMANDS_PER_ITERATION
        rows = self._rows(
            "SELECT episode_return, id, length, digest FROM episodes "
            "WHERE admitted IS NULL AND id >= ? AND id < ? ORDER BY id",
            (first, first + COMMANDS_PER_ITERATION),
        )
        return [StoredEpisode(Entry(*entry), digest) for *entry, digest in rows]

    def pending_ids(self) -> set[int]:
        """Return the ids of all episodes that are not admitted yet."""
        rows = self._rows("SELECT id FROM episodes WHERE admitted IS NULL ORDER BY id")
        return {i for (i,) in rows}

    def admit(self, iteration: int, ids: Iterable[int], evicted: Iterable[int]) -> None:
        """Record the episodes that an iteration added to the buffer and evicted from it."""
        self._db.executemany(
            "UPDATE episodes SET admitted = ?1, seal = seal("
            "id, episode_return, length, digest, ?1, evicted, checksum) WHERE id = ?2",
            ((iteration, i) for i in ids),
        )
        self._db.executemany(
            "UPDATE episodes SET evicted = ?1, seal = seal("
            "id, episode_return, length, digest, admitted, ?1, checksum) WHERE id = ?2",
            ((iteration, i) for i in evicted),
        )

    def remove_episodes(self, ids: Iterable[int]) -> None:
        """Delete episodes."""
        rows = [(i,) for i in ids]
        self._db.executemany("DELETE FROM episodes WHERE id = ?", rows)
        self._db.executemany("DELETE FROM bodies WHERE id = ?", rows)

    def remove_evicted(self, until: int) -> None:
        """Delete episodes that are not in the buffer after iteration ``until`` or any later one."""
        rows = self._rows("SELECT id FROM episodes WHERE evicted <= ? ORDER BY id", (until,))
        self.remove_episodes(i for (i,) in rows)

    def buffer(self, iteration: int) -> list[StoredEpisode]:
        """Return the buffer as it was after an iteration, lowest return first."""
        rows = self._rows(
            "SELECT episode_return, id, length, digest FROM episodes "
            "WHERE admitted <= ? AND (evicted IS NULL OR evicted > ?) ORDER BY episode_return, id",
            (iteration, iteration),
        )
        return [StoredEpisode(Entry(*entry), digest) for *entry, digest in rows]

    def episode_bodies(self, ids: Sequence[int], limit: int) -> list[bytes]:
        """Return the first requested episodes, up to ``limit`` bytes but at least one.

        Stops before the first episode that is not kept.

        Raises:
            DamagedStore: a body does not match its checksum.
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
                raise self._damaged(f"episode {episode_id} does not match its checksum")
            bodies.append(body)
        return bodies

    # Iterations and evaluations: one row each, never deleted.

    def add_iteration(self, done: IterationStatus) -> None:
        """Add a completed iteration."""
        self._insert("iterations", *msgspec.structs.astuple(done))

    def iterations(self, after: int, limit: int) -> list[IterationStatus]:
        """Return up to ``limit`` completed iterations after ``after``."""
        rows = self._rows(
            f"SELECT {SEALED['iterations']} FROM iterations "  # noqa: S608
            "WHERE iteration > ? ORDER BY iteration LIMIT ?",
            (after, limit),
        )
        return [IterationStatus(**dict(zip(_ITERATION_COLUMNS, row, strict=True))) for row in rows]

    def issued_in(self, iteration: int) -> int:
        """Return the number of commands of a completed iteration."""
        rows = self._rows("SELECT commands FROM iterations WHERE iteration = ?", (iteration,))
        return int(rows[0][0]) if rows else 0

    def loss_of(self, version: int) -> float | None:
        """Return the training loss of a version; None for version 0."""
        rows = self._rows("SELECT loss FROM versions WHERE version = ?", (version,))
        return float(rows[0][0]) if rows else None

    def env_steps_after(self, iteration: int) -> int:
        """Return the run's env steps after a completed iteration."""
        rows = self._rows("SELECT env_steps FROM iterations WHERE iteration = ?", (iteration,))
        return int(rows[0][0]) if rows else 0

    def add_evaluation(self, row: EvaluationRow) -> None:
        """Add or replace an evaluation."""
        self._insert("evaluations", *row[:-1], *row.evaluation)

    def last_evaluation(self, *, is_final: bool) -> EvaluationRow | None:
        """Return the newest final evaluation, or the newest of the others."""
        rows = self._rows(
            "SELECT * FROM evaluations WHERE is_final = ? ORDER BY iteration DESC LIMIT 1",
            (int(is_final),),
        )
        return _evaluation_row(rows[0]) if rows else None

    def evaluation_of(self, iteration: int, *, is_final: bool) -> EvaluationRow | None:
        """Return the evaluation of an iteration."""
        rows = self._rows(
            "SELECT * FROM evaluations WHERE is_final = ? AND iteration = ?",
            (int(is_final), iteration),
        )
        return _evaluation_row(rows[0]) if rows else None

    def best_evaluation(self) -> float | None:
        """Return the highest mean return of all evaluations, the final evaluation included."""
        ((best,),) = self._rows("SELECT max(mean) FROM evaluations")
        return None if best is None else float(best)

    def evaluations(self, after: int, until: int) -> list[EvaluationRow]:
        """Return the evaluations after ``after`` up to ``until``, without the final evaluation."""
        rows = self._rows(
            "SELECT * FROM evaluations WHERE is_final = 0 AND iteration > ? AND iteration <= ? "
            "ORDER BY iteration",
            (after, until),
        )
        return [_evaluation_row(row) for row in rows]

    def metrics(self, after: int) -> list[tuple[Any, ...]]:
        """Return the rows of ``metrics.csv`` of the iterations after ``after``; -1: all."""
        columns = [f"i.{c}" for c in _ITERATION_COLUMNS]
        columns += [f"e.{c}" for c in EVALUATION_COLUMNS.values()]
        return self._rows(
            f"SELECT {', '.join(columns)} FROM iterations i "  # noqa: S608
            "LEFT JOIN evaluations e ON e.iteration = i.iteration AND e.is_final = 0 "
            "WHERE i.iteration > ? ORDER BY i.iteration",
            (after,),
        )

    # Weights versions: digest and loss of all, blobs of those that may be needed.

    def add_version(self, version: Version, train_s: float) -> None:
        """Add a version, or restore the blobs of one."""
        weights, optimizer = version.weights, version.optimizer
        self._insert(
            "versions", version.version, version.digest, version.loss, train_s,
            sha256(weights) + sha256(optimizer), unsealed=(weights, optimizer),
        )  # fmt: skip

    def version(self, version: int) -> Version | None:
        """Return a version; its optimizer state is empty unless it is the latest.

        Raises:
            DamagedStore: a blob does not match its checksum.
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
                raise self._damaged(f"weights version {version} does not match its checksum")
        return found

    def state(self, version: int) -> Version:
        """Return a version with its optimizer state, for a learner to continue from.

        Raises:
            DamagedStore: a blob is missing or does not match its checksum.
        """
        found = self.version(version)
        if found is None or not (found.weights and found.optimizer):
            raise self._damaged(f"weights version {version}, the latest, is missing")
        return found

    def versions_kept(self) -> list[int]:
        """Return the versions whose weights are kept."""
        rows = self._rows("SELECT version FROM versions WHERE weights IS NOT NULL ORDER BY version")
        return [v for (v,) in rows]

    def drop_weights(self, versions: Iterable[int]) -> None:
        """Delete the blobs of some versions."""
        self._db.executemany(
            "UPDATE versions SET weights = NULL, optimizer = NULL WHERE version = ?",
            ((v,) for v in versions),
        )

    def drop_optimizers(self, before: int) -> None:
        """Delete the optimizer states of all versions before ``before``."""
        self._db.execute(
            "UPDATE versions SET optimizer = NULL WHERE version < ? AND optimizer IS NOT NULL",
            (before,),
        )

    def remove_versions(self, after: int) -> None:
        """Delete all versions after ``after``."""
        self._db.execute("DELETE FROM versions WHERE version > ?", (after,))


def _evaluation_row(row: tuple[Any, ...]) -> EvaluationRow:
    iteration, is_final, env_steps, desired_return, desired_horizon, *found, _ = row
    result = Evaluation(*found)
    return EvaluationRow(
        iteration, bool(is_final), env_steps, desired_return, desired_horizon, result
    )
