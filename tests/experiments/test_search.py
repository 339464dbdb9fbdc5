import json
import math
import threading
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

import msgspec
import pytest
from click.testing import CliRunner

from tests.experiments.finished_runs import finish
from udrl.automatic_settings import resolve_automatic
from udrl.config import change, read_toml
from udrl.errors import ConfigError, UnsupportedEnvironment
from udrl_experiments import search as search_module
from udrl_experiments import study_command
from udrl_experiments.contest import Scored
from udrl_experiments.jobs import Job
from udrl_experiments.protocol import TASKS, StudyPlan
from udrl_experiments.records import EvaluationRecord
from udrl_experiments.search import Final, search_environment, search_tasks
from udrl_experiments.search_space import read_space, shipped_space
from udrl_experiments.study import StudyFolders
from udrl_inspect.csv_tables import read, write
from udrl_launch.settings import gather

ENVIRONMENTS = [task.environment for task in TASKS.values()]


def test_papers_scale_has_the_papers_values() -> None:
    study = search_tasks(StudyPlan("paper"), list(TASKS.values()), ["UDRL"])
    runs = [job.config.environment for job in study.jobs]
    assert [runs.count(name) for name in ENVIRONMENTS] == [256 * 3, 256, 72]
    assert {job.config.evaluation.eval_seeds for job in study.jobs} == {"search"}
    assert {job.max_env_steps for job in study.jobs} == {10_000_000}


def test_search_starts_from_the_papers_settings_only() -> None:
    (job,) = search_tasks(StudyPlan(), [TASKS["lander"]], ["UDRL"], 1).jobs
    buffer = job.config.buffer
    assert (buffer.max_age, buffer.recent_size, job.config.lead) == (None, 0, 0)
    drawn = shipped_space("LunarLander-v3").draw("UDRL", 0)
    assert job.config.training.batch_size == drawn["batch_size"]
    assert list(job.config.network.hidden) == drawn["hidden"]


def test_score_is_the_mean_of_the_last_20_and_the_best_becomes_a_preset(tmp_path: Path) -> None:
    plan = StudyPlan(seeds=(1, 2), assignments=("eval_every=10", "lead=1"))
    study = search_tasks(plan, [TASKS["sparse"]], ["UDRL", "DQN", "DQN"], 4)
    scores = dict[tuple[str, int], list[float]]()
    for index, job in enumerate(study.jobs):
        means = [float((index * 7) % 5 + n % 3) for n in range(25)]
        number = index // 2 % 4
        if number == 3:
            continue  # failed
        scores.setdefault((job.algorithm, number), []).append(fmean(means[5:]))
        job.folder(tmp_path).mkdir(parents=True)
        rows = [
            EvaluationRecord(
                environment="LunarLanderSparse-v3", algorithm=job.algorithm, variant="",
                seed=job.config.seed, env_steps=10 * n, wall_s=0.0, mean=mean, std=0.0, episodes=1,
            )
            for n, mean in enumerate(means)
        ]  # fmt: skip
        write(job.folder(tmp_path) / "evaluations.csv", EvaluationRecord, rows)
        done = json.dumps({"max_env_steps": job.max_env_steps})
        (job.folder(tmp_path) / "done.json").write_text(done)
        (job.folder(tmp_path) / "job.json").write_bytes(msgspec.json.encode(job))
    place = StudyFolders(tmp_path, tmp_path / "search")
    place.folder.mkdir()
    text = study.report(place)

    found = read(place.folder / "scores.csv", Scored)
    assert len(found) == 8
    scored = {(r.algorithm, r.configuration): r.score for r in found if r.score is not None}
    assert scored == pytest.approx({key: fmean(both) for key, both in scores.items()})
    best = max((r for r in found if r.algorithm == "UDRL"), key=lambda r: r.score or -math.inf)
    written = place.folder / "udrl-LunarLanderSparse-v3.toml"
    assert written.read_text() in text
    run = next(job for job in study.jobs if job.variant == f"configuration {best.configuration}")
    trained = gather("LunarLanderSparse-v3", options={"seed": 1}, file=written).config
    assert change(trained, eval_seeds="search") == run.config
    assert (place.folder / "dqn-LunarLanderSparse-v3.toml").exists()


@pytest.mark.parametrize("name", ["batch_size", "eval_seeds", "hidden", "seed", "environment"])
def test_searched_setting_cannot_be_set(name: str) -> None:
    with pytest.raises(ConfigError, match=f"--set {name}=...: this study sets {name} itself"):
        search_tasks(StudyPlan(assignments=(f"{name}=1",)), [TASKS["lander"]], ["UDRL"], 1)


