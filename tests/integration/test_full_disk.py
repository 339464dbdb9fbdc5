"""A disk that fills up stops the run; with space again it goes on as if nothing had been."""

import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from udrl_proto.messages import Status
from whole_run import SMALL, Cli, arguments, assert_conserved, digests, live_status, small

BUDGET = 6000


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of one megabyte; only root may make one."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "udrl-test", str(folder)]
    if os.geteuid() or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount a file system")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def test_run_whose_disk_is_full_stops_and_goes_on_with_more_space(
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
    assert stopped.state == "running"
    assert_conserved(stopped)

    code, _, error = cli(*arguments(SMALL, BUDGET, run_dir), "--resume").finish()
    assert code == 8, error
    assert "Traceback" not in error

    ballast.unlink()
    subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True)
    status = cli(*arguments(SMALL, BUDGET, run_dir), "--resume").status()
    assert_conserved(status)
    assert digests(status) == digests(run(small(), BUDGET))
