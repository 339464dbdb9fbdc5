"""A failing environment costs time, or stops the run and reports the command."""

import os
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

import flaky_environments
from udrl.config import Budget
from udrl.errors import EnvironmentFault, RunFailed
from udrl_inspect.agents import reproduce
from udrl_launch.supervisor import Supervisor
from udrl_proto.reports import Status
from udrl_replay.creation import create_run, write_config
from udrl_replay.store import Store
from whole_run import assert_conserved, digests, free_port, live_status, small, wait_for


def test_environment_that_sometimes_raises_changes_no_result(run: Callable[..., Status]) -> None:
    flaky_environments.Flaky.raised_for.clear()
    flaky = run(small(environment="flaky_environments:Flaky-v0"), 2000, actors=2)
    # Failures after the run's end, in cancelled commands, are not counted.
    raised = len(flaky_environments.Flaky.raised_for)
    assert 10 < raised - flaky.commands.cancelled <= flaky.env_failures <= raised
    assert digests(flaky) == digests(run(small(), 2000))


def test_command_that_always_raises_stops_the_run_and_can_be_reproduced(
    run: Callable[..., Status], tmp_path: Path
) -> None:
    run_dir = tmp_path / "cursed"
    cursed = small(environment="flaky_environments:Cursed-v0")
    with pytest.raises(RunFailed, match=r"udrl reproduce /\S+ \d+"):
        run(cursed, 2000, run_dir=run_dir, actors=2)
    status = live_status(run_dir)
    assert status is not None
    assert status.state == "failed"
    command_id = int(status.problem.split("command ")[1].split()[0])
    with pytest.raises(EnvironmentFault, match="is cursed"):
        reproduce(run_dir, command_id)


def test_command_that_always_hangs_stops_the_run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), *sys.path]))
    run_dir = tmp_path / "hung"
    hung = small(environment="flaky_environments:Hung-v0")
    create_run(run_dir, hung).close()
    write_config(run_dir, hung, Budget(max_env_steps=2000))
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    supervisor = Supervisor(tmp_path / "logs")

    def ended() -> bool:
        supervisor.check()
        return supervisor.done

    try:
        supervisor.start(
            "replay", "replay", hung.environment, "--run-dir", str(run_dir), "--resume",
            "--listen", endpoint,
        )  # fmt: skip
        for name in ("actor-1", "actor-2"):
            supervisor.start(
                name, "actor", "--connect", endpoint, "--patience", "60", "--hang-timeout", "2"
            )
        with pytest.raises(RunFailed, match=r"udrl reproduce /\S+ \d+") as caught:
            wait_for(ended, "the run to end", timeout=100)
    finally:
        supervisor.end()
    assert caught.value.exit_code == 9
    status = live_status(run_dir)
    assert status is not None
    assert status.state == "failed"
    assert_conserved(status)
    with closing(Store(run_dir, read_only=True)) as store:
        blamed = int(status.problem.split("command ")[1].split()[0])
        (command,) = (c for c in store.commands(cancelled=False) if c.id == blamed)
    assert command.environment_seed % 7 == 0
