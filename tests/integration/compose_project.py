"""A Compose project with a real engine, and operations on it."""

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
    """Return the output of a command, which must succeed."""
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=timeout, env=os.environ | (env or {})
    )
    assert done.returncode == 0, f"{' '.join(command)}: {done.stdout}{done.stderr}"
    return done.stdout


def compose_command() -> list[str]:
    """Return the command of Compose: v2 is a plugin, 1.29 a program.

    Skips the test without a running engine.
    """
    if shutil.which("docker") is None:
        pytest.skip("docker is not installed")
    engine = subprocess.run(["docker", "info"], capture_output=True, text=True, timeout=30)
    if engine.returncode != 0:
        pytest.skip(f"no Docker engine replies: {engine.stderr.strip().splitlines()[-1]}")
    plugin = subprocess.run(["docker", "compose", "version"], capture_output=True, timeout=30)
    if plugin.returncode == 0:
        return ["docker", "compose"]
    if shutil.which("docker-compose") is None:
        pytest.skip("neither `docker compose` nor `docker-compose` is installed")
    return ["docker-compose"]


class Project:
    """``compose.yaml`` and its overrides, as a project with its own name.

    A context manager: on exit it removes everything; a failure includes the services' logs.

    Args:
        name: name of the project; remains of an earlier one are removed.
        files: file names in the repository's root.
        variables: environment variables for the files.
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

    def set_variables(self, **variables: str) -> None:
        """Set variables for later commands."""
        self._variables |= variables

    def compose(self, *arguments: str, timeout: float = 120) -> str:
        """Run Compose."""
        return run(*self._command, *arguments, timeout=timeout, env=self._variables)

    def containers(self, service: str) -> list[str]:
        """Return the ids of a service's containers, including those that have exited."""
        labels = {"project": self.name, "service": service}
        filters = [f"--filter=label=com.docker.compose.{k}={v}" for k, v in labels.items()]
        return run("docker", "ps", "--all", "--quiet", *filters).split()

    def scale(self, actors: int) -> None:
        """Set the number of actors."""
        self.compose("up", "--detach", "--scale", f"actor={actors}")

    def store(self) -> Status:
        """Return the run's status from the store."""
        volume = ["--volume", f"{self.name}_runs:/runs"]
        command = ["status", f"/runs/{self._variables['ENV']}", "--json"]
        return _status(run("docker", "run", "--rm", "--read-only", *volume, IMAGE, *command))

    def live(self, *options: str) -> Status | None:
        """Return the status of the replay service; None while it does not reply."""
        (replay,) = self.containers("replay")
        command = ["docker", "exec", replay, "udrl", "status", "--json", *options]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        return _status(done.stdout) if done.returncode == 0 else None

    def kill(self, service: str) -> None:
        """Kill all processes of a service's first container; the restart policy must restart it."""
        container = self.containers(service)[0]
        before = self._restarts(container)
        subprocess.run(
            ["docker", "exec", container, "sh", "-c", "kill -9 -1"], capture_output=True, timeout=30
        )
        wait_for(lambda: self._restarts(container) > before, f"{service} to be restarted")

    def _restarts(self, container: str) -> int:
        found: Any = json.loads(run("docker", "inspect", container))
        return int(found[0]["RestartCount"])

    def exit_codes(self, service: str) -> list[int]:
        """Return the exit codes of a service's containers."""
        ids = self.containers(service)
        return [int(code) for code in run("docker", "wait", *ids, timeout=300).split()]

    def down(self) -> None:
        """Remove everything, including the run."""
        self.compose("down", "--volumes", "--remove-orphans")
