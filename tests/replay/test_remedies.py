"""Remedies for errors of writing."""

import resource
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from tests.replay.synthetic import create, reference, result, work
from udrl.config import Budget
from udrl.errors import StoreError
from udrl_replay.database import STORE_FILE
from udrl_replay.remedies import database_remedy, unwritable
from udrl_replay.reporting import MetricsFile
from udrl_replay.run import StoredRun
from udrl_replay.store import Store

MORE_FILES = "raise the limit of open files, e.g. ulimit -n 4096"


@contextmanager
def no_more_files() -> Iterator[None]:
    """Exhaust this process's file descriptors."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_too_many_open_files_are_not_reported_as_a_full_disk(tmp_path: Path) -> None:
    with closing(create(tmp_path)) as store:
        pass
    for read_only in (False, True):
        with no_more_files(), pytest.raises(StoreError) as no:
            Store(tmp_path, read_only=read_only)
        assert MORE_FILES in str(no.value)
    with closing(Store(tmp_path)) as store, no_more_files():
        with pytest.raises(StoreError, match=MORE_FILES):
            MetricsFile(tmp_path, store)
        with pytest.raises(StoreError, match=MORE_FILES):
            create(tmp_path / "another")


def test_full_disk_is_reported(tmp_path: Path) -> None:
    error = unwritable(tmp_path / "file", OSError(28, "No space left on device"))
    assert "No space left on device; free some disk space, and restart with" in str(error)


def test_forbidden_file_is_not_reported_as_a_full_disk(tmp_path: Path) -> None:
    error = unwritable(tmp_path / "file", PermissionError(13, "Permission denied"))
    assert "make the file and its directory readable and writable, and restart with" in str(error)


def test_full_disk_is_not_reported_as_a_directory_that_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def replace(self: Path, target: Path) -> Path:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", replace)
    with pytest.raises(StoreError, match=r"No space left on device; free some disk space$"):
        create(tmp_path / "run")


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with closing(create(tmp_path)) as made:
        yield made


def set_fact(store: Store, value: str = "x") -> None:
    with store.transaction():
        store.set_fact("name", value)


def test_locked_file_is_not_reported_as_a_full_disk(store: Store, tmp_path: Path) -> None:
    store._db.execute("PRAGMA busy_timeout = 0")
    with closing(sqlite3.connect(tmp_path / STORE_FILE, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreError) as locked:
            set_fact(store)
    assert str(locked.value) == (
        f"{tmp_path / STORE_FILE} cannot be used: database is locked; nothing acknowledged is "
        "lost: close the other program that uses the file, and restart with --resume"
    )


def test_file_that_cannot_be_written_is_not_reported_as_a_full_disk(store: Store) -> None:
    store._db.execute("PRAGMA query_only = ON")
    with pytest.raises(StoreError, match=r"readonly database; .*: make the file and its directory"):
        set_fact(store)


def test_run_with_too_large_a_row_is_not_resumed(store: Store) -> None:
    store._db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, 1000)
    with pytest.raises(StoreError, match=r"too big; .*: a row has at most 1 GB; start a") as big:
        set_fact(store, "x" * 2000)
    assert "--resume" not in str(big.value)


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        (sqlite3.SQLITE_FULL, "free some disk space, and "),
        (sqlite3.SQLITE_IOERR_WRITE, "repair the disk, or raise its quota, and "),
        (sqlite3.SQLITE_CANTOPEN, "make the file and its directory readable and writable, and "),
        (sqlite3.SQLITE_READONLY_CANTINIT, "make the file and its directory readable and"),
        (sqlite3.SQLITE_BUSY_SNAPSHOT, "close the other program that uses the file, and "),
        (sqlite3.SQLITE_MISUSE, "check the disk and the file, and "),
    ],
)
def test_remedy_fits_the_code(code: int, expected: str) -> None:
    error = sqlite3.OperationalError("no")
    error.sqlite_errorcode = code
    for read_only, then in ((True, "and try again"), (False, "and restart with --resume")):
        found = database_remedy(error, read_only=read_only)
        assert found.startswith(expected)
        assert found.endswith(then)


def test_reader_is_not_to_resume_the_run(store: Store, tmp_path: Path) -> None:
    with closing(Store(tmp_path, read_only=True)) as reader:
        reader._db.close()
        with pytest.raises(StoreError) as no:
            reader.fact("schema", int)
    assert str(no.value) == (
        f"{tmp_path / STORE_FILE} cannot be read: Cannot operate on a closed database.; check the "
        "disk and the file, and try again"
    )


def test_running_service_opens_no_more_files(tmp_path: Path) -> None:
    with (
        closing(create(tmp_path)) as store,
        closing(MetricsFile(tmp_path, store)) as metrics,
        no_more_files(),
    ):
        run = StoredRun(store, Budget(max_env_steps=300))
        while run.progress.state in ("running", "finishing"):
            work(run)
            metrics.update(run.progress.iteration)
        assert result(run) == reference(0, 300)
