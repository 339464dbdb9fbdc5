"""Damaged files: detected or harmless, but never silently wrong."""

import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
from contextlib import closing
from pathlib import Path

import pytest

from tests.markdown import ROOT
from tests.replay.synthetic import BLOB, create, edit, finish, reference, result, work
from udrl.config import Budget
from udrl.errors import DamagedStore, OtherConfiguration
from udrl_proto.codec import LARGEST
from udrl_replay.database import STORE_FILE
from udrl_replay.run import StoredRun
from udrl_replay.schema import SEALED, seal
from udrl_replay.store import Store, Version

TABLES_THERE = [*SEALED, "bodies"]


@pytest.fixture
def written(tmp_path: Path) -> Path:
    """The closed file of a run that has ended, with episodes and weights of several pages."""
    with closing(create(tmp_path)) as store:
        finish(StoredRun(store, Budget(max_env_steps=60)))
        with store.transaction():
            store.add_version(Version(1000, b"digest", 0.5, BLOB, BLOB), 0.1)
            store.add_episode(store.buffer(1000)[0].entry._replace(id=10**9), b"digest", BLOB)
    return tmp_path / STORE_FILE


@pytest.fixture
def unfinished(tmp_path: Path) -> Path:
    """The closed file of an unfinished run with rows in all tables."""
    with closing(create(tmp_path, lead=1)) as store:
        run = StoredRun(store, Budget(max_env_steps=1000))
        for _ in range(8):
            work(run)
    return tmp_path / STORE_FILE


def read_everything(run_dir: Path) -> object:
    """Return all that a service can read from a store."""
    with closing(Store(run_dir)) as store:
        run = StoredRun(store, Budget(max_env_steps=60))
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
            store.last_evaluation(is_final=True),
        )


# Damage.


def test_damaged_page_is_detected_or_harmless(written: Path) -> None:
    whole = written.read_bytes()
    expected = read_everything(written.parent)
    size = int.from_bytes(whole[16:18], "big")
    detected = 0
    for start in range(0, len(whole), size):
        for junk in (bytes(size), b"\xa5" * size):
            written.write_bytes(whole[:start] + junk + whole[start + size :])
            try:
                assert read_everything(written.parent) == expected
            except DamagedStore:
                detected += 1
    written.write_bytes(whole)
    assert read_everything(written.parent) == expected
    assert detected > len(whole) // size


@pytest.mark.parametrize("left", [0, 1, 100, 5000, -4096, -1])
def test_truncated_file_is_detected(left: int, written: Path) -> None:
    written.write_bytes(written.read_bytes()[:left])
    with pytest.raises(DamagedStore, match=f"{written}: .*restore the run directory from a backup"):
        read_everything(written.parent)


def test_file_that_is_no_database_is_rejected(written: Path) -> None:
    written.write_text("These are not the episodes you are looking for. " * 100)
    with pytest.raises(DamagedStore, match=f"{written}: file is not a database"):
        Store(written.parent, read_only=True)


@pytest.mark.parametrize("blob", ["weights", "optimizer"])
def test_changed_weights_are_detected(blob: str, written: Path) -> None:
    changed = b"\x01" + BLOB[1:]
    edit(written, f"UPDATE versions SET {blob} = ? WHERE version = 1000", changed)
    with closing(Store(written.parent)) as store:
        assert store.version(1) is not None
        with pytest.raises(DamagedStore, match=f"{written}: weights version 1000 does not match"):
            store.version(1000)


def test_changed_weights_without_an_optimizer_are_detected(written: Path) -> None:
    with closing(Store(written.parent)) as store:
        with store.transaction():
            store.drop_optimizers(1001)
        kept = store.version(1000)
        assert kept is not None
        assert (kept.weights, kept.optimizer) == (BLOB, b"")
    edit(written, "UPDATE versions SET weights = x'00' WHERE version = 1000")
    with closing(Store(written.parent)) as store, pytest.raises(DamagedStore, match="version 1000"):
        store.version(1000)


def test_changed_episode_is_detected(written: Path) -> None:
    edit(written, "UPDATE bodies SET body = x'00' WHERE id = ?", 10**9)
    with (
        closing(Store(written.parent)) as store,
        pytest.raises(DamagedStore, match=f"{written}: episode {10**9} does not match"),
    ):
        store.episode_bodies([10**9], LARGEST)


