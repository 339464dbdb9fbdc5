"""A Compose project of ours with a real engine, and what one can do to it."""

import json
import os
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import msgspec
import pytest

from udrl_proto.reports import Status
from whole_run import wait_for

ROOT = Path(__file__).parents[2]
IMAGE = os.environ.get("UDRL_IMAGE", "udrl")
LEARNER_IMAGE = f"{IMAGE}-learner"


def _status(text: str) -> Status:
    return msgspec.json.decode(text, type=Status)


def run(*command: str, timeout: float = 120, env: Mapping[str, str] | None = None) -> str:
    """Return what a command prints; it must succeed."""
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=timeout, env=os.environ | (env or {})
    )
    assert done.returncode == 0, f"{' '.join(command)}: {done.stdout}{done.stderr}"
    return done.stdout


def compose_command() -> list[str]:
    """Return how Compose is called here: v2 is a plugin, 1.29 a program.

    Without an engine that answers, the test is skipped.
    """
    if shutil.which("docker") is None:
        pytest.skip("no Docker here: the command docker is not installed")
    engine = subprocess.run(["docker", "info"], capture_output=True, text=True, timeout=30)
    if engine.returncode != 0:
        pytest.skip(f"no Docker engine answers: {engine.stderr.strip().splitlines()[-1]}")
    plugin = subprocess.run(["docker", "compose", "version"], capture_output=True, timeout=30)
    if plugin.returncode == 0:
        return ["docker", "compose"]
    if shutil.which("docker-compose") is None:
        pytest.skip("no Docker Compose here, neither `docker compose` nor `docker-compose`")
    return ["docker-compose"]


class Project:
    """``compose.yaml`` and its overrides, under a name of their own.

    A context: when it is left nothing remains, and a failure tells what the services logged.

    Args:
        name: of the project; what an earlier one of that name left is removed.
        files: in the repository's root.
        variables: what the files are given.
    """

    def __init__(self, name: str, files: list[str], variables: Mapping[str, str]) -> None:
        self.name = name
        self._variables = dict(variables)
        self._command = [*compose_command(), "--project-name", name]
        for file in files:
            self._command += ["--file", str(ROOT / file)]
        self.down()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        if error is not None:
            error.add_note(self.compose("ps"))
            error.add_note(self.compose("logs", "--no-color", "--timestamps", "--tail", "50"))
        self.down()

    def give(self, **variables: str) -> None:
        """Give the files other values from the next command on."""
        self._variables |= variables

    def compose(self, *arguments: str, timeout: float = 120) -> str:
        """Call Compose."""
        return run(*self._command, *arguments, timeout=timeout, env=self._variables)

    def containers(self, service: str) -> list[str]:
        """Return the ids of a service's containers, those that ended included."""
        labels = {"project": self.name, "service": service}
        filters = [f"--filter=label=com.docker.compose.{k}={v}" for k, v in labels.items()]
        return run("docker", "ps", "--all", "--quiet", *filters).split()

    def scale(self, actors: int) -> None:
        """Have so many actors."""
        self.compose("up", "--detach", "--scale", f"actor={actors}")

    def store(self) -> Status:
        """Return what the run's store says, whoever works on it."""
        volume = ["--volume", f"{self.name}_runs:/runs"]
        command = ["status", f"/runs/{self._variables['ENV']}", "--json"]
        return _status(run("docker", "run", "--rm", "--read-only", *volume, IMAGE, *command))

    def live(self, *options: str) -> Status | None:
        """Return what the replay service answers; None while it does not."""
        (replay,) = self.containers("replay")
        command = ["docker", "exec", replay, "udrl", "status", "--json", *options]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        return _status(done.stdout) if done.returncode == 0 else None

    def kill(self, service: str) -> None:
        """Kill what runs in a service's first container; its restart policy is to mend that."""
        container = self.containers(service)[0]
        before = self._restarts(container)
        subprocess.run(
            ["docker", "exec", container, "sh", "-c", "kill -9 -1"], capture_output=True, timeout=30
        )
        wait_for(lambda: self._restarts(container) > before, f"{service} to be started again")

    def _restarts(self, container: str) -> int:
        found: Any = json.loads(run("docker", "inspect", container))
        return int(found[0]["RestartCount"])

    def exit_codes(self, service: str) -> list[int]:
        """Return how a service's containers ended."""
        ids = self.containers(service)
        return [int(code) for code in run("docker", "wait", *ids, timeout=300).split()]

    def down(self) -> None:
        """Remove everything, the run included."""
        self.compose("down", "--volumes", "--remove-orphans")
