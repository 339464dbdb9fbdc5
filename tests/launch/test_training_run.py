"""Starting and stopping ``udrl train``."""

import threading
from pathlib import Path

import pytest

from udrl.errors import Interrupted
from udrl_inspect.inspection import read_status
from udrl_launch import training_run
from udrl_launch.settings import gather
from udrl_replay.progress import STOPPED
from udrl_replay.store import Store

TOY = {"n_warm_up_episodes": 5, "max_return": 2.0}


class UnresponsiveServices:
    """Services that never reply."""

    done = False
    ended = False

    def __init__(self, run_dir: Path, store: Store, *_: object, **__: object) -> None:
        """Start no process."""
        store.close()

    def failure(self) -> None:
        """Report no error."""

    def end(self) -> None:
        """Record the call."""
        UnresponsiveServices.ended = True


def test_stop_while_connecting_prints_how_to_resume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training_run, "Threads", UnresponsiveServices)
    stop = threading.Event()
    timer = threading.Timer(0.3, stop.set)
    timer.start()
    settings = gather("Figure2-v0", preset_name="none", options=TOY)
    command = f"udrl train Figure2-v0 --run-dir {tmp_path / 'run'} --resume"
    with pytest.raises(Interrupted, match=f"^stopped; resume with: {command}$"):
        training_run.run_training(settings, tmp_path / "run", stop, in_process=True)
    assert UnresponsiveServices.ended


@pytest.mark.parametrize("resume", [False, True])
def test_run_whose_services_are_starting_is_not_reported_as_killed(
    resume: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training_run, "Threads", UnresponsiveServices)
    settings, stop = gather("Figure2-v0", preset_name="none", options=TOY), threading.Event()
    stop.set()
    for again in (False, True)[: 1 + resume]:
        with pytest.raises(Interrupted):
            training_run.run_training(
                settings, tmp_path / "run", stop, resume=again, in_process=True
            )
    status = read_status(tmp_path / "run")
    assert (status.state, status.ended_because) == ("stopped", STOPPED)


def test_torch_is_loaded_in_the_calling_thread_before_there_is_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def load() -> None:
        raise OSError(f"libtorch.so, in {threading.current_thread().name}")

    monkeypatch.setattr(training_run, "load_learner_service", load)
    settings = gather("Figure2-v0", preset_name="none", options=TOY)
    with pytest.raises(OSError, match=rf"^libtorch\.so, in {threading.current_thread().name}$"):
        training_run.run_training(settings, tmp_path / "run", threading.Event(), in_process=True)
    assert not (tmp_path / "run").exists()