@pytest.mark.parametrize(
    ("statement", "complaint"),
    [
        ("DELETE FROM facts WHERE name = 'hello'", "table facts has 3 rows that do not match"),
        ("DELETE FROM facts WHERE name = 'tallies'", "fact 'tallies' is missing in table facts"),
        ("UPDATE versions SET weights = NULL WHERE version = 1000", "table versions has "),
        ("UPDATE versions SET optimizer = NULL WHERE version = 1000", "table versions has "),
        ("UPDATE facts SET value = '{' WHERE name = 'progress'", "name 'progress' of facts does"),
        ("INSERT INTO commands VALUES (7, 0, x'c1', x'')", "id 7 of commands does not match"),
        ("UPDATE commands SET cancelled = 1 - cancelled", " of commands does not match its seal"),
        ("UPDATE episodes SET admitted = admitted + 1", " of episodes does not match"),
        ("DROP TABLE episodes", "no such table: episodes"),
    ],
)
def test_changed_row_is_reported(statement: str, complaint: str, written: Path) -> None:
    edit(written, statement)
    with pytest.raises(DamagedStore) as caught:
        read_everything(written.parent)
    assert str(written) in str(caught.value)
    assert complaint in str(caught.value)


@pytest.mark.parametrize(
    ("table", "column"), [(t, c) for t, columns in SEALED.items() for c in columns.split(", ")]
)
def test_changed_value_is_detected(table: str, column: str, written: Path) -> None:
    key = SEALED[table].split(",")[0]
    edit(
        written,
        f"UPDATE {table} SET {column} = CASE typeof({column}) WHEN 'text' THEN {column} || '!' "
        f"WHEN 'blob' THEN x'00' ELSE ifnull({column}, 0) + 77777 END "
        f"WHERE {key} = (SELECT min({key}) FROM {table})",
    )
    with pytest.raises(DamagedStore, match=f"{key} .* of {table} does not match its seal; restore"):
        read_everything(written.parent)


def keys_of(file: Path, table: str) -> list[tuple[object, ...]]:
    """Return the primary keys of a table's rows."""
    with closing(sqlite3.connect(file)) as db:
        columns = primary_key(db, table)
        return db.execute(f"SELECT {', '.join(columns)} FROM {table}").fetchall()


def primary_key(db: sqlite3.Connection, table: str) -> list[str]:
    rows = db.execute(f"PRAGMA table_info({table})").fetchall()
    return [name for _, name, *_, part in rows if part]


@pytest.mark.parametrize("read_only", [False, True])
@pytest.mark.parametrize("table", TABLES_THERE)
def test_missing_row_is_detected(table: str, read_only: bool, unfinished: Path) -> None:
    whole = unfinished.read_bytes()
    keys = keys_of(unfinished, table)
    assert keys
    with closing(sqlite3.connect(unfinished)) as db:
        this_row = " AND ".join(f"{column} = ?" for column in primary_key(db, table))
    for key in keys:
        edit(unfinished, f"DELETE FROM {table} WHERE {this_row}", *key)
        with pytest.raises(DamagedStore, match=f"{unfinished}: .*{table}.*; restore the run dir"):
            Store(unfinished.parent, read_only=read_only).close()
        unfinished.write_bytes(whole)
    Store(unfinished.parent, read_only=read_only).close()


@pytest.mark.parametrize("table", TABLES_THERE)
def test_foreign_row_is_detected(table: str, unfinished: Path) -> None:
    """Its seal is correct, like that of another run's row."""
    with closing(sqlite3.connect(unfinished)) as db, db:
        db.create_function("seal", -1, seal)
        key, *_ = primary_key(db, table)
        columns = [name for _, name, *_ in db.execute(f"PRAGMA table_info({table})")]
        other = "'other'" if table == "facts" else f"{key} + 7777777"
        there = {c: other if c == key else c for c in columns}
        if "seal" in there:
            covered = [there[column] for column in SEALED[table].split(", ")]
            there["seal"] = f"seal({', '.join(covered)})"
        values = ", ".join(there.values())
        db.execute(f"INSERT INTO {table} SELECT {values} FROM {table} LIMIT 1")
    with pytest.raises(DamagedStore, match=f"table {table} has "):
        Store(unfinished.parent)


