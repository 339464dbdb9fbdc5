"""An environment that fails costs an episode's time, or stops the run and says which command."""

from collections.abc import Callable
from pathlib import Path

import pytest

import flaky_environments
from udrl.errors import EnvironmentFault, RunFailed
from udrl_launch.inspection import reproduce
from udrl_proto.messages import Status
from whole_run import digests, live_status, small


def test_environment_that_raises_now_and_then_changes_nothing(run: Callable[..., Status]) -> None:
    flaky_environments.Flaky.raised_for.clear()
    flaky = run(small(environment="flaky_environments:Flaky-v0"), 2000, actors=2)
    assert flaky.env_failures == len(flaky_environments.Flaky.raised_for) > 10
    assert digests(flaky) == digests(run(small(), 2000))


def test_command_that_always_fails_stops_the_run_and_can_be_reproduced(
    run: Callable[..., Status], tmp_path: Path
) -> None:
    run_dir = tmp_path / "cursed"
    cursed = small(environment="flaky_environments:Cursed-v0")
    with pytest.raises(RunFailed, match=r"udrl reproduce RUN_DIR \d+"):
        run(cursed, 2000, run_dir=run_dir, actors=2)
    status = live_status(run_dir)
    assert status is not None
    assert status.state == "failed"
    command_id = int(status.problem.split("command ")[1].split()[0])
    with pytest.raises(EnvironmentFault, match="is cursed"):
        reproduce(run_dir, command_id)
