"""TakeCover with all services: bit-identical results when services are killed."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from udrl.config import Config, build, preset
from udrl.errors import ConfigError
from udrl_inspect.agents import evaluate, evaluation_commands, load_agent
from udrl_proto.reports import Status
from whole_run import Cli, arguments, assert_conserved, digests, kill_at, reference

pytestmark = pytest.mark.timeout(300)

# All settings of the preset, so that these runs equal those of the command line.
TAKE_COVER: dict[str, Any] = {
    "environment": "TakeCover-v0",
    "max_episode_steps": 80,
    "horizon_equals_return": True,
    "frame_stack": 8,
    "convolutions": [4, 4, 4, 4],
    "hidden": [8],
    "batch_size": 16,
    "precision": "auto",
    "training_threads": 2,
    "warm_up_hold_steps": 7,
    "device": "auto",
    "initialisation": "orthogonal",
    "learning_rate": 1e-3,
    "return_scale": 0.1,
    "horizon_scale": 0.02,
    "recent_size": 5,
    "max_age": 20,
    "lead": 0,
    "n_warm_up_episodes": 6,
    "n_episodes_per_iter": 4,
    "n_updates_per_iter": 3,
    "replay_size": 10,
    "last_few": 5,
    "eval_every": 800,
    "eval_episodes": 2,
}
BUDGET = 1600

Runner = Callable[..., Status]


def settings(**changes: Any) -> Config:
    return build(Config, TAKE_COVER | changes)


def test_settings_cover_the_preset() -> None:
    assert preset("TakeCover-v0").keys() - {"max_env_steps"} <= TAKE_COVER.keys()


@pytest.mark.slow
def test_services_equal_the_reference(run: Runner, tmp_path: Path) -> None:
    expected = reference(settings(), BUDGET)
    assert expected.evaluations
    run_dir = tmp_path / "run"
    assert digests(run(settings(), BUDGET, actors=2, envs=3, run_dir=run_dir)) == digests(expected)
    agent = load_agent(run_dir)
    commands = evaluation_commands(agent, episodes=2, desired_return=50.7)
    assert evaluate(agent, commands).desired_horizon == 50
    with pytest.raises(
        ConfigError, match="desired horizon 30: in this run it always equals the desired return"
    ):
        evaluation_commands(agent, episodes=2, desired_horizon=30)


@pytest.mark.slow
def test_kill_during_an_episode(run: Runner, cli: Callable[..., Cli], tmp_path: Path) -> None:
    budget = 2 * BUDGET
    expected = run(settings(lead=1), budget)
    run_dir = tmp_path / "killed"
    process = cli(*arguments(TAKE_COVER | {"lead": 1}, budget, run_dir), "--actors", "1")
    for role, iteration in [("actor", 1), ("learner", 2), ("actor", 3)]:
        kill_at(process, run_dir, role, iteration)
    status = process.status(timeout=120)
    assert_conserved(status)
    assert digests(status) == digests(expected)


@pytest.mark.slow
def test_automatic_arithmetic_is_resolved_once(run: Runner, tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    run(settings(), 700, run_dir=run_dir)
    written = (run_dir / "config.toml").read_text()
    assert "auto" not in written
    assert 'precision = "' in written
    again = run(settings(), BUDGET, run_dir=run_dir, resume=True)
    assert digests(again) == digests(run(settings(), BUDGET))