def test_finalists_run_longer_and_the_best_one_becomes_a_preset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    batches: list[list[Job]] = []

    def run(jobs: Sequence[Job], *_: object) -> None:
        batches.append(list(jobs))
        for job in jobs:
            folder = job.folder(tmp_path)
            folder.mkdir(parents=True, exist_ok=True)
            number = int(job.variant.removeprefix("configuration "))
            early, late = [1.0, 4.0, 2.0, 3.0][number], [0.0, 5.0, 0.0, 9.0][number]
            rows = [
                EvaluationRecord(
                    environment="LunarLander-v3", algorithm="UDRL", variant="", seed=1,
                    env_steps=steps, wall_s=0.0, mean=mean, std=0.0, episodes=1,
                )
                for steps, mean in ((50_000, early), (100_000, late))
                if steps <= job.max_env_steps
            ]  # fmt: skip
            write(folder / "evaluations.csv", EvaluationRecord, rows)
            (folder / "done.json").write_text(json.dumps({"max_env_steps": job.max_env_steps}))
            (folder / "job.json").write_bytes(msgspec.json.encode(job))

    monkeypatch.setattr(search_module, "run_jobs_on_ray", run)
    plan = StudyPlan(seeds=(1,), max_env_steps=50_000)
    study = search_tasks(plan, [TASKS["lander"]], ["UDRL"], 4, Final(2, 100_000))
    study.run_jobs(study.jobs, tmp_path, 1, threading.Event(), print)
    assert [[(job.variant, job.max_env_steps) for job in batch] for batch in batches] == [
        [(f"configuration {n}", 50_000) for n in range(4)],
        [("configuration 1", 100_000), ("configuration 3", 100_000)],
    ]
    folders = StudyFolders(tmp_path, tmp_path / "search")
    folders.folder.mkdir()
    assert "# Configuration 3: score 6.0" in study.report(folders)
    found = read(folders.folder / "scores.csv", Scored)
    assert [row.score for row in found] == [1.0, 4.0, 2.0, 3.0]
    assert [row.final_score for row in found] == [None, 4.5, None, 6.0]


@pytest.mark.parametrize("steps", [50_000, 100_000])
def test_finalists_have_more_steps_than_the_search(steps: int) -> None:
    plan = StudyPlan(seeds=(1,), max_env_steps=100_000)
    with pytest.raises(ConfigError, match=rf"--final-env-steps {steps}: .* more than the 100,000"):
        search_tasks(plan, [TASKS["lander"]], ["UDRL"], 4, Final(2, steps))


def test_no_preset_is_written_without_a_score(tmp_path: Path) -> None:
    study = search_tasks(StudyPlan(), [TASKS["lander"]], ["A2C"], 2)
    (tmp_path / "search").mkdir()
    text = study.report(StudyFolders(tmp_path, tmp_path / "search"))
    assert "every configuration has a failed run" in text
    assert not list((tmp_path / "search").glob("*.toml"))


def test_algorithm_that_is_not_in_the_space_is_rejected() -> None:
    with pytest.raises(ConfigError, match=r"--algorithm PPO: .*LunarLander-v3 has UDRL, DQN, A2C"):
        search_tasks(StudyPlan(), [TASKS["lander"]], ["PPO"], 1)


SPACE = """
configurations = 3
seeds = 2

[networks]
hidden = [[8], [16, 8]]

[UDRL]
batch_size = [32, 64]
return_scale = [0.5]

[PPO]
gamma = [0.9, 0.99]
"""


@pytest.fixture
def custom_space(tmp_path: Path) -> Path:
    file = tmp_path / "mine.toml"
    file.write_text(SPACE)
    return file


def test_custom_environment_is_searched_from_the_settings_of_training(custom_space: Path) -> None:
    plan = StudyPlan(seeds=(1, 2), assignments=("n_updates_per_iter=7",))
    study = search_environment(plan, "MountainCar-v0", custom_space, configurations=2)
    assert study.name == "search-MountainCar-v0"
    assert [(one.algorithm, one.config.seed) for one in study.jobs] == [
        (algorithm, seed) for algorithm in ("UDRL", "PPO") for _ in range(2) for seed in (1, 2)
    ]
    settings = gather("MountainCar-v0", options={"seed": 1}, assignments=plan.assignments)
    resolved = resolve_automatic(settings.config, settings.automatic)
    drawn = read_space("MountainCar-v0", custom_space).draw("UDRL", 1)
    assert study.jobs[3].config == change(
        resolved, seed=2, eval_seeds="search", eval_every=50_000, **drawn
    )
    assert study.jobs[3].config.network.return_scale == 0.5
    ppo = study.jobs[6]
    assert set(ppo.hyperparameters) == {"gamma"}
    assert list(ppo.config.network.hidden) in [[8], [16, 8]]
    assert {one.max_env_steps for one in study.jobs} == {500_000}
    paper = search_environment(StudyPlan("paper"), "MountainCar-v0", custom_space)
    assert len(paper.jobs) == 2 * 3 * 2


