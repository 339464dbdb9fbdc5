"""The file of a run: atomic creation, one writer, transactions."""

import errno
import fcntl
import os
import sqlite3
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from pathlib import Path

import pytest

from tests.replay.synthetic import BLOB, create, edit, finish, reference, result, work
from udrl.config import Budget
from udrl.errors import DamagedStore, OtherConfiguration, RunInUse, StoreError
from udrl.evaluation import summarise
from udrl_proto.codec import LARGEST
from udrl_replay.database import STORE_FILE
from udrl_replay.run import StoredRun
from udrl_replay.schema import SCHEMA
from udrl_replay.store import EvaluationRow, Store, Version


@pytest.fixture
def store(stack: ExitStack, tmp_path: Path) -> Store:
    return stack.enter_context(closing(create(tmp_path)))


# Creation.


def test_new_file_has_its_facts(tmp_path: Path) -> None:
    with closing(Store.create(tmp_path, answer=42)) as store:
        assert store.fact("answer", int) == 42
    assert not list(tmp_path.glob("*.part"))


def test_failed_creation_leaves_no_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def replace(self: Path, target: Path) -> Path:
        raise OSError(errno.ENOSPC, "no space left")

    monkeypatch.setattr(Path, "replace", replace)
    with pytest.raises(StoreError, match=r": no space left; free some disk space"):
        Store.create(tmp_path)
    with pytest.raises(StoreError, match="holds no run"):
        Store(tmp_path)
    monkeypatch.undo()
    create(tmp_path).close()


def test_existing_run_is_not_overwritten(tmp_path: Path) -> None:
    create(tmp_path).close()
    before = (tmp_path / STORE_FILE).read_bytes()
    with pytest.raises(StoreError, match="holds a run already; add --resume"):
        create(tmp_path)
    assert (tmp_path / STORE_FILE).read_bytes() == before


def test_folder_that_cannot_be_created_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StoreError, match=r"run directory .*file/run: .*use a writable directory"):
        create(tmp_path / "file" / "run")


def test_folder_without_a_run_is_reported(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=rf"{tmp_path} holds no run \({STORE_FILE} is missing\)"):
        Store(tmp_path)


def test_folder_in_place_of_the_file_is_reported(tmp_path: Path) -> None:
    (tmp_path / STORE_FILE).mkdir()
    with pytest.raises(StoreError, match=rf"holds no run \({STORE_FILE} is not a file\)"):
        Store(tmp_path)
    assert not (tmp_path / "lock").exists()


@pytest.mark.parametrize("name", ["a b", "what?", "100%", "run#1", "läufe"])
def test_folder_may_have_any_name(name: str, tmp_path: Path) -> None:
    create(tmp_path / name).close()
    with closing(Store(tmp_path / name)) as store:
        assert store.fact("schema", int) == SCHEMA
    assert (tmp_path / name / STORE_FILE).exists()


# Locks and permissions.


