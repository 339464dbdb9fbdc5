from collections.abc import Sequence
from hashlib import sha256
from math import floor, prod, sqrt
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from udrl.actions import Categorical
from udrl.commands import (
    EVALUATION_SEEDS,
    SEARCH_SEEDS,
    TRAINING_SEEDS,
    Command,
    CommandSampler,
)
from udrl.config import COMMANDS_PER_ITERATION, Config, build
from udrl.environments import EnvironmentSpec
from udrl.replay_buffer import Entry, ReplayBuffer
from udrl.spaces import Vector
from udrl.streams import Purpose, Stream, stream_key


def settings(**values: Any) -> Config:
    return build(Config, {"environment": "CartPole-v1", **values})


SPEC = EnvironmentSpec(
    observation_space=Vector(size=4), action_space=Categorical(n=2), max_episode_steps=500
)


def sampler(**values: Any) -> CommandSampler:
    return CommandSampler(settings(**values), SPEC)


def buffer_of(returns: Sequence[float], lengths: Sequence[int] = ()) -> ReplayBuffer:
    lengths = lengths or [1] * len(returns)
    entries = zip(returns, range(len(returns)), lengths, strict=True)
    config = settings(replay_size=len(returns), last_few=1)
    return ReplayBuffer(config.buffer, [Entry(*entry) for entry in entries])


def desired_returns(commands: list[Command]) -> list[float]:
    return [command.desired_return for command in commands]


def desired_horizons(commands: list[Command]) -> set[int]:
    return {command.desired_horizon for command in commands}


