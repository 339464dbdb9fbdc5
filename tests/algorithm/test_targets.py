from typing import Any

import numpy as np
import pytest

from udrl.config import build
from udrl.setting_groups import NetworkSettings
from udrl.targets import ReturnInTime


def target(**values: Any) -> ReturnInTime:
    return ReturnInTime(build(NetworkSettings, values))


def test_countdown_equals_lines_8_9_and_11_of_algorithm_2() -> None:
    desired = np.array([[10.0, 5.0], [3.0, 1.0]])
    target().advance(desired, np.array([2.5, -1.0], np.float32))
    assert desired.tolist() == [[7.5, 4.0], [4.0, 0.0]]


def test_desired_return_never_exceeds_the_cap() -> None:
    desired = np.array([[12.0, 5.0], [12.0, 5.0]])
    target().bound(desired, np.array([11.0, np.inf]))
    assert desired.tolist() == [[11.0, 5.0], [12.0, 5.0]]


@pytest.mark.parametrize(("horizon", "expected"), [(7, 7), (0, 1), (-3, 1)])
def test_horizon_is_at_least_one_step(horizon: int, expected: int) -> None:
    assert target().initial(2.5, horizon) == (2.5, expected)


@pytest.mark.parametrize(
    ("desired_return", "expected"), [(300.7, 300), (0.4, 1), (-5.0, 1), (1e12, 2**31)]
)
def test_horizon_that_follows_is_the_return_as_an_integer(
    desired_return: float, expected: int
) -> None:
    assert target(horizon_equals_return=True).initial(desired_return, 99) == (expected, expected)


def test_network_inputs_are_bounded_and_scaled() -> None:
    usual = target(return_scale=0.5, horizon_scale=0.25)
    assert (usual.least, usual.scales) == ((-np.inf, 1.0), (0.5, 0.25))
    assert target(horizon_equals_return=True).least == (1.0, 1.0)
