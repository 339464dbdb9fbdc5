"""Names of services: unique, and told apart by machine."""

import platform

import pytest

from udrl_inspect.address import host_name, is_of_this_machine, unique_name


def on(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "node", lambda: host)


def test_names_differ_and_are_known_as_this_machines() -> None:
    names = [unique_name("actor") for _ in range(2)]
    assert len(set(names)) == 2
    assert all(is_of_this_machine(name, "actor") for name in names)
    assert not any(is_of_this_machine(name, "learner") for name in names)


def test_machine_whose_name_goes_on_is_another_one(monkeypatch: pytest.MonkeyPatch) -> None:
    on("gpu-2", monkeypatch)
    name = unique_name("actor")
    on("gpu", monkeypatch)
    assert not is_of_this_machine(name, "actor")


def test_long_names_differ_though_they_are_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    names = []
    for pod in (
        "research-team-alpha-actor-7d9c5b6f4d-abcde",
        "research-team-alpha-actor-7d9c5b6f4d-f",
    ):
        on(pod, monkeypatch)
        names.append(host_name("actor"))
        assert len(unique_name("actor")) <= 64
    assert names[0] != names[1]


@pytest.mark.parametrize("host", ["", "ä.ö", "a.b_c"])
def test_any_host_makes_a_name_that_can_be_a_key(
    host: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    on(host, monkeypatch)
    assert set(host_name("actor")) <= set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ-")