def test_restored_old_table_is_detected(tmp_path: Path) -> None:
    """All its rows were written by this run, and their number is the same."""

    def work_on(store: Store) -> None:
        run = StoredRun(store, Budget(max_env_steps=1000))
        work(run)
        while len(run.open_commands()) != 3:
            work(run)

    with closing(create(tmp_path)) as store:
        work_on(store)
    file = tmp_path / STORE_FILE
    edit(file, "CREATE TABLE before AS SELECT * FROM commands")
    with closing(Store(tmp_path)) as store:
        work_on(store)
    edit(file, "DELETE FROM commands")
    edit(file, "INSERT INTO commands SELECT * FROM before")
    with pytest.raises(DamagedStore, match="table commands has 3 rows that do not match the 3"):
        Store(tmp_path)


def test_flipped_bits_are_detected_or_harmless(written: Path) -> None:
    chance = random.Random(1)
    whole = written.read_bytes()
    expected = read_everything(written.parent)
    detected = 0
    for _ in range(300):
        broken = bytearray(whole)
        broken[chance.randrange(len(broken))] ^= 1 << chance.randrange(8)
        written.write_bytes(broken)
        try:
            assert read_everything(written.parent) == expected
        except (DamagedStore, OtherConfiguration) as error:
            assert str(written) in str(error)  # noqa: PT017 - either outcome is correct
            detected += 1
    assert detected > 100


def test_file_truncated_anywhere_is_detected(written: Path) -> None:
    chance = random.Random(2)
    whole = written.read_bytes()
    for _ in range(50):
        written.write_bytes(whole[: chance.randrange(len(whole))])
        with pytest.raises(DamagedStore, match="restore the run directory from a backup"):
            read_everything(written.parent)


def test_damaged_journal_costs_work_but_changes_no_result(tmp_path: Path) -> None:
    chance = random.Random(3)
    with closing(create(tmp_path / "whole")) as store:
        run = StoredRun(store, Budget(max_env_steps=60))
        for _ in range(5):
            work(run)
        for number in range(20):  # the state after a power cut: the file and its journal
            shutil.copytree(tmp_path / "whole", tmp_path / f"cut{number}")
    for number in range(20):
        journal = tmp_path / f"cut{number}" / f"{STORE_FILE}-wal"
        held = bytearray(journal.read_bytes())
        assert held
        if number % 2:
            del held[chance.randrange(len(held)) :]
        else:
            held[chance.randrange(len(held))] ^= 1 << chance.randrange(8)
        journal.write_bytes(held)
        with closing(Store(tmp_path / f"cut{number}")) as store:
            run = StoredRun(store, Budget(max_env_steps=60))
            finish(run)
            assert result(run) == reference(0, 60)


_WRITER = """
import sys
from pathlib import Path
from tests.replay.synthetic import work
from udrl.config import Budget
from udrl_replay.run import StoredRun
from udrl_replay.store import Store

run = StoredRun(Store(Path(sys.argv[1])), Budget(max_env_steps=3000))
while run.progress.state in ("running", "finishing"):
    work(run)
    print(run.progress.accepted, flush=True)
"""


def test_writer_killed_at_any_time_loses_nothing_acknowledged(tmp_path: Path) -> None:
    chance = random.Random(4)
    create(tmp_path).close()
    acknowledged = 0
    for _ in range(4):
        with subprocess.Popen(
            [sys.executable, "-c", _WRITER, str(tmp_path)],
            cwd=ROOT,
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
            stdout=subprocess.PIPE,
            text=True,
        ) as writer:
            assert writer.stdout is not None
            first = writer.stdout.readline()
            threading.Event().wait(chance.uniform(0.0, 0.2))
            writer.send_signal(signal.SIGKILL)
            lines = [first, *writer.stdout]
        acknowledged = int([line for line in lines if line.endswith("\n")][-1])
        with closing(Store(tmp_path)) as store:
            run = StoredRun(store, Budget(max_env_steps=3000))
            assert run.progress.accepted >= acknowledged
            assert run.progress.issued == run.progress.accepted + len(run.dispatcher.outstanding)
            assert run.progress.state == "running"
    with closing(Store(tmp_path)) as store:
        run = StoredRun(store, Budget(max_env_steps=3000))
        finish(run)
        assert result(run) == reference(0, 3000)
    assert acknowledged
