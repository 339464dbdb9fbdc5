"""Remedies for errors of writing."""

import resource
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from tests.replay.synthetic import create, reference, result, work
from udrl.config import Budget
from udrl.errors import StoreError
from udrl_replay.remedies import unwritable
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
