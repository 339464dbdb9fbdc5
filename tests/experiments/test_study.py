import json
import re
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest

from udrl.config import Config, build, flat
from udrl.errors import ConfigError, InvalidData, RunFailed
from udrl_experiments.jobs import Job
from udrl_experiments.protocol import Algorithm
from udrl_experiments.provenance import provenance
from udrl_experiments.records import EvaluationRecord
from udrl_experiments.runs import finished_run, is_finished
from udrl_experiments.study import Study, StudyFolders, run_study
from udrl_inspect.csv_tables import write


def job(seed: int, max_env_steps: int = 100, variant: str = "") -> Job:
    config = build(Config, {"environment": "CartPole-v1", "seed": seed, "eval_every": 5})
    return Job(
        algorithm="UDRL", settings=flat(config), max_env_steps=max_env_steps, variant=variant
    )


class World:
    """A study whose runs are only recorded."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.done: list[Job] = []
        self.reported: list[StudyFolders] = []

    def report(self, place: StudyFolders) -> str:
        self.reported.append(place)
        return "all is well"

    def conduct(self, *jobs: Job, resume: bool = False) -> None:
        def run_jobs(planned: Sequence[Job], *others: Any) -> None:
            self.done = list(planned)

        study = Study("try", jobs, self.report, run_jobs)
        self.output = run_study(
            study, self.root, side_by_side=1, resume=resume, stop=threading.Event(),
            echo=lambda text: None,
        )  # fmt: skip


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World(tmp_path)


def test_report_follows_the_runs(world: World) -> None:
    world.conduct(job(1), job(2))
    assert world.done == [job(1), job(2)]
    assert world.reported == [StudyFolders(world.root, world.root / "try")]
    assert world.output == "all is well"


def test_finished_study_is_recorded(world: World) -> None:
    world.conduct(job(1), job(2))
    about = json.loads((world.root / "try" / "study.json").read_text())
    assert msgspec.convert(about["runs"], list[Job]) == [job(1), job(2)]
    assert about["study"] == "try"


def test_provenance_has_versions_and_the_kind_of_machine() -> None:
    found = provenance()
    assert {"udrl", "python", "torch", "numpy", "gymnasium"} <= set(found["versions"])
    assert found["machine"].cores >= 1
    assert re.fullmatch(r"([0-9a-f]{40}( and changes)?)?", found["commit"])


@pytest.mark.parametrize(
    ("module", "algorithm"),
    [("matplotlib", "UDRL"), ("stable_baselines3", "A2C"), ("Box2D", "UDRL")],
)
def test_missing_package_is_reported_before_the_first_run(
    world: World, monkeypatch: pytest.MonkeyPatch, module: str, algorithm: Algorithm
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    settings = flat(job(1).config) | {"environment": "LunarLander-v3"}
    needy = msgspec.structs.replace(job(1), algorithm=algorithm, settings=settings)
    with pytest.raises(ConfigError, match=rf'{module}.*pip install "udrl\[box2d,doom,studies\]"'):
        world.conduct(needy)
    assert not world.done
    assert not (world.root / "try").exists()


def test_existing_study_is_not_overwritten(world: World) -> None:
    world.conduct(job(1))
    with pytest.raises(ConfigError, match=r"already contains a study; pass --resume to resume it"):
        world.conduct(job(1))


@pytest.mark.parametrize("jobs", [(job(1), job(2)), (job(1, 500),), (job(1), job(1, 7))])
def test_study_is_resumed_with_the_same_or_more_runs(world: World, jobs: tuple[Job, ...]) -> None:
    world.conduct(job(1))
    world.conduct(*jobs, resume=True)
    assert world.done == list(jobs)


@pytest.mark.parametrize("jobs", [(job(2),), (job(1, 99),), ()])
def test_study_is_not_resumed_with_fewer_runs(world: World, jobs: tuple[Job, ...]) -> None:
    world.conduct(job(1))
    with pytest.raises(ConfigError, match=r"seed 1: 100 env steps, which is not in this one"):
        world.conduct(*jobs, resume=True)


def test_search_begun_without_variants_is_resumed(world: World) -> None:
    world.conduct(job(1))
    world.conduct(job(1, variant="configuration 0"), resume=True)
    with pytest.raises(ConfigError, match=r"configuration 0, .*which is not in this one"):
        world.conduct(job(1), resume=True)


def test_run_too_short_for_an_evaluation_is_rejected(world: World) -> None:
    world.conduct(job(1, 5))
    with pytest.raises(
        ConfigError, match=r"a run of 4 env steps has no evaluation, because eval_every = 5; raise"
    ):
        world.conduct(job(2, 4), resume=True)
    assert world.done == [job(1, 5)]


def test_damaged_record_is_reported(world: World) -> None:
    world.conduct(job(1))
    (world.root / "try" / "study.json").write_text('{"runs": [{}]}')
    with pytest.raises(InvalidData, match=r"study\.json.*delete it"):
        world.conduct(job(1), resume=True)


def test_failed_runs_prevent_the_report(world: World) -> None:
    def fail(*arguments: Any) -> None:
        raise RunFailed("no")

    study = Study("try", [job(1)], world.report, fail)
    with pytest.raises(RunFailed):
        run_study(study, world.root, side_by_side=1, resume=False, stop=threading.Event(),
                echo=lambda text: None)  # fmt: skip
    assert not world.reported


@pytest.mark.parametrize(("shares_runs", "place"), [(True, "."), (False, "try")])
def test_runs_are_taken_from_other_folders(
    tmp_path: Path, *, shares_runs: bool, place: str
) -> None:
    other = tmp_path / "other"
    folder = job(1).folder(other / place)
    folder.mkdir(parents=True)
    row = EvaluationRecord(
        environment="CartPole-v1", algorithm="UDRL", variant="", seed=1, env_steps=100, wall_s=1.0,
        mean=2.0, std=3.0, episodes=4,
    )  # fmt: skip
    write(folder / "evaluations.csv", EvaluationRecord, [row])
    (folder / "job.json").write_bytes(msgspec.json.encode(job(1)))
    (folder / "done.json").write_text('{"max_env_steps": 100}')

    def report(place: StudyFolders) -> str:
        return str(finished_run(job(1), place.root).evaluations[0].mean)

    study = Study("try", [job(1)], report, lambda *_: None, shares_runs=shares_runs)
    output = run_study(
        study, tmp_path / "here", side_by_side=1, resume=False, stop=threading.Event(),
        echo=lambda text: None, runs_from=[other],
    )  # fmt: skip
    assert output == "2.0"


def test_longer_runs_are_taken_from_other_folders_if_finished(tmp_path: Path) -> None:
    longer = msgspec.structs.replace(job(1), max_env_steps=500)
    here, done = tmp_path / "here", '{"max_env_steps": 500}'
    for run, finished in ((longer, done), (job(2), '{"max_env_steps": 100}')):
        folder = run.folder(tmp_path / "other")
        folder.mkdir(parents=True)
        row = EvaluationRecord(
            environment="CartPole-v1", algorithm="UDRL", variant="", seed=1, env_steps=100,
            wall_s=1.0, mean=2.0, std=3.0, episodes=4,
        )  # fmt: skip
        write(folder / "evaluations.csv", EvaluationRecord, [row])
        (folder / "job.json").write_bytes(msgspec.json.encode(run))
        (folder / "done.json").write_text(finished)
    possible = [longer, msgspec.structs.replace(job(2), max_env_steps=500)]
    study = Study("try", [job(1), job(2)], lambda _: "", lambda *_: None, possible=possible)
    run_study(
        study, here, side_by_side=1, resume=False, stop=threading.Event(),
        echo=lambda text: None, runs_from=[tmp_path / "other"],
    )  # fmt: skip
    assert [is_finished(one, here) for one in possible] == [True, False]
    assert [is_finished(job(seed), here) for seed in (1, 2)] == [True, True]


def test_source_without_runs_creates_no_study(world: World, tmp_path: Path) -> None:
    study = Study("try", [job(1)], world.report, lambda *_: None)
    with pytest.raises(ConfigError, match=r"--runs-from .*nowhere: expected a folder of studies"):
        run_study(study, world.root, side_by_side=1, resume=False, stop=threading.Event(),
                echo=lambda text: None, runs_from=[tmp_path / "nowhere"])  # fmt: skip
    assert not (world.root / "try").exists()


def test_missing_strategy_is_reported_before_the_first_run(world: World) -> None:
    settings = flat(job(1).config) | {"command_strategy": "not.there:Missing"}
    with pytest.raises(ConfigError, match=r"not\.there:Missing"):
        world.conduct(job(1), msgspec.structs.replace(job(1), settings=settings))
    assert not world.done


def test_unwritable_folder_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"--folder .*file.*choose a writable folder"):
        World(tmp_path / "file").conduct(job(1))
