"""The file of a run: whole or not there, one writer, and never silently wrong."""

import sqlite3
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from pathlib import Path

import pytest

from tests.replay.synthetic import create, finish, reference, result, work
from udrl.config import Budget
from udrl.errors import DamagedStore, OtherConfiguration, RunInUse, StoreError
from udrl.evaluation import summarise
from udrl_proto.codec import LARGEST
from udrl_replay.run import Run
from udrl_replay.store import FILE, EvaluationRow, Store, Version

BLOB = bytes(range(256)) * 40


@pytest.fixture
def store(stack: ExitStack, tmp_path: Path) -> Store:
    return stack.enter_context(closing(create(tmp_path)))


@pytest.fixture
def written(tmp_path: Path) -> Path:
    """The closed file of a run that has ended, with episodes and weights of several pages."""
    with closing(create(tmp_path)) as store:
        finish(Run(store, Budget(max_env_steps=60)))
        with store.transaction():
            store.add_version(Version(1000, b"digest", 0.5, BLOB, BLOB), 0.1)
            store.add_episode(store.buffer(1000)[0].entry._replace(id=10**9), b"digest", BLOB)
    return tmp_path / FILE


def edit(path: Path, statement: str, *values: object) -> None:
    with closing(sqlite3.connect(path)) as db, db:
        db.execute(statement, values)


def read_everything(run_dir: Path) -> object:
    """Return all that a service can ask a store for."""
    with closing(Store(run_dir)) as store:
        run = Run(store, Budget(max_env_steps=60))
        ids = [*(e.id for e in run.buffer), 10**9]
        return (
            run.progress,
            run.hello,
            [store.buffer(iteration) for iteration in range(run.progress.iteration + 1)],
            store.episode_bodies(ids, LARGEST),
            [store.version(v) for v in range(1001)],
            store.commands(cancelled=True),
            store.commands(cancelled=False),
            store.metrics(-1),
            store.last_evaluation(closing=True),
        )


# Creation.


def test_new_file_holds_its_facts_at_once(tmp_path: Path) -> None:
    with closing(Store.create(tmp_path, answer=42)) as store:
        assert store.fact("answer", int) == 42
    assert not list(tmp_path.glob("*.new"))


def test_creation_that_fails_leaves_no_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def rename(self: Path, target: Path) -> Path:
        raise OSError("no space left")

    monkeypatch.setattr(Path, "rename", rename)
    with pytest.raises(StoreError, match=r"no space left; name one you may write"):
        Store.create(tmp_path)
    with pytest.raises(StoreError, match="holds no run"):
        Store(tmp_path)
    monkeypatch.undo()
    create(tmp_path).close()


def test_existing_run_is_not_overwritten(tmp_path: Path) -> None:
    create(tmp_path).close()
    before = (tmp_path / FILE).read_bytes()
    with pytest.raises(StoreError, match="holds a run already; add --resume"):
        create(tmp_path)
    assert (tmp_path / FILE).read_bytes() == before


def test_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StoreError, match=r"run directory .*file/run: .*name one you may write"):
        create(tmp_path / "file" / "run")


def test_folder_without_a_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=rf"{tmp_path} holds no run \({FILE} is missing\)"):
        Store(tmp_path)


@pytest.mark.parametrize("name", ["a b", "what?", "100%", "run#1", "läufe"])
def test_folder_may_have_any_name(name: str, tmp_path: Path) -> None:
    create(tmp_path / name).close()
    with closing(Store(tmp_path / name)) as store:
        assert store.fact("schema", int) == 1
    assert (tmp_path / name / FILE).exists()


# Who may open it.


def test_second_writer_is_refused(store: Store, tmp_path: Path) -> None:
    with pytest.raises(RunInUse, match=f"{tmp_path} is in use by another replay service"):
        Store(tmp_path)
    with pytest.raises(RunInUse):
        create(tmp_path)


def test_file_is_free_again_after_its_writer_closed_it(store: Store, tmp_path: Path) -> None:
    store.close()
    Store(tmp_path).close()


