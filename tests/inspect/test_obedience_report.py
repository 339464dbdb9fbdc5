"""The report on obedience: its text, its files, and what it rejects."""

import csv
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import click
import msgspec
import pytest

from udrl.errors import ConfigError, InvalidData, StoreError
from udrl_inspect import csv_tables
from udrl_inspect.obedience_report import (
    FILE,
    Agreement,
    ObediencePoint,
    ObedienceReport,
    load_report,
    save_report,
)
from udrl_inspect.obedience_text import COLUMNS, answer, best, horizons, markdown, rows, rule, table
from udrl_launch.subcommands.options import RETURNS
from udrl_show.obedience_picture import draw_obedience


def point(
    desired_return: float, desired_horizon: int, mean: float, length: float = 50
) -> ObediencePoint:
    return ObediencePoint(
        desired_return=desired_return, desired_horizon=desired_horizon, episodes=10,
        return_mean=mean, return_std=3.0, return_ci95_low=mean - 2, return_ci95_high=mean + 2,
        length_mean=length, length_std=1.0, length_ci95_low=length - 1, length_ci95_high=length + 1,
    )  # fmt: skip


def report(
    obtained: Callable[[float], float] = lambda r: r,
    obeyed: tuple[float, float] | None = None,
    correlation: float = 0.5,
    tolerance: float = 20.0,
) -> ObedienceReport:
    commanded = [-20.0, 30.0, 80.0, 130.0]
    agree = {"mean_absolute_error": 7.25, "correlation": correlation}
    return ObedienceReport(
        run_id="run", environment="Some-v0", weights_version=7, temperature=1.0, episodes=10,
        reachable_low=-20.0, reachable_high=180.0, tolerance=tolerance,
        by_return=[point(r, 40 + i, obtained(r)) for i, r in enumerate(commanded)],
        by_horizon=[point(100.0, h, 90.0, h + 5) for h in (10, 20)],
        all_returns=Agreement(low=-20.0, high=130.0, **agree),
        obeyed=None if obeyed is None else Agreement(low=obeyed[0], high=obeyed[1], **agree),
        all_horizons=Agreement(low=10, high=20, mean_absolute_error=5, correlation=1),
    )  # fmt: skip


def test_summary_of_an_agent_that_obeys_in_part() -> None:
    assert answer(report(obeyed=(30.0, 80.0), correlation=0.97)) == (
        "You can command returns from 30 to 80 (mean absolute error 7, correlation 0.97). "
        "Outside this range, do not expect the commanded return."
    )


def test_summary_of_an_agent_that_obeys_everywhere() -> None:
    assert answer(report(obeyed=(-20.0, 130.0), tolerance=4.0)) == (
        "You can command returns from -20 to 130 (mean absolute error 7.2, correlation 0.50). "
        "No other returns were measured."
    )


def test_summary_of_an_agent_that_follows_at_a_distance() -> None:
    assert answer(report(lambda r: r / 2 - 100, correlation=0.99)) == (
        "A higher desired return obtains more, but not the desired return itself: commands from "
        "-20 to 130 obtain -110 to -35 on average; mean absolute error 7, correlation 0.99."
    )


@pytest.mark.parametrize("correlation", [0.1, 0.99])
def test_summary_of_an_agent_that_does_not_follow(correlation: float) -> None:
    """A correlation without relevant differences does not count."""
    assert answer(report(lambda r: 60 + r / 50, correlation=correlation)) == (
        "This agent does not follow its command: mean obtained returns vary by 3 over commands "
        f"from -20 to 130 (correlation {correlation:.2f})."
    )


def test_other_sentences_of_the_summary() -> None:
    example = report(lambda r: 100 - abs(r - 80))
    assert best(example) == (
        "Highest mean return: 100 (95 % interval 98 to 102), commanded 80 within 42 steps."
    )
    assert horizons(example) == (
        "Horizons from 10 to 20 steps, commanded with a return of 100: mean lengths from 15 to 25 "
        "steps, mean absolute error 5, correlation 1.00."
    )
    assert horizons(msgspec.structs.replace(example, by_horizon=[], all_horizons=None)) == ""
    assert rule(example).startswith("Obeyed: the mean lies within 20 of the command (10 % of")
    assert rule(report(tolerance=30.0)) == (
        "Obeyed: the mean lies within 30 of the command, and increases with it."
    )


