"""What the pages of results show is made of the tables that lie beside them."""

import re
from pathlib import Path

import pytest

from tests.markdown import ROOT, text_of
from udrl_experiments.records import Evaluated, Obtained
from udrl_experiments.statistics import CurvePoint, Reached, curves, reached
from udrl_inspect.tables import read

RESULTS = ROOT / "docs" / "results"
STUDIES = sorted(path.parent for path in RESULTS.rglob("evaluations.csv"))
EVERY = 50_000


def name(folder: Path) -> str:
    return str(folder.relative_to(RESULTS))


@pytest.mark.parametrize("folder", STUDIES, ids=name)
def test_tables_are_made_of_the_evaluations(folder: Path) -> None:
    rows = read(folder / "evaluations.csv", Evaluated)
    points = read(folder / "curves.csv", CurvePoint)
    assert points == curves(rows, EVERY)
    found = read(folder / "reached.csv", Reached)
    assert found == reached(rows, sorted({row.threshold for row in found}))


@pytest.mark.parametrize("folder", STUDIES, ids=name)
def test_pictures_show_every_line(folder: Path) -> None:
    points = read(folder / "curves.csv", CurvePoint)
    picture = (folder / "learning-curves.svg").read_text(encoding="utf-8")
    for algorithm, variant, seeds in {(p.algorithm, p.variant, p.seeds) for p in points}:
        words = " ".join(word for word in (algorithm, variant) if word)
        assert f"{words} ({seeds} seed" in picture


@pytest.mark.parametrize("table", sorted(RESULTS.glob("sensitivity*/*.csv")), ids=lambda p: p.stem)
def test_sensitivity_has_100_episodes_a_point(table: Path) -> None:
    rows = read(table, Obtained)
    assert {row.episodes for row in rows} == {100}
    seeds = {row.seed for row in rows}
    assert len(rows) == len(seeds) * len({row.desired_return for row in rows})
    picture = table.with_suffix(".svg").read_text(encoding="utf-8")
    assert all(f"seed {seed}" in picture for seed in seeds)


def test_the_pages_show_what_lies_there_and_the_other_way_round() -> None:
    text = text_of("docs/results.md") + text_of("docs/experiments.md")
    shown = set(re.findall(r"\(results/([^)#]+)\)", text))
    lie = {str(path.relative_to(RESULTS)) for path in RESULTS.rglob("*.*") if path.is_file()}
    pictures = {one for one in lie if one.endswith((".png", ".gif"))}
    assert shown <= lie
    assert pictures <= shown
