"""A warning if greedy actions obtain far less than sampled ones."""

from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from msgspec.structs import replace

from udrl.commands import Command
from udrl.config import change
from udrl.evaluation import Evaluation, return_text
from udrl_inspect.agents import Agent, evaluation_commands, load_agent
from udrl_inspect.greedy import caution
from udrl_inspect.inspection import read_status
from udrl_launch.cli import cli


@pytest.fixture
def agent(ended_run: Path) -> Agent:
    return load_agent(ended_run)


@pytest.fixture
def greedy(agent: Agent) -> Command:
    return evaluation_commands(agent, episodes=1, temperature=0.0)[0]


@pytest.fixture
def sampled(ended_run: Path) -> Evaluation:
    found = read_status(ended_run).final_evaluation
    assert found is not None
    return Evaluation(found.mean, found.std, found.ci95_low, found.ci95_high, found.episodes)


def test_far_lower_return_is_warned_of_with_both_returns(
    agent: Agent, ended_run: Path, greedy: Command, sampled: Evaluation
) -> None:
    low = sampled.mean - 2 * sampled.std
    assert caution(agent, ended_run, greedy, [low] * 20) == (
        f"greedy: mean return {return_text(low)}; sampled evaluations of this run reach "
        f"{return_text(sampled.mean)}; leave out --greedy or --temperature 0"
    )


@pytest.mark.parametrize("deviations", [-1.0, 0.0, 0.9])
def test_slightly_lower_return_is_not_warned_of(
    agent: Agent, ended_run: Path, greedy: Command, sampled: Evaluation, deviations: float
) -> None:
    assert not caution(agent, ended_run, greedy, [sampled.mean - deviations * sampled.std] * 100)


def test_one_bad_episode_is_not_warned_of(
    agent: Agent, ended_run: Path, greedy: Command, sampled: Evaluation
) -> None:
    assert not caution(agent, ended_run, greedy, [sampled.mean - 1.5 * sampled.std])
    assert not caution(agent, ended_run, greedy, [])


def test_incomparable_evaluations_are_not_warned_of(
    agent: Agent, ended_run: Path, greedy: Command
) -> None:
    for other in (replace(greedy, temperature=1.0), replace(greedy, desired_return=1.0)):
        assert not caution(agent, ended_run, other, [-1e6] * 20)
    of_greedy_run = agent._replace(config=change(agent.config, eval_temperature=0.0))
    assert not caution(of_greedy_run, ended_run, greedy, [-1e6] * 20)


@pytest.mark.parametrize(
    ("command", "module"),
    [("evaluate", "inspection_commands"), ("play", "play_command")],
)
def test_commands_print_the_warning_to_stderr(
    ended_run: Path, monkeypatch: pytest.MonkeyPatch, command: str, module: str
) -> None:
    given: list[float] = []

    def fake_caution(agent: Agent, run_dir: Path, other: Command, returns: list[float]) -> str:
        given.extend(returns)
        return f"temperature {other.temperature:g}"

    monkeypatch.setattr(f"udrl_launch.subcommands.{module}.caution", fake_caution)
    result = CliRunner().invoke(
        cli, [command, str(ended_run), "--episodes", "2", "--greedy", "--json"],
        standalone_mode=False, catch_exceptions=False,
    )  # fmt: skip
    assert result.stderr == "temperature 0\n"
    assert "temperature 0\n" not in result.stdout
    assert len(given) == 2


def test_help_has_no_greedy_example() -> None:
    for name in ("evaluate", "play"):
        command = cli.get_command(click.Context(cli), name)
        assert command is not None
        assert "--greedy" not in (command.help or "")
