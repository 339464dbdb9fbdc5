"""A full disk stops the run; with free space, it resumes with the same result."""

import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from udrl.config import Budget
from udrl.errors import StoreError
from udrl_launch.local import Threads
from udrl_launch.settings import Fleet, Settings
from udrl_proto.reports import Status
from udrl_replay.creation import create_run, write_config
from whole_run import (
    SMALL,
    Cli,
    arguments,
    assert_conserved,
    digests,
    free_port,
    live_status,
    small,
    wait_for,
)

BUDGET = 6000


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of one megabyte; needs root."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "udrl-test", str(folder)]
    if os.geteuid() or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount a file system")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.mark.slow
def test_run_stops_on_a_full_disk_and_resumes_with_free_space(
    disk: Path, cli: Callable[..., Cli], run: Callable[..., Status]
) -> None:
    run_dir = disk / "run"
    ballast = disk / "ballast"
    ballast.write_bytes(bytes(400_000))
    code, _, error = cli(*arguments(SMALL, BUDGET, run_dir)).finish()
    assert code == 8, error
    assert "Traceback" not in error
    assert "free some disk space" in error
    stopped = live_status(run_dir)
    assert stopped is not None
    assert stopped.state == "stopped"
    assert_conserved(stopped)

    code, _, error = cli(*arguments(SMALL, BUDGET, run_dir), "--resume").finish()
    assert code == 8, error
    assert "Traceback" not in error

    ballast.unlink()
    subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True)
    status = cli(*arguments(SMALL, BUDGET, run_dir), "--resume").status()
    assert_conserved(status)
    assert digests(status) == digests(run(small(), BUDGET))


@pytest.mark.parametrize(
    "more_pages", [10, *(pytest.param(n, marks=pytest.mark.slow) for n in (4, 20, 40))]
)
def test_store_that_cannot_grow_keeps_its_ledgers_balanced(
    more_pages: int, run: Callable[..., Status], tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    settings = Settings(small(), Budget(max_env_steps=BUDGET), Fleet(actors=1, envs_per_actor=4))
    store = create_run(run_dir, settings.config)
    write_config(run_dir, settings.config, settings.budget)
    (pages,) = store._db.execute("PRAGMA page_count").fetchone()
    store._db.execute(f"PRAGMA max_page_count = {pages + more_pages}")
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    services = Threads(run_dir, store, settings, endpoint, insecure=False, keys=None)
    try:
        failure = wait_for(services.failure, "the run to end")
    finally:
        services.end()
    assert isinstance(failure, StoreError)
    assert "disk is full; nothing acknowledged is lost" in str(failure)
    stopped = live_status(run_dir)
    assert stopped is not None
    assert stopped.state == "stopped"
    assert_conserved(stopped)
    resumed = run(small(), BUDGET, run_dir=run_dir, resume=True)
    assert digests(resumed) == digests(run(small(), BUDGET))
