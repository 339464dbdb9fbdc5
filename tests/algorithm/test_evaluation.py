import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from udrl.evaluation import summarise


@given(st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=50))
def test_mean_sample_deviation_and_interval_are_the_textbooks(returns: list[float]) -> None:
    mean, std = np.mean(returns), np.std(returns, ddof=1)
    half = 1.96 * std / np.sqrt(len(returns))
    evaluation = summarise(returns)
    assert evaluation == pytest.approx(
        (mean, std, mean - half, mean + half, len(returns)), abs=1e-9
    )


def test_one_episode_has_no_spread() -> None:
    assert summarise([7.0]) == (7.0, 0.0, 7.0, 7.0, 1)


def test_the_order_of_the_episodes_does_not_matter() -> None:
    returns = [0.1, 1e9, 0.2, -1e9, 0.3]
    assert summarise(returns) == summarise(returns[::-1])
