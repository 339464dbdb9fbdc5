"""Endpoints of local runs, and names of services."""

import fcntl
import platform
from pathlib import Path

import pytest

from udrl_inspect.address import announced, host_name, is_of_this_machine, served_at, unique_name


def set_hostname(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "node", lambda: host)


def test_names_are_distinct_and_recognised_as_local() -> None:
    names = [unique_name("actor") for _ in range(2)]
    assert len(set(names)) == 2
    assert all(is_of_this_machine(name, "actor") for name in names)
    assert not any(is_of_this_machine(name, "learner") for name in names)


def test_host_with_a_longer_name_is_another_host(monkeypatch: pytest.MonkeyPatch) -> None:
    set_hostname("gpu-2", monkeypatch)
    name = unique_name("actor")
    set_hostname("gpu", monkeypatch)
    assert not is_of_this_machine(name, "actor")


def test_long_names_are_truncated_and_stay_distinct(monkeypatch: pytest.MonkeyPatch) -> None:
    names = []
    for pod in (
        "research-team-alpha-actor-7d9c5b6f4d-abcde",
        "research-team-alpha-actor-7d9c5b6f4d-f",
    ):
        set_hostname(pod, monkeypatch)
        names.append(host_name("actor"))
        assert len(unique_name("actor")) <= 64
    assert names[0] != names[1]


@pytest.mark.parametrize("host", ["", "ä.ö", "a.b_c"])
def test_name_of_any_host_is_valid_in_a_key_expression(
    host: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_hostname(host, monkeypatch)
    assert set(host_name("actor")) <= set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ-")


@pytest.mark.parametrize(
    ("listening", "reached"),
    [
        ("tls/0.0.0.0:7447", "tls/127.0.0.1:7447"),
        ("tcp/[::]:7447", "tcp/[::1]:7447"),
        ("tls/10.0.0.5:7447", "tls/10.0.0.5:7447"),
        ("tls/replay.example.org:7447", "tls/replay.example.org:7447"),
        ("tcp/[fe80::1]:7447", "tcp/[fe80::1]:7447"),
    ],
)
def test_run_on_all_interfaces_is_reached_over_loopback(
    listening: str, reached: str, tmp_path: Path
) -> None:
    with announced(tmp_path, listening), (tmp_path / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert served_at(tmp_path) == reached
    assert served_at(tmp_path) is None
