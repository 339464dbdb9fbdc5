"""Bad input is rejected within five seconds, with the value, what was expected, and the remedy."""

import logging
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from udrl_launch.cli import run
from whole_run import TOY, Cli, arguments, free_port, live_status, wait_for

#: Importing torch takes a second or two on a busy machine, before anything can be checked.
PROMPT_S = 15


def refusal(process: Cli) -> tuple[int, str]:
    code, _, error = process.finish(timeout=PROMPT_S)
    assert "Traceback" not in error
    return code, error


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (["train", "NoSuchLander-v9"], "NoSuchLander"),
        (["train", "CartPole"], "'CartPole' has no version"),
        (["train", "CartPole"], "did you mean 'CartPole-v1'?"),
        (["train", "CartPole-v1", "--preset", "ani"], "did you mean 'any'? Presets: "),
        (["train", "CartPole-v1", "--preset", "xyz"], ", any, none"),
        (["train", "CartPole-v1", "--metrics-port", "99999"], "99999 is not from 0 to 65535"),
        (["metrics", "nowhere"], "nowhere holds no run"),
        (["obedience", "nowhere", "--desired-returns", "16"], "'16' is not LOW:HIGH"),
        (["train", "CartPole-v1", "--set", "batchsize=3"], "did you mean 'batch_size'"),
        (["train", "CartPole-v1", "--set", "batch_size=0"], "batch_size = 0"),
        (["train", "CartPole-v1", "--set", "batch_size=many"], "batch_size = 'many'"),
        (["train", "CartPole-v1", "--set", "learning_rate=nan"], "learning_rate = nan"),
        (["train", "CartPole-v1", "--set", "last_few=9999"], "last_few = 9999"),
        (["train", "CartPole-v1", "--set", "batch_size"], "NAME=VALUE"),
        (["train", "CartPole-v1", "--set", "environment=Acrobot-v1"], "the argument ENV"),
        (["train", "CartPole-v1", "--preset", "nope"], "preset 'nope'"),
        (["train", "CartPole-v1", "--config", "missing.toml"], "missing.toml"),
        (["train", "CartPole-v1", "--resume"], "--resume needs --run-dir"),
        (["train", "CartPole-v1", "--listen", "localhost"], "tcp/HOST:PORT"),
        (["train", "CartPole-v1", "--set", "action_mask=walls"], "has no such entry"),
        (["train", "--seed", "x", "CartPole-v1"], "--seed"),
        (["replay", "CartPole-v1"], "--listen ENDPOINT or --connect ENDPOINT"),
        (["replay", "CartPole-v1", "--listen", "tcp/0.0.0.0:7447"], "--insecure"),
        (["status", "nowhere"], "nowhere holds no run"),
        (["evaluate", "nowhere"], "nowhere holds no run"),
        (["evaluate", "nowhere", "--weights", "new"], "latest, best or a version number"),
        (["evaluate", "nowhere", "--weights", "9" * 5000], "latest, best or a version number"),
    ],
)
def test_bad_argument_is_rejected_with_the_remedy(
    given: list[str],
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(logging.getLogger("udrl"), "handlers", [])
    began = time.monotonic()
    code = run(given)
    assert time.monotonic() - began < PROMPT_S
    assert code == 2 or "nowhere" in given
    assert code != 0
    assert expected in capsys.readouterr().err


def test_bad_endpoint_is_rejected_with_the_remedy(cli: Callable[..., Cli]) -> None:
    """In its own process, because an actor changes its priority before."""
    code, error = refusal(cli("actor", "--connect", "7447"))
    assert code == 2
    assert "tcp/HOST:PORT" in error


@pytest.fixture
def taken_port() -> Iterator[int]:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        yield taken.getsockname()[1]


def test_port_in_use_is_rejected(taken_port: int, cli: Callable[..., Cli], tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{taken_port}"
    for command in ("replay", "train"):
        run_dir = tmp_path / command
        given = [command, "Figure2-v0", "--listen", endpoint, "--run-dir", str(run_dir)]
        code, error = refusal(cli(*given))
        assert code == 2
        assert endpoint in error
        assert "in use" in error
        assert not run_dir.exists()  # so that another port can be chosen


@pytest.mark.parametrize("role", ["actor", "learner"])
def test_endpoint_without_a_reply_is_reported(role: str, cli: Callable[..., Cli]) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    code, error = refusal(cli(role, "--connect", endpoint))
    assert code == 6
    assert f"no reply from '{endpoint}'" in error


def test_run_directory_with_a_run_is_not_overwritten(
    cli: Callable[..., Cli], tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    given = arguments(TOY, 100, run_dir)
    cli(*given, "--in-process").status()
    code, error = refusal(cli(*given))
    assert code == 8
    assert "--resume" in error


def test_invalid_run_directory_is_rejected(cli: Callable[..., Cli], tmp_path: Path) -> None:
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    code, error = refusal(cli("train", "Figure2-v0", "--run-dir", str(loop)))
    assert code == 8
    assert f"run directory {loop}: " in error
    assert "Too many levels of symbolic links" in error


def test_run_directory_of_another_configuration_is_rejected(
    cli: Callable[..., Cli], tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    cli(*arguments(TOY, 100, run_dir), "--in-process").status()
    code, error = refusal(cli(*arguments(TOY | {"batch_size": 32}, 100, run_dir), "--resume"))
    assert code == 8
    assert "batch_size = 64, not 32" in error


def test_run_directory_in_use_is_rejected(cli: Callable[..., Cli], tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    given = arguments(TOY, 10_000_000, run_dir)
    cli(*given)
    wait_for(lambda: (s := live_status(run_dir)) and s.iteration, "the run to begin")
    code, error = refusal(cli(*given, "--resume"))
    assert code == 8
    assert "in use" in error
