"""Figures and tables of the results pages are generated from the CSV files beside them."""

import re
from collections import defaultdict
from pathlib import Path
from statistics import fmean

import pytest

from tests.markdown import ROOT, section, tables, text_of
from udrl_experiments.records import EvaluationRecord, Obtained, agent_name
from udrl_experiments.runs import is_finished, read_job
from udrl_experiments.statistics import CurvePoint, Reached, curves, reached
from udrl_inspect.csv_tables import read

RESULTS = ROOT / "docs" / "results"
RUNS = sorted(path.parent for path in RESULTS.glob("runs/*/job.json"))
STUDIES = sorted({path.parent for path in RESULTS.rglob("evaluations.csv")} - set(RUNS))
EVERY = 50_000


def name(folder: Path) -> str:
    return str(folder.relative_to(RESULTS))


def anchor(heading: str) -> str:
    return "#" + re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


@pytest.mark.parametrize("folder", STUDIES, ids=name)
def test_tables_match_the_evaluations(folder: Path) -> None:
    rows = read(folder / "evaluations.csv", EvaluationRecord)
    points = read(folder / "curves.csv", CurvePoint)
    assert points == curves(rows, EVERY)
    found = read(folder / "reached.csv", Reached)
    assert found
    assert found == reached(rows, sorted({row.threshold for row in found}))


def test_kept_runs_are_recognised() -> None:
    assert RUNS
    for folder in RUNS:
        job = read_job(folder)
        assert folder == job.folder(RESULTS)
        assert is_finished(job, RESULTS)


def evaluations_at(study: str) -> dict[int, dict[str, float]]:
    """Return mean returns by the env steps at which they were due, and by seed."""
    found: dict[int, dict[str, float]] = defaultdict(dict)
    rows = read(RESULTS / study / "evaluations.csv", EvaluationRecord)
    for row in sorted(rows, key=lambda row: row.env_steps):
        found[row.env_steps // EVERY * EVERY].setdefault(str(row.seed), row.mean)
    return found


@pytest.mark.parametrize(("number", "study"), [(0, "lander"), (1, "sparse")])
def test_table_of_seeds_has_the_evaluations(number: int, study: str) -> None:
    of_seeds = [t for t in tables(section("docs/results.md", "## Landers")) if t[0][0] == "seed"]
    header, *rows = of_seeds[number]
    found = evaluations_at(study)
    assert {row[0] for row in rows} == {*found[100_000], "mean"}
    for seed, *cells in rows:
        for head, cell in zip(header[1:], cells, strict=True):
            millions = re.search(r"([\d.]+)M", head)
            assert millions is not None
            at = found[round(float(millions[1]) * 1e6)]
            expected = fmean(at.values()) if seed == "mean" else at[seed]
            assert float(cell.strip("*")) == round(expected), (seed, head)


@pytest.mark.parametrize("page", ["README.md", "docs/results.md"])
@pytest.mark.parametrize(
    ("environment", "study"), [("LunarLander", "lander"), ("LunarLanderSparse", "sparse")]
)
def test_summary_has_the_evaluations(page: str, environment: str, study: str) -> None:
    (row,) = re.findall(
        rf"^\| (?:\[{environment}\]\(#landers\), UDRL|{environment}) \|.* after 1M.*$",
        text_of(page),
        flags=re.MULTILINE,
    )
    said = re.search(r"(\d+) after 1M(?: env steps)?\*{0,2} \((\d+) to (\d+), (\w+) seeds\)", row)
    assert said is not None
    mean, low, high, seeds = said.groups()
    at = evaluations_at(study)[1_000_000].values()
    assert [int(mean), int(low), int(high)] == [round(v) for v in (fmean(at), min(at), max(at))]
    assert {"seven": 7, "nine": 9}[seeds] == len(at)


@pytest.mark.parametrize("folder", STUDIES, ids=name)
def test_figures_show_every_line(folder: Path) -> None:
    points = read(folder / "curves.csv", CurvePoint)
    picture = (folder / "learning-curves.svg").read_text(encoding="utf-8")
    for algorithm, variant, seeds in {(p.algorithm, p.variant, p.seeds) for p in points}:
        assert f"{agent_name(algorithm, variant)} ({seeds} seed" in picture


@pytest.mark.parametrize("table", sorted(RESULTS.glob("sensitivity*/*.csv")), ids=lambda p: p.stem)
def test_sensitivity_has_100_episodes_per_point(table: Path) -> None:
    rows = read(table, Obtained)
    assert {row.episodes for row in rows} == {100}
    seeds = {row.seed for row in rows}
    assert len(rows) == len(seeds) * len({row.desired_return for row in rows})
    picture = table.with_suffix(".svg").read_text(encoding="utf-8")
    assert all(f"seed {seed}" in picture for seed in seeds)


def test_studies_are_kept() -> None:
    assert STUDIES
    assert list(RESULTS.glob("sensitivity*/*.csv"))


def test_every_figure_is_shown_and_every_shown_file_exists() -> None:
    text = text_of("docs/results.md") + text_of("docs/experiments.md")
    shown = set(re.findall(r"\(results/([^)#]+)\)", text))
    present = {str(path.relative_to(RESULTS)) for path in RESULTS.rglob("*.*") if path.is_file()}
    pictures = {file for file in present if file.endswith((".png", ".gif"))}
    assert shown <= present
    assert pictures <= shown


def test_every_result_answers_its_question() -> None:
    parts = re.split(r"^#{2,3} ", text_of("docs/results.md"), flags=re.MULTILINE)[1:]
    results = [part for part in parts if not part.startswith("Summary")]
    assert results
    for result in results:
        questions, answers = result.count("**Question.**"), result.count("**Answer.**")
        assert (questions, answers) == (1, 1), result[:80]
        assert result.index("**Question.**") < result.index("**Answer.**")


def test_every_experiment_is_listed_with_its_question() -> None:
    page = text_of("docs/experiments.md")
    contents, _, entries = page.partition("\n## ")
    headings = re.findall(r"^### (.+)$", entries, flags=re.MULTILINE)
    assert headings
    assert all(heading.endswith("?") for heading in headings)
    groups = re.findall(r"^## (.+)$", f"\n## {entries}", flags=re.MULTILINE)
    listed = re.findall(r"\]\((#[^)]+)\)", contents)
    expected = [*headings, *(group for group in groups if group != "How to read this page")]
    assert sorted(listed) == sorted(anchor(heading) for heading in expected)
