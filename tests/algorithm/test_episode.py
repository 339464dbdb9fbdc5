import dataclasses
from functools import reduce
from operator import add
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from udrl.actions import Categorical
from udrl.environments import EnvironmentSpec
from udrl.episode import Episode, cumulative, fault
from udrl.spaces import Vector

floats32 = st.floats(-1e6, 1e6, width=32)


def episode(rewards: list[float]) -> Episode:
    n = len(rewards)
    return Episode(
        command_id=1,
        observations=np.zeros((n, 2), np.float32),
        actions=np.zeros(n, np.uint8),
        rewards=np.array(rewards, np.float32),
        terminated=True,
        truncated=False,
    )


@given(st.lists(floats32, max_size=300))
def test_rewards_are_summed_in_float64_in_order(rewards: list[float]) -> None:
    sums = [0.0]
    for reward in rewards:
        sums.append(sums[-1] + reward)
    result = cumulative(np.array(rewards, np.float32))
    assert result.dtype == np.float64
    assert result.tolist() == sums


def test_summation_order_is_fixed_even_where_it_loses_precision() -> None:
    # Each small reward alone is lost in rounding; numpy's pairwise sum would add them up first.
    rewards = np.array([1e10] + [1e-7] * 1000, np.float32)
    assert cumulative(rewards)[-1] == rewards[0]
    assert np.sum(rewards, dtype=np.float64) > rewards[0]


@given(st.lists(floats32, min_size=1, max_size=300))
def test_return_is_the_sum_of_all_rewards(rewards: list[float]) -> None:
    assert episode(rewards).episode_return == reduce(add, rewards, 0.0)
    assert episode(rewards).length == len(rewards)


SPEC = EnvironmentSpec(
    observation_space=Vector(size=2), action_space=Categorical(n=3), max_episode_steps=4
)


def test_valid_episode_has_no_faults() -> None:
    for n in range(1, 5):
        assert fault(episode([0.5] * n), SPEC) is None


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"rewards": np.zeros(0, np.float32)}, r"rewards are float32 (0,), expected float32, one"),
        ({"rewards": np.zeros(5, np.float32)}, r"one dimension of 1 to 4 steps"),
        ({"rewards": np.zeros((2, 1), np.float32)}, r"rewards are float32 (2, 1)"),
        ({"rewards": np.zeros(2)}, r"rewards are float64 (2,)"),
        ({"rewards": np.array([0, np.nan], np.float32)}, "rewards are not all finite numbers"),
        ({"observations": np.zeros((2, 3), np.float32)},
         "observations are float32 (2, 3), expected float32 (2, 2)"),
        ({"observations": np.full((2, 2), np.inf, np.float32)},
         "observations are not all finite numbers"),
        ({"actions": np.zeros(3, np.uint8)}, "actions are uint8 (3,), expected uint8 (2,)"),
        ({"actions": np.zeros(2, np.int64)}, "actions are int64 (2,), expected uint8 (2,)"),
        ({"actions": np.array([0, 3], np.uint8)}, "actions are from 0 to 3, expected 0 to 2"),
        ({"terminated": False}, "it neither terminated nor was truncated"),
    ],
)  # fmt: skip
def test_invalid_episode_is_described(wrong: dict[str, Any], message: str) -> None:
    found = fault(dataclasses.replace(episode([0.0, 1.0]), **wrong), SPEC)
    assert found is not None
    assert message in found