def test_reader_beside_a_writer_sees_one_moment(store: Store, tmp_path: Path) -> None:
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


def test_file_of_another_schema_is_refused(tmp_path: Path) -> None:
    create(tmp_path).close()
    edit(tmp_path / FILE, "UPDATE facts SET value = '99' WHERE name = 'schema'")
    with pytest.raises(OtherConfiguration, match=r"schema 99, this version of udrl reads 1; use"):
        Store(tmp_path)
    # The refusal has let go of the lock.
    edit(tmp_path / FILE, "UPDATE facts SET value = '1' WHERE name = 'schema'")
    Store(tmp_path).close()


# Transactions.


class Stop(Exception):
    pass


def test_transaction_that_is_left_by_an_error_changes_nothing(store: Store) -> None:
    with suppress(Stop), store.transaction():
        store.set_fact("answer", 42)
        raise Stop
    with pytest.raises(DamagedStore, match="'answer' is missing"):
        store.fact("answer", int)
    with store.transaction():
        store.set_fact("answer", 43)
    assert store.fact("answer", int) == 43


def limit_size(store: Store, more_pages: int) -> None:
    """Let the file grow by so many pages and no further, as if the disk were full then."""
    (pages,) = store._db.execute("PRAGMA page_count").fetchone()
    store._db.execute(f"PRAGMA max_page_count = {pages + more_pages}")


def write(store: Store) -> None:
    with store.transaction():
        store.set_fact("answer", 42)
        store.add_version(Version(1, b"d", 0.5, BLOB, BLOB), 0.1)


def test_full_disk_is_reported_and_nothing_is_half_written(store: Store) -> None:
    limit_size(store, 3)
    with pytest.raises(StoreError, match=r"disk is full; nothing acknowledged is lost: free some"):
        write(store)
    assert store.version(1) is None
    with pytest.raises(DamagedStore, match="'answer' is missing"):
        store.fact("answer", int)
    limit_size(store, 100)
    write(store)
    assert store.version(1) == Version(1, b"d", 0.5, BLOB, BLOB)


def test_run_goes_on_after_a_full_disk_as_if_it_had_not_been_full(tmp_path: Path) -> None:
    with closing(create(tmp_path)) as store:
        run = Run(store, Budget(max_env_steps=600))
        work(run)
        limit_size(store, 0)
        with pytest.raises(StoreError, match="disk is full"):
            finish(run)
    with closing(Store(tmp_path)) as store:
        run = Run(store, Budget(max_env_steps=600))
        finish(run)
        assert result(run) == reference(0, 600)


# Damage.


def test_damaged_file_is_told_or_harmless_whichever_page_is_hit(written: Path) -> None:
    whole = written.read_bytes()
    expected = read_everything(written.parent)
    size = int.from_bytes(whole[16:18], "big")
    told = 0
    for start in range(0, len(whole), size):
        for junk in (bytes(size), b"\xa5" * size):
            written.write_bytes(whole[:start] + junk + whole[start + size :])
            try:
                assert read_everything(written.parent) == expected
            except DamagedStore:
                told += 1
    written.write_bytes(whole)
    assert read_everything(written.parent) == expected
    assert told > len(whole) // size


@pytest.mark.parametrize("left", [0, 1, 100, 5000, -4096, -1])
def test_truncated_file_is_named(left: int, written: Path) -> None:
    written.write_bytes(written.read_bytes()[:left])
    with pytest.raises(DamagedStore, match=f"{written}: .*restore the run directory from a backup"):
        read_everything(written.parent)


def test_file_that_is_no_database_is_named(written: Path) -> None:
    written.write_text("These are not the episodes you are looking for. " * 100)
    with pytest.raises(DamagedStore, match=f"{written}: file is not a database"):
        Store(written.parent, read_only=True)


