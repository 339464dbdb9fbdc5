import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from udrl.evaluation import interval_text, return_text, summarise


@given(st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=50))
def test_mean_deviation_and_interval_equal_the_textbook_formulas(returns: list[float]) -> None:
    mean, std = np.mean(returns), np.std(returns, ddof=1)
    half = 1.96 * std / np.sqrt(len(returns))
    evaluation = summarise(returns)
    assert evaluation == pytest.approx(
        (mean, std, mean - half, mean + half, len(returns)), abs=1e-9
    )


def test_one_episode_has_no_deviation() -> None:
    assert summarise([7.0]) == (7.0, 0.0, 7.0, 7.0, 1)


def test_statistics_do_not_depend_on_the_order_of_episodes() -> None:
    returns = [0.1, 1e9, 0.2, -1e9, 0.3]
    assert summarise(returns) == summarise(returns[::-1])


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0.0"), (-0.0, "0.0"), (0.05, "0.05"), (0.0123456, "0.0123"), (-0.5, "-0.5"),
        (0.9996, "1.0"), (1.0, "1.0"), (1.25, "1.25"), (9.999, "10.0"), (10.04, "10.0"),
        (247.53, "247.5"), (-165.0, "-165.0"), (1e9, "1000000000.0"), (1.234e-7, "1.23e-07"),
        (math.inf, "inf"),
    ],
)  # fmt: skip
def test_return_is_formatted_with_the_necessary_digits(value: float, text: str) -> None:
    assert return_text(value) == text


@given(st.floats(-1e6, 1e6))
def test_formatted_return_parses_to_the_same_value(value: float) -> None:
    read = float(return_text(value))
    assert abs(read - value) <= max(0.0501 if abs(value) >= 10 else 0, 0.0051 * abs(value))


@pytest.mark.parametrize(
    ("mean", "half", "text"),
    [
        (15.8321, 0.0977, "15.83 ± 0.10"),
        (249.25, 5.21, "249.2 ± 5.2"),
        (-0.0712, 0.0038, "-0.071 ± 0.004"),
        (-0.04, 0.5, "0.0 ± 0.5"),
        (500.0, 0.0, "500.0 ± 0.0"),
        (0.0123, 0.0, "0.0123 ± 0.0"),
        (1.0, 1e-9, "1.000000 ± 0.000000"),
    ],
)
def test_interval_has_the_decimals_of_its_half_width(mean: float, half: float, text: str) -> None:
    assert interval_text(mean, half) == text
