"""Commands: status, evaluate, health, and services started by hand."""

import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import click

from udrl_launch.cli import cli as command_line
from udrl_proto.reports import Status
from whole_run import SMALL, TOY, Cli, arguments, digests, free_port, live_status, small, wait_for

BUDGET = 3000


def toml(config: dict[str, object], path: Path) -> Path:
    path.write_text("".join(f"{name} = {json.dumps(value)}\n" for name, value in config.items()))
    return path


def test_services_started_by_hand_equal_one_process(
    cli: Callable[..., Cli], run: Callable[..., Status], tmp_path: Path
) -> None:
    endpoint, run_dir = f"tcp/127.0.0.1:{free_port()}", tmp_path / "run"
    config = toml(SMALL | {"max_env_steps": BUDGET}, tmp_path / "config.toml")
    replay = cli(
        "replay", "CartPole-v1", "--listen", endpoint, "--run-dir", str(run_dir),
        "--preset", "none", "--config", str(config),
    )  # fmt: skip
    others = [cli("learner", "--connect", endpoint), cli("actor", "--connect", endpoint)]
    others.append(cli("actor", "--connect", endpoint, "--envs", "3"))
    log = ""
    for process in (replay, *others):
        code, _, error = process.finish()
        assert code == 0, error
        log += error
    assert re.search(r"learner-\S+ joined run \S+ \(CartPole-v1\)", log)
    assert re.search(r"actor-\S+ joined run \S+ \(CartPole-v1\) with \d+ environments", log)
    status = live_status(run_dir)
    assert status is not None
    assert status.state == "ended"
    assert status.ended_because == f"spent its budget of {BUDGET:,} env steps"
    assert digests(status) == digests(run(small(), BUDGET))


def test_status_and_evaluate_of_an_ended_run(cli: Callable[..., Cli], tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    ended = cli(*arguments(SMALL, BUDGET, run_dir), "--in-process").status()
    assert cli("status", str(run_dir), "--json").status() == ended

    code, out, error = cli("status", str(run_dir)).finish()
    assert code == 0, error
    lines = out.splitlines()
    assert lines[2].split() == ["state", "ended"]
    assert lines == [line.rstrip() for line in lines]

    code, out, error = cli("evaluate", str(run_dir), "--episodes", "5", "--json").finish()
    assert code == 0, error
    report = json.loads(out)
    assert ended.final_evaluation is not None
    assert report["mean"] == ended.final_evaluation.mean

    code, out, error = cli(
        "evaluate", str(run_dir), "--episodes", "3", "--greedy", "--desired-return", "30",
        "--desired-horizon", "40", "--weights", "best",
    ).finish()  # fmt: skip
    assert code == 0, error
    assert "desired return 30.0 within 40 steps, temperature 0," in out

    for name in ("run.sqlite", "metrics.csv", "config.toml", "weights.safetensors"):
        assert (run_dir / name).stat().st_size > 0
    assert (run_dir / "learning_curve.png").read_bytes().startswith(b"\x89PNG")


def test_usual_training_warns_of_nothing_and_prints_its_reason_to_end(
    cli: Callable[..., Cli], tmp_path: Path
) -> None:
    code, out, error = cli(
        "train", "CartPole-v1", "--max-env-steps", "2000", "--eval-episodes", "3",
        "--run-dir", str(tmp_path / "run"),
    ).finish()  # fmt: skip
    assert code == 0, error
    assert "WARNING" not in error
    assert "ended:            spent its budget of 2,000 env steps" in out


def test_budget_spent_in_the_warm_up_trains_nothing(
    cli: Callable[..., Cli], tmp_path: Path
) -> None:
    code, out, error = cli(*arguments(TOY, 1, tmp_path / "run"), "--in-process").finish()
    assert code == 0, error
    assert "none: the warm-up spent the budget; raise --max-env-steps" in error
    assert json.loads(out)["weights_version"] == 0, "--json must print nothing else"


def test_resuming_an_ended_run_returns_at_once(cli: Callable[..., Cli], tmp_path: Path) -> None:
    given = arguments(TOY, 100, tmp_path / "run")
    code, out, error = cli(*given, "--in-process", "--resume").finish()
    assert code == 0, error
    assert error.startswith("there is no run in run to resume; starting a new one\n")
    code, again, error = cli(*given, "--resume").finish(timeout=20)
    assert (code, again) == (0, out)
    assert "starting a new one" not in error


def test_training_that_ended_succeeds_without_its_metrics(
    cli: Callable[..., Cli], tmp_path: Path
) -> None:
    given = arguments(TOY, 100, tmp_path / "run")
    ended = cli(*given, "--in-process").status()
    (tmp_path / "run" / "metrics.csv").unlink()
    code, out, error = cli(*given, "--resume").finish(timeout=20)
    assert code == 0, error
    assert json.loads(out)["weights_sha256"] == ended.weights_sha256
    assert re.search(r"learning curve: .*metrics\.csv: No such file", error)


def test_status_of_a_live_run_by_its_endpoint(cli: Callable[..., Cli], tmp_path: Path) -> None:
    endpoint, run_dir = f"tcp/127.0.0.1:{free_port()}", tmp_path / "run"
    cli(*arguments(TOY, 10_000_000, run_dir), "--listen", endpoint, "--actors", "1")
    wait_for(lambda: (s := live_status(run_dir)) and s.actors, "an actor")
    status = cli("status", "--connect", endpoint, "--json").status()
    assert status.state == "running"
    assert [actor.environments for actor in status.actors] == [16]


def test_health_of_each_service(cli: Callable[..., Cli], tmp_path: Path) -> None:
    endpoint, config = f"tcp/127.0.0.1:{free_port()}", toml(TOY, tmp_path / "config.toml")

    def health(role: str, patience: str = "20") -> tuple[int, str, str]:
        return cli("health", role, "--connect", endpoint, "--patience", patience).finish()

    def has_health(role: str, code: int) -> bool:
        return health(role)[0] == code

    code, _, error = health("replay", "0.1")
    assert code == 6
    assert f"no reply from '{endpoint}'" in error
    cli("replay", "Figure2-v0", "--listen", endpoint, "--config", str(config),
        "--max-env-steps", "10000000")  # fmt: skip
    code, out, error = health("replay")
    assert code == 0, error
    assert f"is served at {endpoint}" in out
    for role in ("learner", "actor"):
        code, _, error = health(role)
        assert code == 6
        assert re.search(rf"no {role} of this machine \({role}-.*\) has joined run", error)
        service = cli(role, "--connect", endpoint)
        wait_for(partial(has_health, role, 0), f"a healthy {role}")
        service.process.kill()
        wait_for(partial(has_health, role, 6), f"{role} to be gone")


def test_light_commands_do_not_load_torch(tmp_path: Path) -> None:
    program = (
        "import sys\nfrom udrl_launch.cli import cli\n"
        "code = cli(['health', 'actor', '--help'], standalone_mode=False)\n"
        "sys.exit('torch' in sys.modules)"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=30)
    assert ended.returncode == 0, ended.stderr


def commands(command: click.Command, *names: str) -> Iterator[tuple[str, click.Command]]:
    """Yield every command of the command line with its words."""
    if names:
        yield " ".join(names), command
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            found = command.get_command(context, name)
            assert found is not None
            yield from commands(found, *names, name)


def test_help_of_each_command_has_an_example() -> None:
    missing = [
        name for name, command in commands(command_line)
        if not command.hidden and not re.search(r"\nExample:\n  .*\budrl ", command.help or "")
    ]  # fmt: skip
    assert not missing
