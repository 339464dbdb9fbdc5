import json
import math
import tomllib
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import pytest

from udrl.config import Config, build, preset
from udrl.errors import ConfigError
from udrl_experiments.protocol import TASKS, Algorithm, StudyPlan
from udrl_experiments.records import EvaluationRecord
from udrl_experiments.search import Scored, draw, search, space
from udrl_experiments.study import StudyFolders
from udrl_inspect.csv_tables import read, write

ENVIRONMENTS = [task.environment for task in TASKS.values()]
ALGORITHMS: tuple[Algorithm, ...] = ("UDRL", "DQN", "A2C")


def values(kept: Any) -> list[Any]:
    if isinstance(kept, dict):
        low, high, n = kept["logspace"]
        return [10 ** (low + (high - low) * i / (n - 1)) for i in range(n)]
    assert isinstance(kept, list)
    return kept


@pytest.mark.parametrize("environment", ENVIRONMENTS)
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_configurations_come_from_the_lists_and_all_values_come(
    environment: str, algorithm: Algorithm
) -> None:
    lists = space(environment)["networks"] | space(environment)[algorithm]
    drawn = [draw(environment, algorithm, number) for number in range(1500)]
    for name, kept in lists.items():
        allowed = values(kept)
        found = [one[name] for one in drawn]
        if isinstance(kept, dict):
            assert all(np.isclose(allowed, value, rtol=1e-9).any() for value in found)
            assert len(set(found)) == len(allowed)
        else:
            assert all(value in allowed for value in found)
            counts = [found.count(value) for value in allowed]
            expected = len(drawn) / len(allowed)
            assert all(abs(count - expected) < 5 * math.sqrt(expected) for count in counts)
    assert all(set(one) == set(lists) for one in drawn)


def test_a_configuration_is_a_function_of_its_number() -> None:
    assert draw("LunarLander-v3", "DQN", 5) == draw("LunarLander-v3", "DQN", 5)
    assert draw("LunarLander-v3", "DQN", 5) != draw("LunarLander-v3", "DQN", 6)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_every_configuration_of_udrl_is_one_that_a_run_takes(environment: str) -> None:
    for number in range(100):
        build(Config, {"environment": environment} | draw(environment, "UDRL", number))


def test_the_papers_scale_is_the_papers() -> None:
    study = search(StudyPlan("paper"), list(TASKS.values()), ["UDRL"])
    runs = [job.config.environment for job in study.jobs]
    assert [runs.count(name) for name in ENVIRONMENTS] == [256 * 3, 256, 72]
    assert {job.config.evaluation.eval_seeds for job in study.jobs} == {"search"}
    assert {job.max_env_steps for job in study.jobs} == {10_000_000}


def test_a_search_starts_from_what_is_in_the_paper_alone() -> None:
    (job,) = search(StudyPlan(), [TASKS["lander"]], ["UDRL"], 1).jobs
    buffer = job.config.buffer
    assert (buffer.max_age, buffer.recent_size, job.config.lead) == (None, 0, 0)
    drawn = draw("LunarLander-v3", "UDRL", 0)
    assert job.config.training.batch_size == drawn["batch_size"]
    assert list(job.config.network.hidden) == drawn["hidden"]


def test_the_score_is_the_mean_of_the_last_20_and_the_best_becomes_a_preset(tmp_path: Path) -> None:
    plan = StudyPlan(seeds=(1, 2), assignments=("eval_every=10",))
    study = search(plan, [TASKS["sparse"]], ["UDRL", "DQN", "DQN"], 4)
    scores = dict[tuple[str, int], list[float]]()
    for index, job in enumerate(study.jobs):
        means = [float((index * 7) % 5 + n % 3) for n in range(25)]
        number = index // 2 % 4
        if number == 3:
            continue  # it failed
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
    place = StudyFolders(tmp_path, tmp_path / "search")
    place.folder.mkdir()
    said = study.report(place)

    found = read(place.folder / "scores.csv", Scored)
    assert len(found) == 8
    scored = {(r.algorithm, r.configuration): r.score for r in found if r.score is not None}
    assert scored == pytest.approx({key: fmean(both) for key, both in scores.items()})
    best = max((r for r in found if r.algorithm == "UDRL"), key=lambda r: r.score or -math.inf)
    kept = tomllib.loads((place.folder / "udrl-LunarLanderSparse-v3.toml").read_text())
    drawn = draw("LunarLanderSparse-v3", "UDRL", best.configuration)
    assert (place.folder / "udrl-LunarLanderSparse-v3.toml").read_text() in said
    assert kept == preset("LunarLanderSparse-v3-paper") | drawn
    assert (place.folder / "dqn-LunarLanderSparse-v3.toml").exists()


@pytest.mark.parametrize("name", ["batch_size", "eval_seeds", "hidden", "seed", "environment"])
def test_what_a_search_draws_cannot_be_set(name: str) -> None:
    with pytest.raises(ConfigError, match=f"--set {name}=...: this study sets {name} itself"):
        search(StudyPlan(assignments=(f"{name}=1",)), [TASKS["lander"]], ["UDRL"], 1)


def test_without_any_score_there_is_no_preset(tmp_path: Path) -> None:
    study = search(StudyPlan(), [TASKS["lander"]], ["A2C"], 2)
    (tmp_path / "search").mkdir()
    said = study.report(StudyFolders(tmp_path, tmp_path / "search"))
    assert "no configuration got to its end" in said
    assert not list((tmp_path / "search").glob("*.toml"))
