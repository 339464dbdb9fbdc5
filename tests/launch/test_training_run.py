"""``udrl train``: starting and stopping."""

import threading
from pathlib import Path

import pytest

from udrl.errors import Interrupted
from udrl_launch import training_run
from udrl_launch.settings import gather
from udrl_replay.store import Store

TOY = {"n_warm_up_episodes": 5, "max_return": 2.0}


class Silent:
    """Services that never answer."""

    done = False
    ended = False

    def __init__(self, run_dir: Path, store: Store, *_: object, **__: object) -> None:
        """Start nothing, and leave the run to others."""
        store.close()

    def check(self) -> None:
        """Find nothing wrong."""

    def end(self) -> None:
        """Note that they were ended."""
        Silent.ended = True


def test_a_stop_while_connecting_says_how_to_resume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training_run, "Threads", Silent)
    stop = threading.Event()
    timer = threading.Timer(0.3, stop.set)
    timer.start()
    settings = gather("Figure2-v0", preset_name="none", options=TOY)
    command = f"udrl train Figure2-v0 --run-dir {tmp_path / 'run'} --resume"
    with pytest.raises(Interrupted, match=f"^stopped; resume with: {command}$"):
        training_run.train(settings, tmp_path / "run", stop, in_process=True)
    assert Silent.ended
