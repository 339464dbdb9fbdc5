from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from udrl.config import COMMANDS_PER_ITERATION, build
from udrl.replay_buffer import Entry, ReplayBuffer
from udrl.setting_groups import BufferSettings

# Few different returns cause many ties. Episodes arrive in batches, one for each iteration.
batches = st.lists(st.lists(st.sampled_from([-1.0, -0.5, 0.0, 0.5, 1.0]), max_size=6), max_size=8)
capacities = st.integers(1, 10)
recents = st.integers(0, 10)
ages = st.none() | st.integers(1, 4)


def settings(replay_size: int, recent_size: int = 0, max_age: int | None = None) -> BufferSettings:
    values = {"replay_size": replay_size, "recent_size": recent_size, "max_age": max_age}
    return build(BufferSettings, values)


def numbered(batches: list[list[float]]) -> list[list[Entry]]:
    """Entries with increasing ids; each batch is an iteration."""
    return [
        [Entry(r, n * COMMANDS_PER_ITERATION + i, length=1) for i, r in enumerate(returns)]
        for n, returns in enumerate(batches)
    ]


def top_k(seen: list[Entry], k: int) -> list[Entry]:
    """Remove the oldest of the worst until k remain; then sort, ties by age."""
    left = list(seen)
    while len(left) > k:
        worst = min(entry.episode_return for entry in left)
        left.remove(min((e for e in left if e.episode_return == worst), key=lambda e: e.id))
    left.sort(key=lambda entry: entry.id)
    left.sort(key=lambda entry: entry.episode_return)
    return left


@given(batches, capacities, recents)
def test_buffer_holds_the_top_k_of_all_episodes_and_the_newest(
    batches: list[list[float]], capacity: int, recent: int
) -> None:
    buffer = ReplayBuffer(settings(capacity, recent))
    seen: list[Entry] = []
    for entries in numbered(batches):
        before = [*buffer, *entries]
        evicted = buffer.admit(entries)
        seen += entries
        greatest, newest = top_k(seen, capacity), seen[len(seen) - min(recent, len(seen)) :]
        assert list(buffer.best(capacity)) == greatest
        assert list(buffer) == sorted({*greatest, *newest})
        assert sorted([*evicted, *buffer]) == sorted(before)
        assert evicted == sorted(evicted)


@given(batches, capacities, recents, st.integers(1, 4))
def test_age_limit_keeps_the_best_of_the_last_iterations(
    batches: list[list[float]], capacity: int, recent: int, max_age: int
) -> None:
    buffer = ReplayBuffer(settings(capacity, recent, max_age))
    held: list[Entry] = []
    for n, entries in enumerate(numbered(batches)):
        held += entries
        if entries:  # an iteration without episodes does not advance the age
            held = [e for e in held if n - e.id // COMMANDS_PER_ITERATION < max_age]
        newest = held[len(held) - min(recent, len(held)) :]
        held = [e for e in held if e in newest or e in top_k(held, capacity)]
        buffer.admit(entries)
        assert list(buffer) == sorted(held)


@given(batches, capacities, st.randoms(use_true_random=False))
def test_best_episodes_do_not_depend_on_the_order_of_arrival(
    batches: list[list[float]], capacity: int, random: Random
) -> None:
    straight, shuffled = ReplayBuffer(settings(capacity)), ReplayBuffer(settings(capacity))
    entries = [entry for batch in numbered(batches) for entry in batch]
    straight.admit(entries)
    random.shuffle(entries)
    for entry in entries:
        shuffled.admit([entry])
    assert list(shuffled) == list(straight)


@given(batches, capacities, st.integers(1, 12))
def test_best_n_are_the_last_or_all_if_there_are_fewer(
    batches: list[list[float]], capacity: int, n: int
) -> None:
    buffer = ReplayBuffer(settings(capacity))
    for entries in numbered(batches):
        buffer.admit(entries)
    everything = list(buffer)
    best = list(buffer.best(n))
    assert len(best) == min(n, len(everything))
    assert everything[len(everything) - len(best) :] == best


def test_ties_rank_newer_episodes_higher_and_evict_the_oldest_first() -> None:
    buffer = ReplayBuffer(settings(3))
    assert buffer.admit([Entry(500.0, i, 500) for i in (3, 1, 2)]) == []
    assert [entry.id for entry in buffer] == [1, 2, 3]
    assert [entry.id for entry in buffer.admit([Entry(500.0, 4, 500)])] == [1]
    assert [entry.id for entry in buffer] == [2, 3, 4]


def test_new_episode_below_the_buffers_minimum_is_discarded() -> None:
    buffer = ReplayBuffer(settings(2))
    buffer.admit([Entry(1.0, 1, 1), Entry(2.0, 2, 1)])
    assert buffer.admit([Entry(0.0, 3, 1)]) == [Entry(0.0, 3, 1)]
    assert [entry.id for entry in buffer] == [1, 2]


@given(batches, capacities, recents, ages, st.randoms(use_true_random=False))
def test_restored_buffer_behaves_like_the_original(
    batches: list[list[float]], capacity: int, recent: int, max_age: int | None, random: Random
) -> None:
    config = settings(capacity, recent, max_age)
    buffer = ReplayBuffer(config)
    for entries in numbered(batches):
        held = list(buffer)
        random.shuffle(held)
        restored = ReplayBuffer(config, held)
        assert buffer.admit(entries) == restored.admit(entries)
        assert list(buffer) == list(restored)


@pytest.mark.parametrize("order", [(1, 2, 3), (3, 2, 1), (2, 3, 1)])
def test_buffer_is_restored_from_entries_in_any_order(order: tuple[int, ...]) -> None:
    buffer = ReplayBuffer(settings(3), [Entry(float(i), i, 1) for i in order])
    assert [entry.id for entry in buffer] == [1, 2, 3]
