"""One SQLite file per run, the only thing in the system that is worth saving.

What it holds is described in :mod:`udrl_replay.schema`, and how it is kept in
:mod:`udrl_replay.database`.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import msgspec

from udrl.commands import Command
from udrl.config import COMMANDS_PER_ITERATION
from udrl.evaluation import Evaluation
from udrl.replay import Entry
from udrl_proto.reports import IterationStatus
from udrl_replay.database import Database
from udrl_replay.schema import SEALED, sha256

_FIELDS = IterationStatus.__struct_fields__
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
#: Of ``metrics.csv``.
COLUMNS = (*_FIELDS, *EVALUATION_COLUMNS)


class StoredEpisode(NamedTuple):
    """An episode in the store, without its steps."""

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


class Store(Database):
    """Commands, episodes, iterations, evaluations and weights versions of one run.

    Reading raises :class:`~udrl.errors.DamagedStore` where the file is not what was written.
    """

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

    def buffer(self, iteration: int) -> list[StoredEpisode]:
        """Return the buffer as it was after an iteration, least return first."""
        rows = self._rows(
            "SELECT episode_return, id, length, digest FROM episodes "
            "WHERE admitted <= ? AND (evicted IS NULL OR evicted > ?) ORDER BY episode_return, id",
            (iteration, iteration),
        )
        return [StoredEpisode(Entry(*entry), digest) for *entry, digest in rows]

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

    def add_iteration(self, done: IterationStatus) -> None:
        """Add a completed iteration."""
        self._insert("iterations", *msgspec.structs.astuple(done))

    def iterations(self, after: int, limit: int) -> list[IterationStatus]:
        """Return the first completed iterations after one."""
        rows = self._rows(
            f"SELECT {SEALED['iterations']} FROM iterations "  # noqa: S608
            "WHERE iteration > ? ORDER BY iteration LIMIT ?",
            (after, limit),
        )
        return [IterationStatus(**dict(zip(_FIELDS, row, strict=True))) for row in rows]

    def issued_in(self, iteration: int) -> int:
        """Return how many commands a completed iteration had."""
        rows = self._rows("SELECT commands FROM iterations WHERE iteration = ?", (iteration,))
        return int(rows[0][0]) if rows else 0

    def loss_of(self, version: int) -> float | None:
        """Return the loss that a version was trained with; version 0 has none."""
        rows = self._rows("SELECT loss FROM versions WHERE version = ?", (version,))
        return float(rows[0][0]) if rows else None

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

    def metrics(self, after: int) -> list[tuple[Any, ...]]:
        """Return the rows of ``metrics.csv`` of iterations after ``after``; -1: all of them."""
        columns = [f"i.{c}" for c in _FIELDS] + [f"e.{c}" for c in EVALUATION_COLUMNS.values()]
        return self._rows(
            f"SELECT {', '.join(columns)} FROM iterations i "  # noqa: S608
            "LEFT JOIN evaluations e ON e.iteration = i.iteration AND e.closing = 0 "
            "WHERE i.iteration > ? ORDER BY i.iteration",
            (after,),
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

    def state(self, version: int) -> Version:
        """Return the version that a learner goes on from, with its optimizer.

        Raises:
            DamagedStore: it is not there as a whole, or not what was written.
        """
        found = self.version(version)
        if found is None or not (found.weights and found.optimizer):
            raise self._damaged(f"weights version {version}, the latest, is gone")
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
