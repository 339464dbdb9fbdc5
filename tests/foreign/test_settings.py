"""Settings and circumstances that third-party environments need."""

import errno
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from gymnasium import spaces

from tests.foreign.conventions import Plain, register
from udrl.acting import EpisodeGenerator
from udrl.config import Budget, Config, build, read_toml
from udrl.environments import make_environment
from udrl.environments.making import INDEX
from udrl.errors import UnsupportedEnvironment
from udrl_replay.creation import create_run, write_config

NESTED = {"layout": ["SF", "FG"], "robot": {"arms": [{"length": 1.5}, {"length": 2}], "on": True}}


class Layout(Plain):
    def __init__(self, render_mode: str | None = None, **given: Any) -> None:
        super().__init__(render_mode)
        self.given = given


def test_keyword_arguments_may_be_lists_and_tables(tmp_path: Path) -> None:
    config = build(Config, {"environment": register(Layout), "environment_kwargs": NESTED})
    layout = make_environment(config).unwrapped
    assert isinstance(layout, Layout)
    assert layout.given == NESTED
    # They can be stored, and written as TOML.
    create_run(tmp_path / "run", config).close()
    write_config(tmp_path / "run", config, Budget())
    assert read_toml(tmp_path / "run" / "config.toml")["environment_kwargs"] == NESTED


def test_every_environment_gets_its_own_index() -> None:
    found = []

    class Indexed(Plain):
        def __init__(self, render_mode: str | None = None) -> None:
            super().__init__(render_mode)
            found.append(int(os.environ[INDEX]))

    config = build(Config, {"environment": register(Indexed)})
    EpisodeGenerator(config, 3, first_index=32).close()
    assert found == [32, 33, 34]
    make_environment(config).close()  # as commands do that only read the run
    assert found[3:] == [0]
    assert INDEX not in os.environ


def test_created_environments_are_closed_if_another_fails() -> None:
    closed = []

    class Single(Plain):
        made = 0

        def __init__(self, render_mode: str | None = None) -> None:
            super().__init__(render_mode)
            Single.made += 1
            if Single.made > 2:
                raise OSError(errno.EADDRINUSE, "Address already in use")

        def close(self) -> None:
            closed.append(self)

    config = build(Config, {"environment": register(Single)})
    with pytest.raises(UnsupportedEnvironment, match="--actors 1 --envs-per-actor 1"):
        EpisodeGenerator(config, 3)
    assert len(closed) == 2


class OldStyle(Plain):
    """Has two unsupported spaces and no step limit."""

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode)
        self.observation_space = spaces.Tuple((spaces.Discrete(2), spaces.Text(5)))
        self.action_space = spaces.Text(5)


def test_all_unsupported_features_are_listed_at_once() -> None:
    config = build(Config, {"environment": register(OldStyle, max_steps=None)})
    with pytest.raises(UnsupportedEnvironment) as refusal:
        make_environment(config)
    for part in ("observation[1] is Text", "action is Text", "no step limit"):
        assert part in str(refusal.value)


PROGRAM = """
import signal, gymnasium as gym
from gymnasium.envs.classic_control import CartPoleEnv

class Handles(CartPoleEnv):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        signal.signal(signal.SIGUSR1, lambda *_: None)

gym.register("Handles-v0", entry_point=Handles, max_episode_steps=50)
"""
SMALL = (
    "--preset", "none", "--set", "hidden=[8]", "--set", "n_warm_up_episodes=4",
    "--set", "n_episodes_per_iter=2", "--set", "n_updates_per_iter=2", "--set", "batch_size=16",
    "--set", "replay_size=10", "--set", "last_few=2", "--eval-episodes", "2",
    "--max-env-steps", "300", "--actors", "1", "--envs-per-actor", "2",
)  # fmt: skip


def udrl(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the installed command in the user's folder, without PYTHONPATH."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    return subprocess.run(
        [sys.executable, "-P", "-m", "udrl_launch", *arguments],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip


def test_environments_run_in_the_main_thread_and_user_modules_come_last_in_the_path(
    tmp_path: Path,
) -> None:
    (tmp_path / "mine.py").write_text(PROGRAM)
    (tmp_path / "random.py").write_text("raise SystemExit('this is not the one')")
    trained = udrl(tmp_path, "train", "mine:Handles-v0", *SMALL, "--run-dir", "run")
    assert trained.returncode == 0, trained.stderr
    assert (tmp_path / "run" / "run.sqlite").exists()
    evaluated = udrl(tmp_path, "evaluate", "run", "--episodes", "1")
    assert evaluated.returncode == 0, evaluated.stderr


def test_environment_that_needs_the_main_thread_is_reported_in_another() -> None:
    class Handles(Plain):
        def __init__(self, render_mode: str | None = None) -> None:
            super().__init__(render_mode)
            signal.signal(signal.SIGUSR1, signal.SIG_DFL)

    config = build(Config, {"environment": register(Handles)})
    make_environment(config).close()
    with ThreadPoolExecutor(1) as pool, pytest.raises(UnsupportedEnvironment) as refusal:
        pool.submit(make_environment, config).result()
    assert "main thread" in str(refusal.value)
    assert "in_process=False" in str(refusal.value)
