from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from tests.replay.synthetic import create
from udrl_replay.quarantine import OFFENCES, Quarantine
from udrl_replay.store import Store


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with closing(create(tmp_path)) as made:
        yield made


def test_offences_are_counted_by_actor_in_bounded_memory(store: Store) -> None:
    quarantine = Quarantine(store)
    assert [quarantine.count("a") for _ in range(OFFENCES)] == [False] * (OFFENCES - 1) + [True]
    for i in range(5000):
        assert not quarantine.count(f"b{i}")
    assert len(quarantine._offences) <= 1000
    assert quarantine.count("a"), "the worst offender must not be forgotten"


def test_quarantine_is_stored_with_its_reason(store: Store) -> None:
    quarantine = Quarantine(store)
    assert "a" not in quarantine
    quarantine.add("a", "a false episode")
    again = Quarantine(store)
    assert "a" in again
    assert not again.count("a"), "later offences must not count"
    refusal = again.refusal("a")
    assert refusal.code == "quarantined"
    assert "a false episode" in str(refusal)


def test_number_of_stored_quarantines_is_bounded(store: Store) -> None:
    quarantine = Quarantine(store)
    with store.transaction():
        for i in range(1001):
            quarantine.add(f"a{i}", "x")
        quarantine.add("last", "y" * 5000)
    assert len(quarantine.reasons) == 1000
    assert "a0" not in quarantine
    assert len(quarantine.reasons["last"]) == 1000
