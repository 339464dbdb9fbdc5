"""The actor starts again with exact arithmetic when the fast one is not."""

import os
import subprocess
import sys
from typing import Any

import pytest
from click.testing import CliRunner

from udrl.errors import InexactArithmetic
from udrl.numerics import STRICT_MKL
from udrl_launch import roles
from udrl_launch.cli import cli


class Replaced(Exception):
    """Another program would run now."""


@pytest.fixture
def programs(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, str]]:
    """Environments of the programs that would have replaced this one."""
    environments = []

    def inexact(*_: Any, **__: Any) -> None:
        raise InexactArithmetic("rows depend on each other")

    def execve(path: str, command: list[str], environment: dict[str, str]) -> None:
        environments.append(environment)
        raise Replaced

    monkeypatch.setattr(roles, "actor", inexact)
    monkeypatch.setattr(os, "execve", execve)
    return environments


ACTOR = ["actor", "--connect", "tcp/127.0.0.1:1"]


def test_inexact_actor_is_started_again_in_strict_mode(programs: list[dict[str, str]]) -> None:
    result = CliRunner().invoke(cli, ACTOR)
    assert isinstance(result.exception, Replaced)
    assert STRICT_MKL.items() <= programs[0].items()


def test_actor_that_is_inexact_in_strict_mode_too_gives_up(
    programs: list[dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in STRICT_MKL.items():
        monkeypatch.setenv(name, value)
    code = cli(ACTOR, standalone_mode=False)
    assert code == InexactArithmetic.exit_code
    assert programs == []


def test_end_does_not_wait_for_callbacks() -> None:
    """Zenoh's threads outlive a session; an interpreter that ends under them hangs or aborts."""
    program = """
import sys, threading, click, zenoh
from udrl_launch import cli
from udrl_proto.session import listen
from udrl_launch.training import free_port

@click.command()
def busy():
    called = threading.Event()

    def callback(sample):
        called.set()
        while True:
            pass

    with listen(f"tcp/127.0.0.1:{free_port()}") as session:
        session.declare_subscriber("key", callback)
        session.put("key", b"")
        assert called.wait(10)
    print("worked")
    return 3

cli.cli.add_command(busy)
sys.argv = ["udrl", "busy"]
cli.main()
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=30)
    assert (ended.returncode, ended.stdout, ended.stderr) == (3, b"worked\n", b"")