@pytest.mark.parametrize("blob", ["weights", "optimizer"])
def test_changed_weights_are_noticed(blob: str, written: Path) -> None:
    changed = b"\x01" + BLOB[1:]
    edit(written, f"UPDATE versions SET {blob} = ? WHERE version = 1000", changed)
    with closing(Store(written.parent)) as store:
        assert store.version(1) is not None
        with pytest.raises(DamagedStore, match=f"{written}: weights version 1000 is not what was"):
            store.version(1000)


def test_changed_weights_without_an_optimizer_are_noticed(written: Path) -> None:
    with closing(Store(written.parent)) as store:
        with store.transaction():
            store.drop_optimizers(1001)
        kept = store.version(1000)
        assert kept is not None
        assert (kept.weights, kept.optimizer) == (BLOB, b"")
    edit(written, "UPDATE versions SET weights = x'00' WHERE version = 1000")
    with closing(Store(written.parent)) as store, pytest.raises(DamagedStore, match="version 1000"):
        store.version(1000)


def test_changed_episode_is_noticed(written: Path) -> None:
    edit(written, "UPDATE episodes SET body = x'00' WHERE id = ?", 10**9)
    with (
        closing(Store(written.parent)) as store,
        pytest.raises(DamagedStore, match=f"{written}: episode {10**9} is not what was written"),
    ):
        store.episode_bodies([10**9], LARGEST)


@pytest.mark.parametrize(
    ("statement", "complaint"),
    [
        ("DELETE FROM facts WHERE name = 'hello'", "fact 'hello' is missing"),
        ("UPDATE facts SET value = '{' WHERE name = 'progress'", "fact 'progress': "),
        ("UPDATE facts SET value = '{\"x\": 1}' WHERE name = 'progress'", "unknown field `x`"),
        ("INSERT INTO commands VALUES (7, 0, x'c1')", "a command: "),
        ("DROP TABLE episodes", "no such table: episodes"),
    ],
)
def test_changed_rows_are_named(statement: str, complaint: str, written: Path) -> None:
    edit(written, statement)
    with pytest.raises(DamagedStore) as caught:
        read_everything(written.parent)
    assert str(written) in str(caught.value)
    assert complaint in str(caught.value)


# What it keeps.


def test_page_of_episodes_is_bounded_but_never_empty(store: Store, tmp_path: Path) -> None:
    run = Run(store, Budget(max_env_steps=1000))
    work(run)
    ids = [e.id for e in run.buffer]
    bodies = store.episode_bodies(ids, LARGEST)
    assert len(bodies) == len(ids) == 4
    assert store.episode_bodies(ids, len(bodies[0]) + len(bodies[1])) == bodies[:2]
    assert store.episode_bodies(ids, 1) == bodies[:1]


def test_page_of_episodes_ends_before_one_that_is_not_kept(store: Store) -> None:
    run = Run(store, Budget(max_env_steps=1000))
    work(run)
    first, second, *_ = [e.id for e in run.buffer]
    assert len(store.episode_bodies([first, 999, second], LARGEST)) == 1
    assert store.episode_bodies([999], LARGEST) == []


def test_last_evaluation_is_of_its_sort(store: Store) -> None:
    assert store.last_evaluation(closing=False) is None
    rows = [
        EvaluationRow(iteration, closing, 10 * iteration, 1.5, 3, summarise([1.0, 2.0]))
        for iteration, closing in [(2, False), (7, False), (9, True)]
    ]
    with store.transaction():
        for row in rows:
            store.add_evaluation(row)
    assert store.last_evaluation(closing=False) == rows[1]
    assert store.last_evaluation(closing=True) == rows[2]


def test_forgotten_blobs_leave_digest_and_loss(store: Store) -> None:
    with store.transaction():
        store.add_version(Version(3, b"digest", 0.25, b"w", b"o"), 0.1)
        store.drop_weights([3])
    assert store.version(3) == Version(3, b"digest", 0.25, b"", b"")
    assert store.versions_kept() == []


@pytest.mark.parametrize("ask", [lambda s: s.version(9), lambda s: s.episode_digest(9)])
def test_what_was_never_there_is_none(ask: Callable[[Store], object], store: Store) -> None:
    assert ask(store) is None
