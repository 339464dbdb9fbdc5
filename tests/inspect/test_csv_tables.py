from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from udrl.errors import InvalidData
from udrl_experiments.records import EvaluationRecord, Obtained
from udrl_experiments.statistics import Reached
from udrl_inspect.csv_tables import read, write

FINITE = st.floats(allow_nan=False, allow_infinity=False)
COUNTS = st.integers(0, 2**53)
NAMES = st.text(st.characters(exclude_categories=["C", "Z"]), max_size=20)
REACHED = st.builds(
    Reached, environment=NAMES, algorithm=NAMES, variant=NAMES, seed=COUNTS, threshold=FINITE,
    env_steps=st.none() | COUNTS, wall_s=st.none() | FINITE,
)  # fmt: skip


@given(rows=st.lists(REACHED, max_size=5))
def test_table_round_trips(tmp_path_factory: pytest.TempPathFactory, rows: list[Reached]) -> None:
    path = tmp_path_factory.mktemp("table") / "rows.csv"
    write(path, Reached, rows)
    assert read(path, Reached) == rows


@pytest.mark.parametrize(
    "text",
    ["", "seed,mean\n1,2\n", "environment,algorithm,variant,seed\nx,UDRL,,one\n", "\xff\0"],
)
def test_invalid_table_is_rejected(tmp_path: Path, text: str) -> None:
    path = tmp_path / "rows.csv"
    path.write_text(text + "environment\nx\n", encoding="latin-1")
    with pytest.raises(InvalidData, match=r"rows\.csv: .*delete it"):
        read(path, EvaluationRecord)


def test_missing_table_is_reported(tmp_path: Path) -> None:
    with pytest.raises(InvalidData, match=r"none\.csv"):
        read(tmp_path / "none.csv", Obtained)


def test_first_line_has_the_column_names(tmp_path: Path) -> None:
    write(tmp_path / "empty.csv", Obtained, [])
    first = (tmp_path / "empty.csv").read_text(encoding="utf-8")
    assert first == ",".join(f.name for f in msgspec.structs.fields(Obtained)) + "\n"