def test_second_writer_is_refused(store: Store, tmp_path: Path) -> None:
    with pytest.raises(RunInUse, match=f"{tmp_path} is in use by another replay service"):
        Store(tmp_path)
    with pytest.raises(RunInUse):
        create(tmp_path)


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.ENOTSUP])
def test_file_system_without_locks_is_not_reported_as_a_second_writer(
    code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def flock(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", flock)
    expected = rf"{tmp_path} cannot be locked: .* not support locks \(.*\); use a --run-dir on a"
    with pytest.raises(StoreError, match=expected) as refused:
        create(tmp_path)
    assert not isinstance(refused.value, RunInUse)


def test_file_can_be_reopened_after_its_writer_closed_it(store: Store, tmp_path: Path) -> None:
    store.close()
    Store(tmp_path).close()


def test_reader_sees_a_consistent_snapshot(store: Store, tmp_path: Path) -> None:
    with closing(Store(tmp_path, read_only=True)) as reader:
        with store.transaction():
            store.set_fact("answer", 42)
        with pytest.raises(DamagedStore, match="'answer' is missing"):
            reader.fact("answer", int)
    with closing(Store(tmp_path, read_only=True)) as reader:
        assert reader.fact("answer", int) == 42


def test_reader_cannot_write(store: Store, tmp_path: Path) -> None:
    with (
        closing(Store(tmp_path, read_only=True)) as reader,
        pytest.raises(sqlite3.OperationalError, match="readonly"),
    ):
        reader.set_fact("answer", 42)


def test_file_of_another_schema_is_rejected(tmp_path: Path) -> None:
    create(tmp_path).close()
    edit(tmp_path / STORE_FILE, "UPDATE facts SET value = '99' WHERE name = 'schema'")
    other = f"schema 99, this version of udrl reads {SCHEMA}; use"
    with pytest.raises(OtherConfiguration, match=other):
        Store(tmp_path)
    # The failed attempt has released the lock.
    edit(tmp_path / STORE_FILE, "UPDATE facts SET value = ? WHERE name = 'schema'", b"%d" % SCHEMA)
    Store(tmp_path).close()


# Transactions.


class Stop(Exception):
    pass


def test_transaction_that_raises_changes_nothing(store: Store) -> None:
    with suppress(Stop), store.transaction():
        store.set_fact("answer", 42)
        raise Stop
    with pytest.raises(DamagedStore, match="'answer' is missing"):
        store.fact("answer", int)
    with store.transaction():
        store.set_fact("answer", 43)
    assert store.fact("answer", int) == 43


def limit_size(store: Store, more_pages: int) -> None:
    """Limit the growth of the file, as a full disk does."""
    (pages,) = store._db.execute("PRAGMA page_count").fetchone()
    store._db.execute(f"PRAGMA max_page_count = {pages + more_pages}")


def write(store: Store) -> None:
    with store.transaction():
        store.set_fact("answer", 42)
        store.add_version(Version(1, b"d", 0.5, BLOB, BLOB), 0.1)


def test_full_disk_is_reported_and_rolls_back(store: Store) -> None:
    limit_size(store, 3)
    with pytest.raises(StoreError, match=r"disk is full; nothing acknowledged is lost: free some"):
        write(store)
    assert store.version(1) is None
    with pytest.raises(DamagedStore, match="'answer' is missing"):
        store.fact("answer", int)
    limit_size(store, 100)
    write(store)
    assert store.version(1) == Version(1, b"d", 0.5, BLOB, BLOB)


def test_run_resumes_after_a_full_disk_with_the_same_result(tmp_path: Path) -> None:
    with closing(create(tmp_path)) as store:
        run = StoredRun(store, Budget(max_env_steps=600))
        work(run)
        limit_size(store, 0)
        with pytest.raises(StoreError, match="disk is full"):
            finish(run)
    with closing(Store(tmp_path)) as store:
        run = StoredRun(store, Budget(max_env_steps=600))
        finish(run)
        assert result(run) == reference(0, 600)


# Queries.


def test_page_of_episodes_is_bounded_but_never_empty(store: Store, tmp_path: Path) -> None:
    run = StoredRun(store, Budget(max_env_steps=1000))
    work(run)
    ids = [e.id for e in run.buffer]
    bodies = store.episode_bodies(ids, LARGEST)
    assert len(bodies) == len(ids) == 4
    assert store.episode_bodies(ids, len(bodies[0]) + len(bodies[1])) == bodies[:2]
    assert store.episode_bodies(ids, 1) == bodies[:1]


def test_page_of_episodes_ends_before_a_missing_one(store: Store) -> None:
    run = StoredRun(store, Budget(max_env_steps=1000))
    work(run)
    first, second, *_ = [e.id for e in run.buffer]
    assert len(store.episode_bodies([first, 999, second], LARGEST)) == 1
    assert store.episode_bodies([999], LARGEST) == []


def test_last_evaluation_is_of_the_requested_kind(store: Store) -> None:
    assert store.last_evaluation(is_final=False) is None
    rows = [
        EvaluationRow(iteration, closing, 10 * iteration, 1.5, 3, summarise([1.0, 2.0]))
        for iteration, closing in [(2, False), (7, False), (9, True)]
    ]
    with store.transaction():
        for row in rows:
            store.add_evaluation(row)
    assert store.last_evaluation(is_final=False) == rows[1]
    assert store.last_evaluation(is_final=True) == rows[2]


def test_dropped_weights_leave_digest_and_loss(store: Store) -> None:
    with store.transaction():
        store.add_version(Version(3, b"digest", 0.25, b"w", b"o"), 0.1)
        store.drop_weights([3])
    assert store.version(3) == Version(3, b"digest", 0.25, b"", b"")
    assert store.versions_kept() == []


@pytest.mark.parametrize("ask", [lambda s: s.version(9), lambda s: s.episode_digest(9)])
def test_unknown_id_is_none(ask: Callable[[Store], object], store: Store) -> None:
    assert ask(store) is None


def test_incomplete_latest_version_is_damage(store: Store) -> None:
    with pytest.raises(DamagedStore, match="weights version 3, the latest, is missing"):
        store.state(3)
    whole = Version(3, b"digest", 0.25, b"w", b"o")
    with store.transaction():
        store.add_version(whole, 0.1)
    assert store.state(3) == whole
    with store.transaction():
        store.drop_optimizers(4)
    with pytest.raises(DamagedStore, match="weights version 3"):
        store.state(3)
