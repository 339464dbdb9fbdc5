from pathlib import Path

import pytest
from click.testing import CliRunner

from tests.experiments.finished_runs import finish
from udrl.config import flat, preset
from udrl_experiments import study_command
from udrl_experiments.comparison import comparison, job
from udrl_experiments.jobs import Job
from udrl_experiments.protocol import DEFAULT_PARTICIPANTS, TASKS, StudyPlan, Task
from udrl_experiments.provenance import Machine
from udrl_experiments.statistics import CurvePoint, Reached
from udrl_experiments.study import StudyFolders, read_study
from udrl_experiments.tuned import tuned
from udrl_inspect.csv_tables import read

#: Two evaluations suffice for a curve.
PLAN = StudyPlan(seeds=(1, 2), max_env_steps=100_000)

each_task = pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)


@each_task
def test_papers_preset_is_a_participant_with_the_papers_settings(
    task: Task,
) -> None:
    participant = job(task, PLAN, "UDRL-paper", 1)
    settings = flat(PLAN.config(task, 1, paper=True))
    assert participant.name == Job(algorithm="UDRL", settings=settings, max_env_steps=1).name
    shipped = preset(f"{task.environment}-paper")
    del shipped["max_env_steps"]
    assert settings.items() >= shipped.items()
    assert participant.name != job(task, PLAN, "UDRL", 1).name


def test_tuned_networks_are_used_unless_others_are_given() -> None:
    task = TASKS["lander"]
    found = tuned("A2C", task.environment)
    plain = job(task, PLAN, "A2C", 1)
    assert list(plain.config.network.hidden) == found.networks["hidden"]
    assert plain.hyperparameters == found.hyperparameters
    given = job(task, PLAN._replace(assignments=("hidden=[8, 8]",)), "A2C", 1)
    assert given.config.network.hidden == (8, 8)


@each_task
def test_default_figure_is_the_papers(task: Task) -> None:
    name = next(name for name, one in TASKS.items() if one is task)
    jobs = comparison(name, PLAN, dict.fromkeys(DEFAULT_PARTICIPANTS)).jobs
    assert [(one.algorithm, one.variant, one.config.seed) for one in jobs] == [
        (algorithm, "", seed) for algorithm in ("UDRL", "DQN", "A2C") for seed in (1, 2)
    ]


def test_algorithm_may_have_its_own_number_of_env_steps(tmp_path: Path) -> None:
    task = TASKS["lander"]
    jobs = [
        job(task, PLAN, "UDRL", 1),
        job(task, PLAN._replace(max_env_steps=300_000), "A2C", 1),
    ]
    for one in jobs:
        finish(tmp_path, one)
    options = ["--seeds", "1", "--max-env-steps", "100K", "--folder", str(tmp_path)]
    entries = ["--algorithm", "UDRL", "--algorithm", "A2C=300K"]
    result = CliRunner().invoke(study_command.study, ["lander", *options, *entries])
    assert result.exit_code == 0, result.output
    planned = read_study(tmp_path / "lander" / "study.json")
    assert [(one.algorithm, one.max_env_steps) for one in planned] == [
        ("UDRL", 100_000),
        ("A2C", 300_000),
    ]


@pytest.mark.parametrize("entry", ["A3C", "A2C=", "A2C=many", "=300K"])
def test_invalid_algorithm_is_rejected(entry: str, tmp_path: Path) -> None:
    options = ["--folder", str(tmp_path), "--algorithm", entry]
    result = CliRunner().invoke(study_command.study, ["lander", *options])
    assert result.exit_code == 2
    assert "Invalid value for '--algorithm'" in result.output
    assert not (tmp_path / "lander").exists()


def test_both_presets_are_lines_of_one_figure(tmp_path: Path) -> None:
    study = comparison("lander", PLAN, {"UDRL": None, "UDRL-paper": None})
    assert len(study.jobs) == 4
    for one in study.jobs:
        finish(tmp_path, one)
    place = StudyFolders(tmp_path, tmp_path / "lander")
    place.folder.mkdir()
    output = study.report(place)

    points = read(place.folder / "curves.csv", CurvePoint)
    assert {(point.algorithm, point.variant) for point in points} == {
        ("UDRL", ""),
        ("UDRL", "paper"),
    }
    assert {row.variant for row in read(place.folder / "reached.csv", Reached)} == {"", "paper"}
    picture = (place.folder / "learning-curves.svg").read_text(encoding="utf-8")
    for label in ("UDRL (2 seeds)", "UDRL-paper (2 seeds)"):
        assert f">{label}</text>" in picture
    assert "LunarLander: UDRL-paper: mean return 3.5 after 100,000 env steps, seeds: 2" in output


def test_wall_times_are_compared_on_one_kind_of_machine_only(tmp_path: Path) -> None:
    study = comparison("lander", PLAN._replace(seeds=(1, 2, 3)), {"UDRL": None, "DQN": None})
    many, few = Machine("Quick", 2, "Linux x86_64"), Machine("Slow", 2, "Linux x86_64")
    for one in study.jobs:
        machine = few if one.config.seed == 2 else many
        finish(tmp_path, one, wall_s=99.0 if machine is few else 10.0, machine=machine)
    place = StudyFolders(tmp_path, tmp_path / "lander")
    place.folder.mkdir()
    study.report(place)

    assert {point.seeds for point in read(place.folder / "curves.csv", CurvePoint)} == {3}
    points = read(place.folder / "curves-wall-time.csv", CurvePoint)
    assert [(point.algorithm, point.seeds, point.wall_s) for point in points] == [
        (algorithm, 2, wall_s) for algorithm in ("UDRL", "DQN") for wall_s in (10.0, 20.0)
    ]
    picture = (place.folder / "learning-curves-wall-time.svg").read_text(encoding="utf-8")
    for text in ("LunarLander", "runs on: Quick, 2 cores", "wall time (minutes)", "DQN (2 seeds)"):
        assert f">{text}</text>" in picture


def test_wall_times_of_unknown_machines_are_not_compared(tmp_path: Path) -> None:
    study = comparison("lander", PLAN, {"UDRL": None})
    for one in study.jobs:
        finish(tmp_path, one)
    place = StudyFolders(tmp_path, tmp_path / "lander")
    place.folder.mkdir()
    study.report(place)
    assert (place.folder / "learning-curves.png").exists()
    assert not list(place.folder.glob("*wall-time*"))
