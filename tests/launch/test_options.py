"""Values of options."""

from collections.abc import Iterator

import click
import pytest
from hypothesis import given
from hypothesis import strategies as st

from udrl_launch.cli import cli
from udrl_launch.subcommands.options import STEPS, FiniteRange


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


@pytest.mark.parametrize("text", ["nan", "inf", "1e999"])
def test_number_that_is_not_finite_is_rejected(text: str) -> None:
    with pytest.raises(click.BadParameter, match=f"^'{text}': expected a finite number$"):
        FiniteRange(0).convert(text, None, None)


def test_no_option_accepts_numbers_that_are_not_finite() -> None:
    def options(command: click.Command) -> Iterator[click.Parameter]:
        yield from command.params
        if isinstance(command, click.Group):
            context = click.Context(command)
            for name in command.list_commands(context):
                if (one := command.get_command(context, name)) is not None:
                    yield from options(one)

    ranges = {o.name: type(o.type) for o in options(cli) if isinstance(o.type, click.FloatRange)}
    assert "patience" in ranges
    assert set(ranges.values()) == {FiniteRange}