@given(
    st.lists(st.tuples(st.floats(-300, 300, width=32), st.integers(1, 500)), min_size=1),
    st.integers(1, 20),
    st.integers(0, 3),
)
def test_exploratory_commands_follow_section_2_3_4(
    episodes: list[tuple[float, int]], last_few: int, seed: int
) -> None:
    config = settings(seed=seed, last_few=last_few, n_episodes_per_iter=5)
    episodes.sort()
    buffer = buffer_of(*zip(*episodes, strict=True))
    commands = CommandSampler(config, SPEC).explore(3, buffer)

    # 1: select a number of episodes from the end of the replay buffer
    selected = episodes[-last_few:]
    # 2: the horizon is the mean of their lengths, rounded to the nearest integer
    steps, n = sum(length for _, length in selected), len(selected)
    # 3: draw the returns from U[M, M + S]
    m = np.mean([episode_return for episode_return, _ in selected])
    s = sqrt(np.mean([(episode_return - m) ** 2 for episode_return, _ in selected]))
    u = Stream(stream_key(seed, Purpose.COMMANDS, 3, -1)).uniforms(5)

    assert desired_returns(commands) == pytest.approx((m + s * u).tolist(), rel=1e-12, abs=1e-9)
    assert desired_horizons(commands) == {(2 * steps + n) // (2 * n)}
    assert {command.kind for command in commands} == {"explore"}


def test_only_the_last_few_episodes_count_or_all_if_there_are_fewer() -> None:
    best_two = sampler(last_few=2).evaluate(1, buffer_of([-100.0, 10.0, 20.0], [9, 1, 3]))
    assert set(desired_returns(best_two)) == {15.0}
    assert desired_horizons(best_two) == {2}
    all_three = sampler(last_few=50).evaluate(1, buffer_of([-30.0, 10.0, 20.0], [8, 1, 3]))
    assert set(desired_returns(all_three)) == {0.0}
    assert desired_horizons(all_three) == {4}


@pytest.mark.parametrize(
    ("lengths", "horizon"), [([1, 1, 2], 1), ([1, 2], 2), ([2, 3], 3), ([2, 3, 3], 3), ([7], 7)]
)
def test_mean_length_is_rounded_to_the_nearest_integer(lengths: list[int], horizon: int) -> None:
    commands = sampler().explore(1, buffer_of([0.0] * len(lengths), lengths))
    assert desired_horizons(commands) == {horizon}


def test_deviation_is_the_population_standard_deviation() -> None:
    commands = sampler(n_episodes_per_iter=10_000).explore(1, buffer_of([0.0, 4.0]))
    assert 2.0 <= min(desired_returns(commands)) < 2.01
    assert 3.99 < max(desired_returns(commands)) < 4.0


def test_exploratory_returns_are_uniform() -> None:
    commands = sampler(n_episodes_per_iter=10_000).explore(1, buffer_of([0.0, 2.0]))
    empirical = np.sort(desired_returns(commands)) - 1.0
    # The Kolmogorov-Smirnov distance exceeds 1.95 / sqrt(n) once in a thousand samples.
    assert np.abs(empirical - np.linspace(0, 1, 10_000)).max() < 1.95 / sqrt(10_000)


def test_exploratory_returns_are_the_mean_without_spread() -> None:
    commands = sampler().explore(1, buffer_of([500.0] * 10))
    assert set(desired_returns(commands)) == {500.0}


def test_evaluation_commands_use_the_lower_bound_and_the_same_horizon() -> None:
    buffer = buffer_of([1.0, 2.0, 6.0], [10, 20, 31])
    sample = sampler(eval_episodes=7)
    evaluation = sample.evaluate(2, buffer)
    assert desired_returns(evaluation) == [3.0] * 7
    assert desired_horizons(evaluation) == desired_horizons(sample.explore(2, buffer)) == {20}
    assert {command.kind for command in evaluation} == {"evaluate"}


def test_warm_up_commands_have_weights_version_0() -> None:
    commands = sampler(n_warm_up_episodes=3, lead=2).warm_up()
    assert [(c.id, c.kind, c.weights_version) for c in commands] == [
        (0, "warm_up", 0),
        (1, "warm_up", 0),
        (2, "warm_up", 0),
    ]


@pytest.mark.parametrize(("lead", "version"), [(0, 5), (1, 4), (3, 2), (7, 1)])
def test_weights_version_follows_the_schedule(lead: int, version: int) -> None:
    sample, buffer = sampler(lead=lead), buffer_of([1.0])
    commands = sample.explore(5, buffer) + sample.evaluate(5, buffer)
    assert {command.weights_version for command in commands} == {version}


def buffer_with_lengths(lengths: Sequence[Sequence[int]]) -> ReplayBuffer:
    """A buffer of iterations with episodes of these lengths; all returns differ."""
    entries = [
        Entry(float(10 * i + k), i * COMMANDS_PER_ITERATION + k, length)
        for i, iteration in enumerate(lengths)
        for k, length in enumerate(iteration)
    ]
    return ReplayBuffer(settings().buffer, entries)


@pytest.mark.parametrize(
    ("newest", "expected"),
    [([200, 200], 5), ([100], 10), ([13] * 5, 77), ([1] * 5, 1000), ([20, 60], 25)],
)
def test_number_of_episodes_follows_n_steps_per_iter(newest: list[int], expected: int) -> None:
    sample = sampler(n_episodes_per_iter=5, n_steps_per_iter=1000, last_few=2)
    buffer = buffer_with_lengths([[7, 7, 7], newest])
    commands = sample.explore(2, buffer)
    assert len(commands) == expected
    assert sample.evaluate(2, buffer)[0].index == expected


def test_training_command_is_reproduced_without_its_buffer() -> None:
    sample = sampler(n_episodes_per_iter=5, n_steps_per_iter=1000)
    for command in sample.explore(3, buffer_with_lengths([[20] * 9])):
        again = sample.training_command(command.id)
        assert again == msgspec.structs.replace(
            command, desired_return=0.0, desired_horizon=again.desired_horizon
        )


def test_final_evaluation_has_the_final_weights_and_fresh_seeds() -> None:
    sample, buffer = sampler(lead=3, eval_episodes=50), buffer_of([1.0, 3.0])
    final, usual = sample.evaluate_final(9, buffer), sample.evaluate(9, buffer)
    assert {command.weights_version for command in final} == {9}
    assert desired_returns(final) == [2.0] * 50
    assert {c.environment_seed for c in final}.isdisjoint(c.environment_seed for c in usual)
    assert {c.stream_key for c in final}.isdisjoint(c.stream_key for c in usual)


def test_training_limit_applies_to_training_episodes_only() -> None:
    sample, buffer = sampler(max_train_steps=100), buffer_of([1.0])
    training = sample.warm_up() + sample.explore(1, buffer)
    evaluation = sample.evaluate(1, buffer) + sample.evaluate_final(1, buffer)
    assert {command.max_steps for command in training} == {100}
    assert {command.max_steps for command in evaluation} == {500}


def test_training_limit_above_the_environments_has_no_effect() -> None:
    assert {command.max_steps for command in sampler(max_train_steps=900).warm_up()} == {500}


def test_evaluation_temperature_applies_to_evaluations_only() -> None:
    buffer = buffer_of([1.0])
    for request in (1.0, 0.5, 0.0):
        sample = sampler(eval_temperature=request)
        training = sample.warm_up() + sample.explore(1, buffer)
        evaluation = sample.evaluate(1, buffer) + sample.evaluate_final(1, buffer)
        assert {command.temperature for command in training} == {1.0}
        assert {command.temperature for command in evaluation} == {request}


def test_seed_ranges_are_the_papers_and_disjoint() -> None:
    assert TRAINING_SEEDS == (1_000_000, 10_000_000)
    assert SEARCH_SEEDS == (500_000, 1_000_000)
    assert EVALUATION_SEEDS == (1, 500_000)


@given(
    seed=st.integers(0, 2**63 - 1),
    lead=st.integers(0, 4),
    n=st.integers(1, 8),
    iterations=st.integers(1, 5),
)
def test_commands_of_a_run_are_distinct_and_within_their_seed_range(
    seed: int, lead: int, n: int, iterations: int
) -> None:
    sample = sampler(
        seed=seed, lead=lead, n_warm_up_episodes=n, n_episodes_per_iter=n, eval_episodes=n
    )
    buffer = buffer_of([1.0, 2.0])
    commands = sample.warm_up()
    for i in range(1, iterations + 1):
        commands += sample.explore(i, buffer) + sample.evaluate(i, buffer)
        commands += sample.evaluate_final(i, buffer)

    assert len({command.id for command in commands}) == len(commands)
    assert [command.id for command in commands] == sorted(command.id for command in commands)
    assert len({command.stream_key for command in commands}) == len(commands)
    for command in commands:
        low, high = EVALUATION_SEEDS if command.kind == "evaluate" else TRAINING_SEEDS
        assert low <= command.environment_seed < high
        assert command.stream_key == stream_key(
            seed, Purpose.EPISODE, command.iteration, command.index
        )
        # Another process accepts every command that one may send.
        assert msgspec.convert(msgspec.to_builtins(command), Command) == command


def test_commands_depend_on_seed_iteration_and_buffer_only() -> None:
    buffer = buffer_of([1.0, 2.0])
    fresh, used = sampler(), sampler()
    used.warm_up()
    used.explore(1, buffer)
    assert used.explore(2, buffer) == fresh.explore(2, buffer)
    assert sampler(seed=2).explore(2, buffer) != fresh.explore(2, buffer)


def test_id_encodes_iteration_and_index() -> None:
    command = sampler(n_episodes_per_iter=3).evaluate(12, buffer_of([1.0]))[0]
    assert (command.id, command.iteration, command.index) == (12_000_003, 12, 3)


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_share_of_exploratory_episodes_holds_an_action(share: float) -> None:
    config = {
        "hold_share": share, "hold_steps": 7, "command_strategy": "ranked", "max_train_steps": 60,
        "n_episodes_per_iter": 1000,
    }  # fmt: skip
    buffer = buffer_of([1.0, 2.0], [20, 50])
    explored = sampler(**config).explore(3, buffer)
    others = sampler(**config | {"hold_share": 0.0}).explore(3, buffer)
    usual = {"random_from": 0, "random_steps": 0, "random_hold": 1}
    assert [msgspec.structs.replace(c, **usual) for c in explored] == others
    held = [c for c in explored if c.random_steps]
    assert {(c.random_steps, c.random_hold) for c in held} <= {(7, 7)}
    assert abs(len(held) - 1000 * share) <= 5 * sqrt(1000 * share * (1 - share))
    where = [c.random_from / min(60, c.desired_horizon) for c in held]
    assert all(0 <= part < 1 for part in where)
    if held:
        assert abs(sum(where) / len(where) - 0.5) < 0.1
    for command in sampler(**config).evaluate(3, buffer):
        assert command.random_steps == 0


@pytest.mark.parametrize("hold", [1, 3])
def test_warm_up_is_random_at_every_step(hold: int) -> None:
    for command in sampler(warm_up_hold_steps=hold, max_train_steps=60).warm_up():
        numbers, random = command.decisions(60, ())
        assert random.all()
        assert numbers.tolist() == [numbers[t - t % hold] for t in range(60)]


@pytest.mark.parametrize("shape", [(), (3,)])
def test_held_action_uses_the_numbers_of_its_first_step(shape: tuple[int, ...]) -> None:
    (command,) = sampler(n_episodes_per_iter=1).explore(1, buffer_of([1.0]))
    usual = Stream(command.stream_key).uniforms(9 * prod(shape)).reshape(9, *shape)
    numbers, random = command.decisions(9, shape)
    assert not random.any()
    assert numbers.tolist() == usual.tolist()
    held = msgspec.structs.replace(command, random_from=2, random_steps=4, random_hold=4)
    numbers, random = held.decisions(9, shape)
    assert np.flatnonzero(random).tolist() == [2, 3, 4, 5]
    assert numbers.tolist() == usual[[0, 1, 2, 2, 2, 2, 6, 7, 8]].tolist()


@given(st.binary(min_size=16, max_size=16), st.floats(0.01, 1), st.integers(1, 4))
def test_random_rate_holds_actions_of_all_lengths(key: bytes, rate: float, hold: int) -> None:
    (command,) = sampler(n_episodes_per_iter=1).explore(1, buffer_of([1.0]))
    command = msgspec.structs.replace(command, stream_key=key, random_rate=rate, random_hold=hold)
    usual = Stream(key).uniforms(300)
    begins = Stream(sha256(key).digest()[:16]).uniforms(300)
    expected, held_until = [], 0
    for t in range(300):
        if t >= held_until:
            since = t
            if begins[t] < rate:
                held_until = t + hold * floor(1 / (1 - begins[t] / rate))
        expected.append((usual[since], held_until > t))
        if held_until <= t + 1:
            since = t + 1
    numbers, random = command.decisions(300, ())
    assert list(zip(numbers, random, strict=True)) == expected
    fewer = command.decisions(70, ())
    assert fewer.numbers.tolist() == numbers[:70].tolist()
    assert fewer.random.tolist() == random[:70].tolist()


def test_multiples_of_the_hold_are_at_least_n_with_probability_1_in_n() -> None:
    (command,) = sampler(n_episodes_per_iter=1).explore(1, buffer_of([1.0]))
    command = msgspec.structs.replace(command, random_rate=0.2)
    numbers, random = command.decisions(200_000, ())
    begun = np.flatnonzero(np.diff(numbers, prepend=-1.0) != 0)
    lengths = np.diff(begun)[random[begun[:-1]]]
    for n in (2, 5, 10):
        assert (lengths >= n).mean() == pytest.approx(1 / n, rel=0.1)


def test_random_rate_replaces_the_single_held_action() -> None:
    config = {"hold_share": 1.0, "hold_rate": 0.25, "hold_steps": 5}
    for command in sampler(**config).explore(1, buffer_of([1.0])):
        assert (command.random_rate, command.random_hold, command.random_steps) == (0.25, 5, 0)


@pytest.mark.parametrize("max_return", [None, 12.0])
def test_evaluation_return_is_capped_at_max_return(max_return: float | None) -> None:
    spec = msgspec.structs.replace(SPEC, max_return=max_return)
    sample, buffer = CommandSampler(settings(), spec), buffer_of([1.0])
    assert {c.cap for c in sample.evaluate(1, buffer)} == {max_return}
    assert {c.cap for c in sample.explore(1, buffer) + sample.warm_up()} == {None}
