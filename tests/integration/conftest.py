"""Whole runs: all services, real Zenoh, small environments."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from udrl.config import Budget, Config
from udrl_launch.settings import Fleet, Settings
from udrl_launch.training_run import run_training
from udrl_proto.reports import Status
from whole_run import Cli, assert_conserved, small


@pytest.fixture
def run(tmp_path: Path) -> Callable[..., Status]:
    """Train with the services, and return the final status."""
    number = 0

    def runner(
        config: Config,
        max_env_steps: int,
        *,
        actors: int = 1,
        envs: int = 16,
        run_dir: Path | None = None,
        resume: bool = False,
        in_process: bool = True,
        stop_return: float | None = None,
        keys: Path | None = None,
        audit: float = 0.0,
    ) -> Status:
        nonlocal number
        number += 1
        settings = Settings(
            config,
            Budget(max_env_steps=max_env_steps, stop_return=stop_return),
            Fleet(actors=actors, envs_per_actor=envs),
        )
        status = run_training(
            settings,
            run_dir or tmp_path / f"run{number}",
            threading.Event(),
            resume=resume,
            in_process=in_process,
            keys=keys,
            audit=audit,
        )
        assert_conserved(status)
        return status

    return runner


@pytest.fixture(scope="session")
def ended_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of a short run on CartPole; tests must not change it."""
    run_dir = tmp_path_factory.mktemp("ended") / "cart"
    settings = Settings(small(), Budget(max_env_steps=3000), Fleet(actors=1, envs_per_actor=16))
    assert run_training(settings, run_dir, threading.Event(), in_process=True).state == "ended"
    return run_dir


@pytest.fixture
def cli(tmp_path: Path) -> Iterator[Callable[..., Cli]]:
    started: list[Cli] = []

    def start(*arguments: str) -> Cli:
        started.append(Cli(*arguments, cwd=tmp_path))
        return started[-1]

    yield start
    for one in started:
        if one.process.poll() is None:
            os.killpg(one.process.pid, signal.SIGKILL)
        one.process.communicate()