def test_best_settings_of_a_custom_environment_are_those_of_its_run(
    custom_space: Path, tmp_path: Path
) -> None:
    plan = StudyPlan(assignments=("environment_kwargs={ a = 1 }", "eval_every=10"))
    with pytest.raises(UnsupportedEnvironment):
        search_environment(plan, "MountainCar-v0", custom_space)
    plan = StudyPlan(assignments=("wrappers=['gymnasium.wrappers:RecordEpisodeStatistics']",))
    study = search_environment(plan, "MountainCar-v0", custom_space, ["UDRL"], 1)
    (run,) = study.jobs
    finish(tmp_path, run)
    place = StudyFolders(tmp_path, tmp_path / study.name)
    place.folder.mkdir()
    study.report(place)
    written = read_toml(place.folder / "udrl-MountainCar-v0.toml")
    again = gather("MountainCar-v0", options=written, assignments=())
    assert not again.automatic
    assert change(again.config, eval_seeds="search") == run.config


def test_different_configurations_have_different_descriptions(custom_space: Path) -> None:
    study = search_environment(StudyPlan(), "MountainCar-v0", custom_space, configurations=3)
    assert [one.described for one in study.jobs] == [
        f"{algorithm} configuration {number}, MountainCar-v0, seed 1: 500,000 env steps"
        for algorithm in ("UDRL", "PPO")
        for number in range(3)
    ]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "[UDRL]",
            "[ULDR]",
            r"mine\.toml: unknown setting or table 'ULDR': .*\[UDRL\], \[DQN\]",
        ),
        (
            "[32, 64]",
            "[]",
            r"mine\.toml: \[UDRL\] batch_size = \[\].*expected a list of at least one value",
        ),
        (
            "[32, 64]",
            "32",
            r"mine\.toml: \[UDRL\] batch_size = 32.*expected a list of at least one",
        ),
        (
            "[32, 64]",
            "{ logspace = [1, 2] }",
            r"batch_size = \{'logspace': \[1, 2\]\}.*logspace = \[",
        ),
        (SPACE, "UDRL = 3", r"mine\.toml: \[UDRL\] = 3: expected a table"),
        ("seeds = 2", "seeds = 0", r"mine\.toml: .*seeds"),
        ("hidden", "lead", r"mine\.toml: \[networks\] lead: .*frame_stack, convolutions, hidden"),
        ("batch_size", "bach_size", r"mine\.toml: \[UDRL\] unknown.*bach_size"),
        ("[32, 64]", '["many"]', r"mine\.toml: \[UDRL\] batch_size = 'many'"),
        ("[0.5]", "[-1.0]", r"mine\.toml: \[UDRL\] return_scale = -1\.0"),
        ("[[8], [16, 8]]", "[[0]]", r"mine\.toml: \[networks\] hidden = \[0\]"),
        ("[0.9, 0.99]", "[2.0]", r"mine\.toml: \[PPO\] gamma = 2\.0"),
        ("gamma", "gama", r"mine\.toml: \[PPO\] unknown hyperparameter 'gama'"),
        ("seeds = 2", "seeds =", r"mine\.toml is not TOML"),
    ],
)
def test_invalid_space_is_rejected(custom_space: Path, old: str, new: str, message: str) -> None:
    custom_space.write_text(SPACE.replace(old, new))
    with pytest.raises(ConfigError, match=message):
        search_environment(StudyPlan(), "MountainCar-v0", custom_space)


def test_space_without_algorithms_is_rejected(custom_space: Path) -> None:
    custom_space.write_text("seeds = 2")
    with pytest.raises(ConfigError, match=r"no table of an algorithm; expected \[UDRL\] or"):
        search_environment(StudyPlan(), "MountainCar-v0", custom_space)


def test_searched_setting_of_a_custom_environment_cannot_be_set(custom_space: Path) -> None:
    with pytest.raises(ConfigError, match=r"--set batch_size=\.\.\.: this study sets batch_size"):
        search_environment(StudyPlan(assignments=("batch_size=1",)), "MountainCar-v0", custom_space)


def test_algorithms_that_cannot_act_in_the_environment_are_rejected(custom_space: Path) -> None:
    with pytest.raises(ConfigError, match=r"with PPO: expected discrete actions.*--algorithm UDRL"):
        search_environment(StudyPlan(), "Pendulum-v1", custom_space)
    assert search_environment(StudyPlan(), "Pendulum-v1", custom_space, ["UDRL"]).jobs


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["CartPole-v1"], "ENV CartPole-v1 needs --space FILE"),
        (["--space", "mine.toml"], "--space needs ENV"),
        (
            ["CartPole-v1", "--space", "mine.toml", "--task", "lander"],
            "--task lander: cannot be combined with ENV and --space",
        ),
    ],
)
def test_environment_and_space_are_required_together(arguments: list[str], message: str) -> None:
    result = CliRunner().invoke(study_command.study, ["search", *arguments])
    assert isinstance(result.exception, ConfigError)
    assert message in str(result.exception)
