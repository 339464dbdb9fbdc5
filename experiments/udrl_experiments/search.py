"""Appendix B: random search over the paper's spaces, which lie in ``spaces/`` as data."""

import hashlib
import json
import tomllib
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from statistics import fmean
from typing import Any

import msgspec
import numpy as np

from udrl.config import flat, preset
from udrl.streams import Stream
from udrl_experiments.comparison import baseline
from udrl_experiments.jobs import Job
from udrl_experiments.protocol import LAST, Algorithm, StudyPlan, Task
from udrl_experiments.ray_tune import carry_out
from udrl_experiments.statistics import score
from udrl_experiments.study import Study, StudyFolders
from udrl_inspect.csv_tables import put, write

#: Configurations of each algorithm, and env steps of each run, at the small scale.
SMALL_CONFIGURATIONS = 8
SMALL_STEPS = 500_000


class Scored(msgspec.Struct, frozen=True, kw_only=True):
    """How a configuration did.

    Attributes:
        environment: Gymnasium's id.
        algorithm: who learned.
        configuration: its number; which settings it has is a function of it.
        seeds: runs that the score is the mean of.
        score: mean of the last 20 evaluations (Appendix B), mean over the seeds; none if a run of
            it failed.
        settings: what was drawn, as JSON.
    """

    environment: str
    algorithm: str
    configuration: int
    seeds: int
    score: float | None
    settings: str


def space(environment: str) -> dict[str, Any]:
    """Return the space of an environment as its file has it."""
    text = resources.files("udrl_experiments") / "spaces" / f"{environment}.toml"
    return tomllib.loads(text.read_text(encoding="utf-8"))


def draw(environment: str, algorithm: Algorithm, configuration: int) -> dict[str, Any]:
    """Return the settings of a configuration: a value of every list, each as likely."""
    found = space(environment)
    lists = found["networks"] | found[algorithm]
    name = f"udrl/search/1|{environment}|{algorithm}|{configuration}"
    stream = Stream(hashlib.sha256(name.encode()).digest()[:16])
    numbers = stream.uniforms(len(lists)).tolist()
    drawn = {}
    for (key, values), u in zip(sorted(lists.items()), numbers, strict=True):
        if isinstance(values, dict):
            values = np.logspace(*values["logspace"]).tolist()
        drawn[key] = values[int(u * len(values))]
    return drawn


def search(
    plan: StudyPlan,
    tasks: Sequence[Task],
    algorithms: Sequence[Algorithm],
    configurations: int | None = None,
) -> Study:
    """Return the study.

    Args:
        plan: seeds and steps; at the paper's scale the space says how many seeds.
        tasks: on which.
        algorithms: whose settings are looked for.
        configurations: how many of each; None: as the scale says.
    """
    jobs = {
        (task, algorithm, number): [
            _job(plan, task, algorithm, number, seed) for seed in _seeds(plan, task)
        ]
        for task in tasks
        for algorithm in dict.fromkeys(algorithms)
        for number in range(_configurations(plan, task, configurations))
    }

    def report(place: StudyFolders) -> str:
        rows = [
            Scored(
                environment=task.environment,
                algorithm=algorithm,
                configuration=number,
                seeds=len(runs),
                score=_score(runs, place.root),
                settings=json.dumps(draw(task.environment, algorithm, number)),
            )
            for (task, algorithm, number), runs in jobs.items()
        ]
        write(place.folder / "scores.csv", Scored, rows)
        return "\n".join(
            _write_preset(place.folder, rows, task, algorithm)
            for task in tasks
            for algorithm in dict.fromkeys(algorithms)
        )

    return Study(
        "search", [run for runs in jobs.values() for run in runs], report, carry_out, ("ray",)
    )


def _seeds(plan: StudyPlan, task: Task) -> tuple[int, ...]:
    if plan.seeds is not None:
        return plan.seeds
    return tuple(range(1, 1 + (space(task.environment)["seeds"] if plan.scale == "paper" else 1)))


def _configurations(plan: StudyPlan, task: Task, given: int | None) -> int:
    if given is not None:
        return given
    if plan.scale == "paper":
        return int(space(task.environment)["configurations"])
    return SMALL_CONFIGURATIONS


def _job(plan: StudyPlan, task: Task, algorithm: Algorithm, number: int, seed: int) -> Job:
    if plan.scale == "small" and plan.max_env_steps is None:
        plan = plan._replace(max_env_steps=SMALL_STEPS)
    drawn = draw(task.environment, algorithm, number)
    steps = plan.steps(task, algorithm)
    if algorithm == "UDRL":
        config = plan.config(task, seed, paper=True, eval_seeds="search", **drawn)
        return Job(algorithm=algorithm, settings=flat(config), max_env_steps=steps)
    networks = {k: drawn.pop(k) for k in ("hidden", "convolutions") if k in drawn}
    config = plan.baseline(task, seed, eval_seeds="search", **networks)
    return baseline(algorithm, config, drawn, steps)


def _score(runs: Sequence[Job], root: Path) -> float | None:
    """Return the mean score of a configuration's runs; none if one of them failed."""
    if not all(run.done(root) for run in runs):
        return None
    return fmean(score([row.mean for row in run.evaluations(root)], LAST) for run in runs)


def _write_preset(folder: Path, rows: Sequence[Scored], task: Task, algorithm: Algorithm) -> str:
    """Write the best settings as a file, UDRL's for ``udrl train --config``; return its text."""
    kind = (task.environment, algorithm)
    scored = [
        (row.score, row)
        for row in rows
        if (row.environment, row.algorithm) == kind and row.score is not None
    ]
    if not scored:
        return f"# {algorithm}, {task.environment}: no configuration got to its end"
    value, best = max(scored, key=lambda pair: pair[0])
    drawn = json.loads(best.settings)
    if algorithm == "UDRL":
        values = preset(f"{best.environment}-paper") | drawn
    else:
        values = {"environment": best.environment, **drawn}
    text = f"# Configuration {best.configuration}; score {value:.1f}, seeds: {best.seeds}.\n"
    text += "".join(f"{name} = {json.dumps(value)}\n" for name, value in values.items())
    path = folder / f"{algorithm.lower()}-{best.environment}.toml"
    put(path, text.encode())
    return f"# {path}\n{text}"
