"""``udrl obedience`` on an obedient agent and on one that hardly obeys, and in model cards."""

import csv
import json
import shutil
import threading
from pathlib import Path
from typing import Any

import msgspec
import pytest
from click.testing import CliRunner

from udrl.config import Budget, Config, build, change
from udrl.errors import ConfigError, UdrlError
from udrl.replay_buffer import ReplayBuffer
from udrl_inspect.agents import Agent, evaluate, evaluation_commands, load_agent
from udrl_inspect.obedience_report import (
    ObedienceReport,
    load_report,
    measure,
    plan_commands,
    save_report,
)
from udrl_inspect.obedience_text import answer, markdown
from udrl_launch.cli import cli as command_line
from udrl_launch.settings import Fleet, Settings
from udrl_launch.training_run import run_training
from whole_run import OBEDIENT


def call(*arguments: object) -> tuple[str, str]:
    result = CliRunner().invoke(
        command_line, [str(a) for a in arguments], standalone_mode=False, catch_exceptions=False
    )
    assert result.return_value == 0
    return result.stdout, result.stderr


@pytest.fixture(scope="module")
def obedient(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run_dir = tmp_path_factory.mktemp("obedient") / "run"
    settings = Settings(
        build(Config, OBEDIENT), Budget(max_env_steps=1280), Fleet(actors=1, envs_per_actor=8)
    )
    run_training(settings, run_dir, threading.Event(), in_process=True)
    return run_dir


@pytest.fixture
def run_dir(ended_run: Path, tmp_path: Path) -> Path:
    """A copy of a run, whose directory may be changed."""
    return Path(shutil.copytree(ended_run, tmp_path / "cart"))


def test_obedient_agent_is_reported_as_such(obedient: Path) -> None:
    text, _ = call("obedience", obedient, "--episodes", 30, "--points", 5, "--greedy")
    report = load_report(obedient)
    assert report is not None
    assert [p.desired_return for p in report.by_return] == [0, 1, 2, 3, 4]
    assert all(p.desired_horizon == 4 for p in report.by_return)
    assert (report.tolerance, report.temperature, report.by_horizon) == (0.4, 0.0, [])
    assert report.obeyed is not None
    assert (report.obeyed.low, report.obeyed.high) == (0.0, 4.0)
    assert report.obeyed.correlation > 0.99
    assert text.splitlines()[-1] == answer(report)
    assert "You can command returns from 0 to 4 (mean absolute error 0.0" in text


def test_output_is_one_document_and_reproducible(run_dir: Path) -> None:
    options = ("--episodes", 3, "--points", 3, "--json")
    first, errors = call("obedience", run_dir, *options)
    assert errors == ""
    assert call("obedience", run_dir, *options) == (first, errors)
    document: dict[str, Any] = json.loads(first)
    assert document.pop("run_dir") == str(run_dir)
    report = load_report(run_dir)
    assert report is not None
    assert document.pop("answer") == answer(report)
    assert msgspec.convert(document, ObedienceReport) == report
    agent = load_agent(run_dir)
    assert (report.run_id, report.weights_version) == (agent.run_id, agent.version)
    with (run_dir / "obedience.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == len(report.by_return + report.by_horizon)
    assert (run_dir / "obedience.png").read_bytes().startswith(b"\x89PNG")


def test_report_is_stored_even_if_the_figure_fails(run_dir: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    figure = tmp_path / "file" / "figure.png"
    with pytest.raises(ConfigError, match="choose a writable file"):
        call("obedience", run_dir, "--episodes", 2, "--points", 2, "--output", figure)
    assert load_report(run_dir) is not None


def test_custom_tolerance(obedient: Path) -> None:
    agent = load_agent(obedient)
    plan = plan_commands(agent, points=5, episodes=10, temperature=0.0)
    # All commands are obeyed exactly, and none exceeds the agent's ability.
    exact = measure(agent, plan, 0.0)
    assert exact.tolerance == 0.0
    assert exact.obeyed is not None
    assert (exact.obeyed.low, exact.obeyed.mean_absolute_error) == (0.0, 0.0)
    call("obedience", obedient, "--episodes", 2, "--points", 5, "--tolerance", 1.5)
    report = load_report(obedient)
    assert report is not None
    assert report.tolerance == 1.5


def test_every_point_equals_evaluate(run_dir: Path) -> None:
    agent = load_agent(run_dir)
    report = measure(agent, plan_commands(agent, points=3, episodes=4, temperature=0.5))
    assert [p.desired_return for p in report.by_return] == sorted(
        {p.desired_return for p in report.by_return}
    )
    assert len(report.by_horizon) == 3
    evaluated = evaluation_commands(agent, episodes=1)[0].desired_return
    assert {p.desired_return for p in report.by_horizon} == {evaluated}
    for point in report.by_return + report.by_horizon:
        commands = evaluation_commands(
            agent, episodes=4, temperature=0.5, desired_return=point.desired_return,
            desired_horizon=point.desired_horizon,
        )  # fmt: skip
        found = evaluate(agent, commands).evaluation
        assert found == (
            point.return_mean, point.return_std, point.return_ci95_low, point.return_ci95_high, 4
        )  # fmt: skip
        # on CartPole, returns equal lengths
        assert (point.length_mean, point.length_std) == (point.return_mean, point.return_std)


def test_commands_are_within_the_range_of_the_buffer(ended_run: Path) -> None:
    agent = load_agent(ended_run)
    plan = plan_commands(agent, points=4, episodes=2)
    returns = sorted(e.episode_return for e in agent.buffer)
    commanded = [commands[0] for commands in plan.by_return]
    assert plan.reachable == (commanded[0].desired_return, commanded[-1].desired_return)
    # Rounded to at most a tenth of their spacing.
    room = (returns[-1] - returns[0]) / 3 / 10
    assert plan.reachable[0] == pytest.approx(returns[(len(returns) - 1) // 20], abs=room)
    assert plan.reachable[1] == pytest.approx(returns[-1], abs=room)
    lengths = [e.length for e in agent.buffer]
    assert all(min(lengths) <= c.desired_horizon <= max(lengths) for c in commanded)
    wider = plan_commands(agent, points=3, episodes=2, desired_returns=(0.0, 1000.0))
    assert [c[0].desired_return for c in wider.by_return] == [0.0, 500.0, 1000.0]
    assert wider.reachable == plan.reachable
    assert plan.total == 2 * len(plan.by_return + plan.by_horizon)


def with_horizons_from_returns(agent: Agent) -> Agent:
    config = change(agent.config, horizon_equals_return=True)
    return agent._replace(config=config)


def test_horizons_that_follow_from_returns_are_not_varied(ended_run: Path) -> None:
    agent = with_horizons_from_returns(load_agent(ended_run))
    with pytest.raises(ConfigError, match=r"^--desired-returns 0.1:0.9: .* of 1, .* wider range"):
        plan_commands(agent, points=9, episodes=2, desired_returns=(0.1, 0.9))
    plan = plan_commands(agent, points=9, episodes=2, desired_returns=(1.0, 4.0))
    commanded = [(c[0].desired_return, c[0].desired_horizon) for c in plan.by_return]
    assert commanded == [(1.0, 1), (2.0, 2), (3.0, 3), (4.0, 4)]
    assert plan.by_horizon == []


def test_ignored_horizons_are_neither_varied_nor_commanded(ended_run: Path) -> None:
    agent = load_agent(ended_run)
    agent = agent._replace(config=change(agent.config, horizon_scale=0))
    assert plan_commands(agent, points=3, episodes=2).by_horizon == []
    with pytest.raises(ConfigError, match=r"desired horizon 9.*do not use it"):
        evaluation_commands(agent, episodes=2, desired_horizon=9)


def test_buffer_of_equal_returns_is_rejected(ended_run: Path) -> None:
    agent = load_agent(ended_run)
    best = ReplayBuffer(agent.config.buffer, [e._replace(episode_return=9.0) for e in agent.buffer])
    agent = agent._replace(buffer=best)
    with pytest.raises(ConfigError, match=r"are 9, .*--desired-returns LOW:HIGH"):
        plan_commands(agent, points=5, episodes=2)
    plan = plan_commands(agent, points=2, episodes=2, desired_returns=(10.0, 30.0))
    assert measure(agent, plan).tolerance == pytest.approx(2.0)


def test_model_card_has_the_report_of_its_weights(run_dir: Path, tmp_path: Path) -> None:
    _, hint = call("export", run_dir, "--folder", tmp_path / "agent")
    version = load_agent(run_dir).version
    assert f"udrl obedience {run_dir} --weights {version}" in hint
    card = tmp_path / "agent" / "README.md"
    assert "Which returns it obtains" not in card.read_text()
    call("obedience", run_dir, "--episodes", 2, "--points", 2)
    report = load_report(run_dir)
    assert report is not None
    assert call("export", run_dir, "--folder", tmp_path / "agent")[1] == ""
    assert f"## Which returns it obtains\n\n{markdown(report)}\n" in card.read_text()
    for other in ({"weights_version": version + 1}, {"run_id": "another"}):
        save_report(run_dir, msgspec.structs.replace(report, **other))
        call("export", run_dir, "--folder", tmp_path / "agent")
        assert "Which returns it obtains" not in card.read_text()
    (run_dir / "obedience.json").write_text("{}")
    with pytest.raises(UdrlError, match="measure again"):
        call("export", run_dir, "--folder", tmp_path / "agent")


def test_custom_path_of_the_figure(run_dir: Path, tmp_path: Path) -> None:
    few = ("--episodes", 2, "--points", 2)
    call("obedience", run_dir, *few, "--output", tmp_path / "pictures" / "it.svg")
    assert (tmp_path / "pictures" / "it.svg").exists()
    assert not (run_dir / "obedience.png").exists()
    with pytest.raises(ConfigError, match=r"ends with .png, .svg or .pdf"):
        call("obedience", run_dir, *few, "--output", tmp_path / "it.bmp")


def test_unwritable_directory_does_not_lose_the_report(run_dir: Path) -> None:
    (run_dir / "obedience.json.part").mkdir()
    text, problem = call("obedience", run_dir, "--episodes", 2, "--points", 2)
    assert "Highest mean return" in text
    assert "the report cannot be written to" in problem
    assert "make the directory writable" in problem
