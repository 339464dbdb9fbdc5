from fractions import Fraction
from itertools import combinations
from typing import Any
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from udrl import experience as experience_module
from udrl.actions import Categorical
from udrl.config import Config, build
from udrl.environments import EnvironmentSpec
from udrl.episode import Episode
from udrl.errors import ConfigError
from udrl.experience import Experience
from udrl.segments import Segments
from udrl.spaces import Vector


def experience(replay_size: int, max_steps: int) -> Experience:
    config = build(
        Config, {"environment": "CartPole-v1", "replay_size": replay_size, "last_few": 1}
    )
    return Experience(
        config,
        EnvironmentSpec(
            observation_space=Vector(size=2),
            action_space=Categorical(n=3),
            max_episode_steps=max_steps,
        ),
    )


def random_episode(episode_id: int, length: int) -> Episode:
    """An episode whose rewards are multiples of 1/8, so that all sums are exact."""
    rng = np.random.default_rng(episode_id)
    return Episode(
        command_id=episode_id,
        observations=rng.standard_normal((length, 2), np.float32),
        actions=rng.integers(3, size=length, dtype=np.uint8),
        rewards=(rng.integers(-800, 800, size=length) / 8).astype(np.float32),
        terminated=True,
        truncated=False,
    )


def example(episode: Episode, t1: int, t2: int) -> tuple[Any, ...]:
    """Section 2.3.3: in s_t1, to earn sum(r[t1..t2-1]) in t2 - t1 steps, the action is a_t1."""
    desired_return = sum(float(episode.rewards[t]) for t in range(t1, t2))
    return (
        episode.observations[t1].tolist(),
        desired_return,
        t2 - t1,
        int(episode.actions[t1]),
    )


def all_times(length: int) -> list[tuple[int, int]]:
    return list(combinations(range(length + 1), 2))


def gathered(held: Experience, ids: list[int], wanted: list[tuple[int, int, int]]) -> list[Any]:
    """The examples for (rank, t1, t2), row by row."""
    segments = Segments(*np.array(wanted, np.int64).reshape(-1, 3).T)
    (seen,), command, action = held.by_rank(ids).examples(segments)
    return [
        (s.tolist(), float(r), int(h), int(a))
        for s, (r, h), a in zip(seen, command, action, strict=True)
    ]


@pytest.mark.parametrize("length", [1, 2, 9])
def test_every_segment_makes_the_papers_example(length: int) -> None:
    episode = random_episode(5, length)
    held = experience(replay_size=1, max_steps=length)
    held.add(episode)
    wanted = [(0, t1, t2) for t1, t2 in all_times(length)]
    assert gathered(held, [5], wanted) == [example(episode, t1, t2) for _, t1, t2 in wanted]


@given(st.lists(st.floats(-1e4, 1e4, width=32), min_size=1, max_size=40))
def test_desired_return_is_the_exact_sum_up_to_rounding(rewards: list[float]) -> None:
    n = len(rewards)
    held = experience(replay_size=1, max_steps=n)
    held.add(
        Episode(
            command_id=0,
            observations=np.zeros((n, 2), np.float32),
            actions=np.zeros(n, np.uint8),
            rewards=np.array(rewards, np.float32),
            terminated=True,
            truncated=False,
        )
    )
    times = all_times(n)
    results = gathered(held, [0], [(0, t1, t2) for t1, t2 in times])
    for (t1, t2), (_, desired_return, _, _) in zip(times, results, strict=True):
        exact = sum(map(Fraction, rewards[t1:t2]), Fraction(0))
        assert abs(Fraction(desired_return) - exact) < 1e-9


def test_example_has_the_dtypes_that_training_reads() -> None:
    held = experience(replay_size=1, max_steps=4)
    held.add(random_episode(0, 4))
    examples = held.by_rank([0]).examples(Segments(*np.array([[0], [1], [4]])))
    assert [seen.dtype for seen in examples.seen] == [np.float32]
    assert examples.command.dtype == np.float64
    assert examples.action.dtype == np.uint8


@pytest.mark.parametrize("first_pages", [1, 256])
@pytest.mark.parametrize("length", [1, 63, 64, 65, 128, 200])
def test_episodes_of_any_length_cross_page_boundaries(
    length: int, first_pages: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(experience_module, "_MIN_PAGES", first_pages)
    held = experience(replay_size=3, max_steps=200)
    episodes = {i: random_episode(i, n) for i, n in enumerate([200, length, 200])}
    for episode in episodes.values():
        held.add(episode)
    wanted = [
        (rank, t1, episode.length)
        for rank, episode in episodes.items()
        for t1 in range(episode.length)
    ]
    wanted += [(1, t1, t1 + 1) for t1 in range(length)]
    expected = [example(episodes[rank], t1, t2) for rank, t1, t2 in wanted]
    assert gathered(held, [0, 1, 2], wanted) == expected


def test_memory_is_allocated_on_demand_for_any_step_limit() -> None:
    held = experience(replay_size=500, max_steps=2**31)
    for i in range(20):
        held.add(random_episode(i, 100))
    assert sum(a.nbytes for a in vars(held).values() if isinstance(a, np.ndarray)) < 1e6


def test_insufficient_memory_is_rejected_with_the_settings_to_lower(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def no_memory(array: Any, more: int) -> Any:
        raise MemoryError

    held = experience(replay_size=3, max_steps=200)
    monkeypatch.setattr(experience_module, "_longer", no_memory)
    with pytest.raises(ConfigError, match=r"memory for 16,384 steps.*lower replay_size"):
        held.add(random_episode(1, 100))


class ExperienceMachine(RuleBasedStateMachine):
    """Random additions and removals, compared with a dictionary."""

    replay_size, max_steps = 4, 150

    def __init__(self) -> None:
        super().__init__()
        self.few = mock.patch.object(experience_module, "_MIN_PAGES", 1)
        self.few.start()
        self.held = experience(self.replay_size, self.max_steps)
        self.model: dict[int, Episode] = {}
        self.next_id = 0

    def teardown(self) -> None:
        self.few.stop()

    @precondition(lambda self: len(self.model) < self.replay_size)
    @rule(length=st.integers(1, max_steps))
    def add(self, length: int) -> None:
        self.model[self.next_id] = random_episode(self.next_id, length)
        self.held.add(self.model[self.next_id])
        self.next_id += 1

    @precondition(lambda self: self.model)
    @rule(data=st.data())
    def remove(self, data: st.DataObject) -> None:
        gone = data.draw(st.sampled_from(sorted(self.model)))
        self.held.remove(gone)
        del self.model[gone]
        assert gone not in self.held

    @precondition(lambda self: self.model)
    @rule(data=st.data())
    def look_up(self, data: st.DataObject) -> None:
        ids = data.draw(st.permutations(sorted(self.model)))
        episodes = [self.model[i] for i in ids]
        wanted = []
        for rank, episode in enumerate(episodes):
            t2 = data.draw(st.integers(1, episode.length))
            wanted += [(rank, t1, t2) for t1 in range(t2)]
        assert self.held.by_rank(ids).lengths.tolist() == [e.length for e in episodes]
        assert gathered(self.held, ids, wanted) == [
            example(episodes[rank], t1, t2) for rank, t1, t2 in wanted
        ]

    @invariant()
    def ids_equal_those_of_the_dictionary(self) -> None:
        assert self.held.ids() == set(self.model)
        assert all(i in self.held for i in self.model)


TestExperienceMachine = ExperienceMachine.TestCase
TestExperienceMachine.settings = settings(max_examples=50, stateful_step_count=30)