def test_huge_tolerance_hides_no_digits() -> None:
    small = msgspec.structs.replace(
        report(lambda r: 0.0123, tolerance=5.0), reachable_low=0.0, reachable_high=0.5
    )
    assert "Highest mean return: 0.012 (" in best(small)
    alike = msgspec.structs.replace(small, reachable_high=0.0, tolerance=0.0)
    assert "Highest mean return: 0.0123 (" in best(alike)


def test_table_ends_with_the_summary() -> None:
    example = report(obeyed=(30.0, 80.0))
    lines = table(example).splitlines()
    assert lines[0].startswith("Some-v0, weights version 7, temperature 1, 10 episodes")
    assert [line.split() for line in lines[3:5]] == [
        ["-20", "40", "-20", "-22", "to", "-18", "50"],
        ["30", "41", "30", "28", "to", "32", "50", "obeyed"],
    ]
    assert sum(line.endswith("obeyed") for line in lines) == 2
    assert lines[-1] == answer(example)


def test_card_begins_with_the_summary_and_has_the_table() -> None:
    example = report(obeyed=(30.0, 80.0))
    text = markdown(example)
    assert text.startswith(f"**{answer(example)}**\n\n| desired return |")
    assert "| 30 | 41 | 30 | 28 to 32 | 50 | obeyed |" in text
    bars = {line.count("|") for line in text.splitlines() if line.startswith("|")}
    assert bars == {7}


def test_csv_file_has_every_point(tmp_path: Path) -> None:
    example = report(obeyed=(30.0, 80.0))
    csv_tables.write_cells(tmp_path / "obedience.csv", COLUMNS, rows(example))
    with (tmp_path / "obedience.csv").open(newline="") as file:
        found = list(csv.DictReader(file))
    assert list(found[0]) == list(COLUMNS)
    assert [row["sweep"] for row in found] == ["return"] * 4 + ["horizon"] * 2
    assert [row["obeyed"] for row in found] == ["False", "True", "True", "False"] + ["False"] * 2
    shared = [f.name for f in msgspec.structs.fields(ObediencePoint)]
    for row, measured in zip(found, example.by_return + example.by_horizon, strict=True):
        assert [float(row[name]) for name in shared] == list(msgspec.structs.astuple(measured))


@pytest.mark.parametrize("obeyed", [None, (30.0, 80.0)])
def test_figure_shows_the_obeyed_range(tmp_path: Path, obeyed: tuple[float, float] | None) -> None:
    example = report(obeyed=obeyed)
    for name in ("both.svg", "one.png", "one.pdf"):
        draw_obedience(example, tmp_path / "pictures" / name)
        example = msgspec.structs.replace(example, by_horizon=[], all_horizons=None)
    ElementTree.fromstring((tmp_path / "pictures" / "both.svg").read_text())
    assert (tmp_path / "pictures" / "one.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ConfigError, match=r"ends with .png, .svg or .pdf"):
        draw_obedience(example, tmp_path / "picture.bmp")


def test_report_round_trips(tmp_path: Path) -> None:
    assert load_report(tmp_path) is None
    for example in (report(), report(obeyed=(30.0, 80.0))):
        assert save_report(tmp_path, example) == tmp_path / FILE
        assert load_report(tmp_path) == example
    with pytest.raises(StoreError, match="make the directory writable"):
        save_report(tmp_path / "nowhere", report())


@pytest.mark.parametrize(
    "damage",
    [b"", b"\xff", b"[]", b'{"format": 1}', b'"format": 2', b'"tolerance": null',
     b'"correlation": 7', b'"surplus": 1, "format": 1'],
)  # fmt: skip
def test_damaged_report_is_rejected(tmp_path: Path, damage: bytes) -> None:
    written = save_report(tmp_path, report()).read_bytes()
    if damage.startswith(b'"'):
        name = damage.split(b":")[0] if b"surplus" not in damage else b'"format"'
        old = next(line for line in written.splitlines() if line.strip().startswith(name))
        damage = written.replace(old.strip().rstrip(b","), damage)
        assert damage != written
    (tmp_path / FILE).write_bytes(damage)
    with pytest.raises(InvalidData, match=r"obedience\.json: .*measure again: udrl obedience"):
        load_report(tmp_path)


@pytest.mark.parametrize("text", ["", "5", "1:1", "2:1", "a:2", "1:nan", "1:2:3", "1e12:2e12"])
def test_invalid_range_of_returns_is_rejected(text: str) -> None:
    with pytest.raises(click.BadParameter, match=r"is not (LOW:HIGH|a number)"):
        RETURNS.convert(text, None, None)
    assert RETURNS.convert("-100:2.5", None, None) == (-100.0, 2.5)
