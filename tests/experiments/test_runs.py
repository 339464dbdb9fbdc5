from pathlib import Path

import msgspec
import pytest

from tests.experiments.finished_runs import evaluated, finish, job
from udrl.errors import ConfigError, InvalidData
from udrl_experiments.records import EvaluationRecord
from udrl_experiments.runs import (
    RECORDS,
    copy_finished,
    finished_run,
    is_finished,
    read_job,
    require_runs,
    unfinished,
)
from udrl_inspect.csv_tables import write


def test_a_finished_run_with_other_defaults_is_another_run(tmp_path: Path) -> None:
    one = job(100_000)
    finish(tmp_path, one)
    assert is_finished(one, tmp_path)
    stored = msgspec.structs.replace(one, settings=one.settings | {"memory_size": 65})
    (one.folder(tmp_path) / "job.json").write_bytes(msgspec.json.encode(stored))
    assert not is_finished(one, tmp_path)


def test_evaluations_beyond_the_budget_are_left_out(tmp_path: Path) -> None:
    one = job(300, "mine")
    finish(tmp_path, one)
    rows = [evaluated(n) for n in (105, 203, 310, 400, 950)]
    write(one.folder(tmp_path) / "evaluations.csv", EvaluationRecord, rows)
    found = finished_run(one, tmp_path).evaluations
    assert [(row.env_steps, row.variant) for row in found] == [
        (105, "mine"),
        (203, "mine"),
        (310, "mine"),
    ]


@pytest.mark.parametrize(
    ("text", "done"),
    [('{"max_env_steps": 1000}', True), ('{"max_env_steps": 999}', False), ("", False),
     ("[]", False), ('{"max_env_steps": null}', False), ('{"max_env_steps": 1e999}', False)],
)  # fmt: skip
def test_run_is_finished_if_it_reached_its_budget(tmp_path: Path, text: str, *, done: bool) -> None:
    folder = job().folder(tmp_path)
    folder.mkdir(parents=True)
    (folder / "job.json").write_bytes(msgspec.json.encode(job()))
    (folder / "done.json").write_text(text, encoding="utf-8")
    assert not is_finished(job(), tmp_path), "without evaluations it is not done"
    write(folder / "evaluations.csv", EvaluationRecord, [evaluated(2000)])
    assert not is_finished(job(), tmp_path), "nor with evaluations that are too late"
    write(folder / "evaluations.csv", EvaluationRecord, [evaluated(105)])
    assert is_finished(job(), tmp_path) is done


def test_missing_results_are_reported(tmp_path: Path) -> None:
    one = job(100_000)
    with pytest.raises(InvalidData, match=r"is not a finished run: .*done\.json.*resume the study"):
        finished_run(one, tmp_path)
    finish(tmp_path, one)
    longer = job(200_000)
    with pytest.raises(
        InvalidData, match=r"expected UDRL, .*200,000 env steps, .*found 2 evaluations in 100,000"
    ):
        finished_run(longer, tmp_path)


def test_folder_without_a_run_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(InvalidData, match=r"job\.json"):
        read_job(tmp_path)


def names_in(folder: Path) -> set[str]:
    return {file.name for file in folder.iterdir()}


def test_records_of_finished_runs_are_copied(tmp_path: Path) -> None:
    first, second, here = (tmp_path / name for name in ("first", "second", "here"))
    wanted = [job(100_000, seed=1), job(200_000, seed=2), job(100_000, seed=3)]
    for root, one in ((first, wanted[0]), (first, job(100_000, seed=2)), (second, wanted[1])):
        finish(root, one)
        (one.folder(root) / "log.txt").touch()
    printed: list[str] = []
    copy_finished(wanted, here, [first, second], printed.append)
    assert printed == [
        f"copied from {first}: UDRL, CartPole-v1, seed 1: 100,000 env steps",
        f"copied from {second}: UDRL, CartPole-v1, seed 2: 200,000 env steps",
    ]
    for one, source in ((wanted[0], first), (wanted[1], second)):
        assert names_in(one.folder(here)) == set(RECORDS) < names_in(one.folder(source))
        for name in RECORDS:
            kept = one.folder(here) / name
            assert kept.read_bytes() == (one.folder(source) / name).read_bytes()
    assert unfinished(wanted, here) == wanted[2:]

    copy_finished(wanted, here, [first, second], printed.append)
    assert len(printed) == 2


def test_folder_without_runs_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "runs" / "lander").mkdir(parents=True)
    with pytest.raises(
        ConfigError, match=r"--runs-from .*runs: expected a folder of studies.*--folder"
    ):
        require_runs([tmp_path / "runs"])


@pytest.mark.parametrize("state", ["run", "state.safetensors"])
def test_records_are_not_copied_over_a_run_that_can_be_continued(
    tmp_path: Path, state: str
) -> None:
    other, here = tmp_path / "other", tmp_path / "here"
    short, long = job(100_000), job(200_000)
    finish(other, long)
    finish(here, short)
    (short.folder(here) / state).touch()
    copy_finished([long], here, [other], print)
    assert is_finished(short, here)
    assert not is_finished(long, here)
