"""The services of a run on this machine."""

import threading
from contextlib import closing
from pathlib import Path

import pytest

from udrl_launch import roles
from udrl_launch.local import Threads
from udrl_launch.settings import gather
from udrl_replay.creation import create_run


def test_threads_load_torch_before_a_service_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    events: list[str] = []
    monkeypatch.setattr(
        roles, "load_learner_service", lambda: events.append(threading.current_thread().name)
    )
    for role in ("replay", "learner", "actor"):
        monkeypatch.setattr(
            roles, role, lambda *_, **__: events.append(threading.current_thread().name)
        )
    settings = gather("Figure2-v0", preset_name="none", options={"max_return": 2.0, "actors": 1})
    with closing(create_run(tmp_path / "run", settings.config)) as store:
        services = Threads(
            tmp_path / "run", store, settings, "tcp/127.0.0.1:1", insecure=False, keys=None
        )
        services.end()
    assert events[0] == threading.main_thread().name
    assert sorted(events[1:]) == ["actor-1", "learner", "replay"]
