"""Helpers for tests of whole runs: small configurations, waiting, status, kills."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import zenoh

from udrl.algorithm1 import Run, algorithm1
from udrl.config import Budget, Config, build
from udrl.errors import UdrlError
from udrl_inspect.inspection import status_of
from udrl_proto.reports import Status

#: Takes seconds, but has evaluations, evictions and dozens of versions.
SMALL: dict[str, Any] = {
    "environment": "CartPole-v1",
    "lead": 2,
    "max_return": 500.0,
    "batch_size": 64,
    "hidden": [16, 16],
    "learning_rate": 3e-3,
    "n_warm_up_episodes": 12,
    "warm_up_hold_steps": 2,
    "n_episodes_per_iter": 6,
    "n_updates_per_iter": 10,
    "replay_size": 30,
    "max_age": 6,
    "recent_size": 15,
    "last_few": 10,
    "hold_share": 0.3,
    "hold_steps": 8,
    "return_scale": 0.02,
    "horizon_scale": 0.02,
    "eval_every": 1500,
    "eval_episodes": 5,
}
TOY: dict[str, Any] = SMALL | {
    "environment": "Figure2-v0",
    "max_return": 2.0,
    "eval_every": 50,
    "segments": "all",
}


LANDER: dict[str, Any] = SMALL | {
    "environment": "LunarLander-v3",
    "max_return": None,
    "baseline": "value",
    "max_train_steps": 500,
    "n_warm_up_episodes": 20,
    "n_episodes_per_iter": 10,
    "eval_every": 5000,
}

#: An environment in which obedience is trivial: an agent obtains its desired return, from 0 to 4.
OBEDIENT: dict[str, Any] = {
    "environment": "Obedience-v0", "environment_kwargs": {"steps": 4}, "hidden": [32, 32],
    "n_warm_up_episodes": 300, "replay_size": 400, "recent_size": 400, "last_few": 100,
    "batch_size": 128, "learning_rate": 0.01, "n_updates_per_iter": 300, "n_episodes_per_iter": 5,
    "return_scale": 1.0, "horizon_scale": 0.3, "eval_every": 100, "eval_episodes": 5,
}  # fmt: skip


def small(**changes: Any) -> Config:
    return build(Config, SMALL | changes)


def toy(**changes: Any) -> Config:
    return build(Config, TOY | changes)


def lander(**changes: Any) -> Config:
    return build(Config, LANDER | changes)


def digests(status: Status | Run) -> tuple[int, str, str]:
    return status.iteration, status.weights_sha256, status.replay_sha256


def reference(config: Config, max_env_steps: int) -> Run:
    return algorithm1(config, Budget(max_env_steps=max_env_steps))


def assert_conserved(status: Status) -> None:
    commands, episodes = status.commands, status.episodes
    assert commands.issued == commands.accepted + commands.cancelled + commands.outstanding
    assert episodes.delivered == episodes.accepted + episodes.duplicate + episodes.rejected


class Cli:
    """The command ``udrl`` in its own process, and its output."""

    def __init__(self, *arguments: str, cwd: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "udrl_launch", *arguments],
            cwd=cwd,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def finish(self, timeout: float = 60) -> tuple[int, str, str]:
        try:
            out, err = self.process.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            self.process.terminate()
            out, err = self.process.communicate(timeout=20)
            raise AssertionError(f"still running after {timeout} s:\n{err}") from None
        return self.process.returncode, out, err

    def status(self, timeout: float = 60) -> Status:
        code, out, err = self.finish(timeout)
        assert code == 0, err
        return msgspec.json.decode(out.strip().splitlines()[-1], type=Status)


def arguments(config: dict[str, Any], max_env_steps: int, run_dir: Path) -> list[str]:
    """Return the arguments of ``udrl train`` for a configuration."""
    given = [
        f"{name}={json.dumps(value)}"
        for name, value in config.items()
        if name != "environment" and value is not None
    ]
    return [
        "train", config["environment"], "--preset", "none", "--run-dir", str(run_dir), "--json",
        *(item for assignment in given for item in ("--set", assignment)),
        "--max-env-steps", str(max_env_steps),
    ]  # fmt: skip


def wait_for(condition: Callable[[], Any], what: str, timeout: float = 40) -> Any:
    """Poll a condition until it is true; return its value."""
    deadline = time.monotonic() + timeout
    pause = threading.Event()
    while not (value := condition()):
        assert time.monotonic() < deadline, f"waited {timeout} s for {what}"
        pause.wait(0.02)
    return value


def live_status(run_dir: Path) -> Status | None:
    """Return a run's status, or None while there is no run."""
    try:
        return status_of(run_dir)
    except UdrlError:
        return None


def children(pid: int) -> dict[str, int]:
    """Return the pids of the services that a process started, by the names of their logs."""
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal():
            continue
        try:
            parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
            command = (entry / "cmdline").read_bytes().split(b"\0")
        except (OSError, ValueError, IndexError):
            continue
        if parent == pid and b"udrl_launch" in command:
            role = command[command.index(b"udrl_launch") + 1].decode()
            found[role if role not in found else f"{role}-{entry.name}"] = int(entry.name)
    return found


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def configured_router(endpoint: str, keys_dir: Path) -> zenoh.Session:
    """Return a router with the generated configuration of ``zenohd`` for this endpoint."""
    text = (Path(__file__).parents[2] / "deploy" / "zenohd.json5").read_text(encoding="utf-8")
    text = text.replace("tls/0.0.0.0:7447", endpoint)
    return zenoh.open(zenoh.Config.from_json5(text.replace("/etc/udrl", f"{keys_dir}/replay")))


def kill_at(process: Cli, run_dir: Path, role: str, iteration: int) -> None:
    """Kill a service at a given iteration, and wait for its replacement."""

    def is_reached() -> bool:
        status = live_status(run_dir)
        return status is not None and status.iteration >= iteration

    wait_for(is_reached, f"iteration {iteration}")
    pid = children(process.process.pid)[role]
    os.kill(pid, signal.SIGKILL)
    wait_for(lambda: not is_running(pid), f"{role} to exit")
    wait_for(
        lambda: (
            children(process.process.pid).get(role, pid) != pid
            or process.process.poll() is not None
        ),
        f"another {role}",
    )
