from functools import reduce
from operator import add

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from udrl.episode import Episode, action_dtype, cumulative

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
def test_rewards_are_summed_in_float64_one_after_the_other(rewards: list[float]) -> None:
    sums = [0.0]
    for reward in rewards:
        sums.append(sums[-1] + reward)
    result = cumulative(np.array(rewards, np.float32))
    assert result.dtype == np.float64
    assert result.tolist() == sums


def test_the_order_of_summation_is_fixed_also_where_it_costs_precision() -> None:
    # Each small reward alone is lost in rounding; numpy's pairwise sum would add them up first.
    rewards = np.array([1e10] + [1e-7] * 1000, np.float32)
    assert cumulative(rewards)[-1] == rewards[0]
    assert np.sum(rewards, dtype=np.float64) > rewards[0]


@given(st.lists(floats32, min_size=1, max_size=300))
def test_the_return_is_the_sum_of_all_rewards(rewards: list[float]) -> None:
    assert episode(rewards).episode_return == reduce(add, rewards, 0.0)
    assert episode(rewards).length == len(rewards)


@pytest.mark.parametrize(("n", "dtype"), [(2, np.uint8), (256, np.uint8), (257, np.int32)])
def test_actions_are_kept_in_the_smaller_type_that_holds_them(n: int, dtype: type) -> None:
    assert action_dtype(n) is dtype
    assert np.iinfo(action_dtype(n)).max >= n - 1
