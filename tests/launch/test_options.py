"""Values of options."""

import click
import pytest
from hypothesis import given
from hypothesis import strategies as st

from udrl_launch.subcommands.options import STEPS


@pytest.mark.parametrize(
    ("text", "steps"),
    [
        ("10M", 10_000_000),
        ("500k", 500_000),
        ("1.5M", 1_500_000),
        ("250_000", 250_000),
        ("7", 7),
        ("1,000,000", 1_000_000),
        ("1e5", 100_000),
        ("2.5E6", 2_500_000),
    ],
)
def test_step_counts_may_have_suffixes(text: str, steps: int) -> None:
    assert STEPS.convert(text, None, None) == steps


@pytest.mark.parametrize(
    "text",
    [
        "",
        "0",
        "10G",
        "M",
        "-5",
        "1e16",
        "1e-3",
        "1e",
        "1e+6",
        "0.1",
        "1,5M",
        "1,50",
        "1,",
        "9" * 16,
        "9" * 30,
    ],
)
def test_invalid_step_count_is_rejected(text: str) -> None:
    with pytest.raises(click.BadParameter, match="500K"):
        STEPS.convert(text, None, None)


@given(st.integers(1, 2**53))
def test_step_count_round_trips(steps: int) -> None:
    assert STEPS.convert(str(steps), None, None) == steps
