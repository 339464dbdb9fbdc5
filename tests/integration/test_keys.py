"""Runs with keys: the same results as without, and no key in any output."""

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from click.testing import CliRunner

from test_commands import toml
from udrl.errors import ConfigError, UdrlError
from udrl_board.source import Directory
from udrl_inspect.agents import load_agent
from udrl_inspect.inspection import status_of
from udrl_launch.cli import cli as command_line
from udrl_proto.reports import Status
from whole_run import (
    SMALL,
    TOY,
    Cli,
    arguments,
    configured_router,
    digests,
    free_port,
    kill_at,
    live_status,
    small,
    toy,
    wait_for,
)

BUDGET = 3000


def secrets_of(keys_dir: Path) -> list[str]:
    """Return one line of each private key."""
    files = [*keys_dir.rglob("key.pem"), *keys_dir.rglob("ca.key")]
    assert len(files) == 5
    return [file.read_text().splitlines()[1] for file in files]


def test_run_with_keys_equals_one_without(run: Callable[..., Status], keys_dir: Path) -> None:
    assert digests(run(small(), BUDGET, actors=2, keys=keys_dir)) == digests(run(small(), BUDGET))


def test_services_with_their_own_keys_only_equal_one_process(
    cli: Callable[..., Cli], run: Callable[..., Status], keys_dir: Path, tmp_path: Path
) -> None:
    port, run_dir = free_port(), tmp_path / "run"
    config = toml(SMALL | {"max_env_steps": BUDGET}, tmp_path / "config.toml")
    # Beyond loopback, but without --insecure.
    replay = cli(
        "replay", "CartPole-v1", "--listen", f"tls/0.0.0.0:{port}", "--run-dir", str(run_dir),
        "--preset", "none", "--config", str(config), "--keys", str(keys_dir / "replay"),
    )  # fmt: skip
    others = [
        cli(role, "--connect", f"tls/localhost:{port}", "--keys", str(keys_dir / role))
        for role in ("learner", "actor")
    ]
    for process in (replay, *others):
        code, out, error = process.finish()
        assert code == 0, error
        assert not [secret for secret in secrets_of(keys_dir) if secret in out + error]
    status = live_status(run_dir)
    assert status is not None
    assert digests(status) == digests(run(small(), BUDGET))
    assert load_agent(run_dir).weights == (run_dir / "weights.safetensors").read_bytes()


def test_services_meet_at_an_external_router(
    cli: Callable[..., Cli], run: Callable[..., Status], keys_dir: Path, tmp_path: Path
) -> None:
    endpoint, run_dir = f"tls/127.0.0.1:{free_port()}", tmp_path / "run"
    config = toml(SMALL | {"max_env_steps": BUDGET}, tmp_path / "config.toml")
    settings = ["--preset", "none", "--config", str(config)]
    given = {"replay": ["CartPole-v1", "--run-dir", str(run_dir), *settings]}
    with configured_router(endpoint, keys_dir):
        others = [
            cli(
                role, *given.get(role, ()), "--connect", endpoint,
                "--keys", str(keys_dir / role),
            )
            for role in ("replay", "learner", "actor")
        ]  # fmt: skip
        for process in others:
            code, _, error = process.finish()
            assert code == 0, error
    status = live_status(run_dir)
    assert status is not None
    assert digests(status) == digests(run(small(), BUDGET))


@pytest.mark.slow
def test_killed_services_restart_with_their_keys(
    cli: Callable[..., Cli], run: Callable[..., Status], keys_dir: Path, tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    given = arguments(SMALL, 2 * BUDGET, run_dir)
    process = cli(*given, "--actors", "1", "--keys", str(keys_dir))
    kill_at(process, run_dir, "replay", 1)
    kill_at(process, run_dir, "actor", 4)
    assert digests(process.status()) == digests(run(small(), 2 * BUDGET))


def test_status_of_a_live_run_requires_an_observers_key(
    cli: Callable[..., Cli], keys_dir: Path, foreign_keys_dir: Path, tmp_path: Path
) -> None:
    port, run_dir = free_port(), tmp_path / "run"
    endpoint = f"tls/127.0.0.1:{port}"
    cli(
        *arguments(TOY, 10_000_000, run_dir), "--listen", f"tls/0.0.0.0:{port}", "--actors", "1",
        "--keys", str(keys_dir),
    )  # fmt: skip

    def actors() -> list[int]:
        try:
            return [a.environments for a in status_of(run_dir, keys_dir / "observer").actors]
        except UdrlError:  # no run yet
            return []

    wait_for(lambda: actors() == [16], "an actor")
    assert status_of(run_dir).actors == ()  # without a key, the status is read from the store
    for place in ((str(run_dir),), ("--connect", endpoint)):
        status = cli("status", *place, "--keys", str(keys_dir), "--json").status()
        assert status.state == "running"
        assert status.actors
    code, _, error = cli("status", str(run_dir)).finish()
    assert code == 0
    assert "cannot be queried, so this is the status in the store" in error
    assert "add --keys DIR" in error
    with closing(Directory(run_dir, keys_dir / "observer")) as board:
        assert board.status().actors
        assert board.doubt() == ""
    with closing(Directory(run_dir)) as board:
        assert board.status().actors == ()
        assert "add --keys DIR" in board.doubt()
        assert board.history(-1).iterations
    for keys, remedy in [
        ((), "add --keys DIR"),
        (("--keys", str(foreign_keys_dir)), "same `udrl keys create`"),
        (("--keys", str(keys_dir / "actor")), "expected 'observer'"),
    ]:
        result = CliRunner().invoke(command_line, ["status", "--connect", endpoint, *keys])
        assert isinstance(result.exception, ConfigError)
        assert remedy in str(result.exception)
    logs = "".join(path.read_text() for path in (run_dir / "logs").iterdir())
    assert logs
    assert not [secret for secret in secrets_of(keys_dir) if secret in logs]


def test_invalid_keys_are_rejected_before_anything_is_written(
    run: Callable[..., Status], keys_dir: Path, tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    with pytest.raises(ConfigError, match=r"nowhere.ca\.pem: No such file"):
        run(toy(), 100, run_dir=run_dir, keys=tmp_path / "nowhere")
    with pytest.raises(ConfigError, match="'actor', expected 'replay'"):
        run(toy(), 100, run_dir=run_dir, keys=keys_dir / "actor")
    assert not run_dir.exists()
