"""A replay service that is started for a run that has ended."""

import threading
from contextlib import closing
from pathlib import Path

import pytest

from tests.replay.synthetic import create, finish
from udrl.config import Budget
from udrl_proto.memory_transport import Exchange, MemoryTransport
from udrl_replay.replay_service import ReplayService
from udrl_replay.run import StoredRun


@pytest.mark.parametrize(
    ("stop_return", "remedy"),
    [
        (0.0, "it reached return 0; raise --stop-return to continue it"),
        (None, "it spent its budget of 40 env steps; raise --max-env-steps to continue it"),
    ],
)
def test_log_names_the_limit_that_continues_the_run(
    stop_return: float | None, remedy: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    budget = Budget(max_env_steps=40, stop_return=stop_return)
    with closing(create(tmp_path)) as store:
        finish(StoredRun(store, budget))
        caplog.set_level("INFO", "udrl")
        service = ReplayService(MemoryTransport(Exchange()), store, budget, tmp_path)
        stop = threading.Event()
        stop.set()
        with closing(service):
            service.serve(stop)
    assert f"the run has ended: {remedy}" in caplog.messages
