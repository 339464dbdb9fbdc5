"""Killed services are restarted, and the result is the same."""

import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from udrl_proto.reports import Status
from whole_run import (
    SMALL,
    Cli,
    arguments,
    assert_conserved,
    children,
    digests,
    is_running,
    kill_at,
    live_status,
    small,
    wait_for,
)

BUDGET = 5000


@pytest.fixture(scope="module")
def undisturbed() -> dict[str, object]:
    return {}


@pytest.mark.parametrize(
    "kills",
    [
        pytest.param([("actor", 1), ("actor", 8)], marks=pytest.mark.slow),
        pytest.param([("learner", 1), ("learner", 9)], marks=pytest.mark.slow),
        pytest.param([("replay", 1), ("replay", 9)], marks=pytest.mark.slow),
        [("replay", 2), ("learner", 5), ("actor", 8)],
    ],
    ids=["actor", "learner", "replay", "each"],
)
def test_killed_services_are_restarted_and_the_result_is_the_same(
    kills: list[tuple[str, int]],
    cli: Callable[..., Cli],
    run: Callable[..., Status],
    tmp_path: Path,
    undisturbed: dict[str, object],
) -> None:
    run_dir = tmp_path / "disturbed"
    process = cli(*arguments(SMALL, BUDGET, run_dir), "--actors", "1")
    for role, iteration in kills:
        kill_at(process, run_dir, role, iteration)
    status = process.status()
    assert_conserved(status)
    assert status.exact
    if "digests" not in undisturbed:
        undisturbed["digests"] = digests(run(small(), BUDGET))
    assert digests(status) == undisturbed["digests"]


@pytest.mark.slow
def test_killed_run_resumes_from_its_directory(
    cli: Callable[..., Cli], run: Callable[..., Status], tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    process = cli(*arguments(SMALL, BUDGET, run_dir))
    wait_for(lambda: (s := live_status(run_dir)) and s.iteration >= 3, "iteration 3")
    services = children(process.process.pid)
    assert {"replay", "learner", "actor"} <= set(services)
    process.process.kill()
    for role, pid in services.items():
        wait_for(lambda pid=pid: not is_running(pid), f"{role} to end with its parent", timeout=5)  # type: ignore[misc]
    status = cli(*arguments(SMALL, BUDGET, run_dir), "--resume").status()
    assert digests(status) == digests(run(small(), BUDGET))


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_signal_ends_the_run_cleanly_and_it_can_be_resumed(
    number: signal.Signals, cli: Callable[..., Cli], run: Callable[..., Status], tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    process = cli(*arguments(SMALL, BUDGET, run_dir))
    wait_for(lambda: (s := live_status(run_dir)) and s.iteration >= 2, "iteration 2")
    services = children(process.process.pid)
    process.process.send_signal(number)
    code, _, error = process.finish(timeout=5)
    assert code == 128 + number
    assert "--resume" in error
    assert "Traceback" not in error
    assert not any(is_running(pid) for pid in services.values())
    status = cli(*arguments(SMALL, BUDGET, run_dir), "--resume").status()
    assert digests(status) == digests(run(small(), BUDGET))
