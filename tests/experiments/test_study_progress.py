import json
from pathlib import Path

import msgspec
import pytest
from click.testing import CliRunner

from udrl.config import Config, flat
from udrl.errors import ConfigError
from udrl_experiments.jobs import Job
from udrl_experiments.records import EvaluationRecord
from udrl_experiments.study_command import study
from udrl_experiments.study_progress import JobProgress, job_progress, progress_table, studies
from udrl_inspect.csv_tables import write


def job(seed: int, max_env_steps: int = 1000, variant: str = "") -> Job:
    settings = flat(Config(environment="CartPole-v1", seed=seed))
    return Job(algorithm="DQN", settings=settings, max_env_steps=max_env_steps, variant=variant)


def begin(root: Path, one: Job, env_steps: int) -> Path:
    """Write the files of a run that has had one evaluation."""
    folder = one.folder(root)
    folder.mkdir(parents=True)
    row = EvaluationRecord(
        environment="CartPole-v1", algorithm="DQN", variant="", seed=one.config.seed,
        env_steps=env_steps, wall_s=61.0, mean=12.5, std=1.0, episodes=100,
    )  # fmt: skip
    write(folder / "evaluations.csv", EvaluationRecord, [row])
    (folder / "job.json").write_bytes(msgspec.json.encode(one))
    return folder


def plan(root: Path, name: str, *jobs: Job) -> None:
    (root / name).mkdir(parents=True)
    (root / name / "study.json").write_bytes(msgspec.json.encode({"runs": jobs}))


def test_progress_of_runs(tmp_path: Path) -> None:
    done = begin(tmp_path, job(1), 1004)
    (done / "done.json").write_text(json.dumps({"max_env_steps": 1000}))
    begin(tmp_path, job(2), 400)
    job(3).folder(tmp_path).mkdir()
    assert [job_progress(job(seed), tmp_path) for seed in (1, 2, 3, 4)] == [
        JobProgress(job(1), "done", 1000, 61.0, 12.5),
        JobProgress(job(2), "unfinished", 400, 61.0, 12.5),
        JobProgress(job(3), "unfinished"),
        JobProgress(job(4), "not begun"),
    ]
    more = job(1, 5000)
    assert job_progress(more, tmp_path) == JobProgress(more, "unfinished", 1004, 61.0, 12.5)


def test_study_with_its_own_runs_has_them_in_its_folder(tmp_path: Path) -> None:
    plan(tmp_path, "lander", job(1))
    plan(tmp_path, "lead", job(1))
    begin(tmp_path / "lead", job(1), 400)
    found = {name: [run.state for run in runs] for name, runs in studies(tmp_path, ())}
    assert found == {"lander": ["not begun"], "lead": ["unfinished"]}
    assert [name for name, _ in studies(tmp_path, ("lead",))] == ["lead"]


def test_missing_study_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"contains no study; start one"):
        list(studies(tmp_path, ()))
    plan(tmp_path, "lander", job(1))
    with pytest.raises(ConfigError, match=r"contains no study moon; expected one of lander"):
        list(studies(tmp_path, ("moon",)))


def test_table_has_a_summary_and_a_line_for_each_run() -> None:
    runs = [
        JobProgress(job(1, variant="lead 2"), "done", 1000, 61.0, -12.54),
        JobProgress(job(2, 2000), "not begun"),
    ]
    assert progress_table("lander", runs) == [
        "lander: 1 of 2 runs done, 1,000 of 3,000 env steps, wall time 1:01",
        "state      env steps       wall time  mean return  run",
        "done       1,000 of 1,000  1:01       -12.5        DQN lead 2 CartPole-v1 seed 1",
        "not begun  0 of 2,000                              DQN CartPole-v1 seed 2",
    ]


def test_runs_of_the_papers_preset_and_of_configurations_are_labelled() -> None:
    runs = [
        JobProgress(msgspec.structs.replace(job(1, variant=variant), algorithm="UDRL"), "not begun")
        for variant in ("paper", "configuration 3")
    ]
    assert [line.split("  ")[-1].strip() for line in progress_table("search", runs)[2:]] == [
        "UDRL-paper CartPole-v1 seed 1",
        "UDRL configuration 3 CartPole-v1 seed 1",
    ]


def test_command_starts_no_run(tmp_path: Path) -> None:
    plan(tmp_path, "lander", job(1))
    plan(tmp_path, "sparse", job(2))
    before = sorted(tmp_path.rglob("*"))
    result = CliRunner().invoke(study, ["show", "--folder", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert result.output.count("0 of 1 runs done, 0 of 1,000 env steps") == 2
    assert sorted(tmp_path.rglob("*")) == before
