"""Contests of a search: configurations of an environment and algorithm, and the best of them."""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import msgspec

from udrl.atomic_files import write_atomically
from udrl.config import Config, change, flat
from udrl.errors import InvalidData
from udrl_experiments.jobs import Job
from udrl_experiments.protocol import Algorithm
from udrl_experiments.runs import finished_run
from udrl_experiments.statistics import score
from udrl_replay.creation import as_toml


class Scored(msgspec.Struct, frozen=True, kw_only=True):
    """The score of a configuration.

    Attributes:
        environment: Gymnasium's id.
        algorithm: the algorithm.
        configuration: number of the configuration, which determines its settings.
        seeds: number of runs.
        score: mean of the last 20 evaluations (Appendix B), mean over the runs; none if a run
            failed.
        settings: drawn settings, as JSON.
        final_score: the same of the longer runs in the final; none for other configurations.
    """

    environment: str
    algorithm: str
    configuration: int
    seeds: int
    score: float | None
    settings: str
    final_score: float | None = None


class Configuration(NamedTuple):
    """A configuration, and its runs.

    Attributes:
        number: the number, which determines the settings.
        settings: drawn settings.
        runs: one run for each seed.
        longer_runs: the same in the final; none without a final.
    """

    number: int
    settings: dict[str, Any]
    runs: Sequence[Job]
    longer_runs: Sequence[Job]


class Contest(NamedTuple):
    """The configurations of an environment and algorithm.

    Attributes:
        config: settings of a UDRL run, before a seed and drawn settings are set.
        algorithm: the algorithm.
        configurations: the configurations.
    """

    config: Config
    algorithm: Algorithm
    configurations: Sequence[Configuration]

    def best(self, most: int, root: Path) -> list[Configuration]:
        """Return the configurations with the best scores, at most ``most``."""
        scored = [
            (value, one)
            for one in self.configurations
            if (value := _score(one.runs, root)) is not None
        ]
        return [one for _, one in sorted(scored, key=lambda pair: -pair[0])[:most]]

    def scores(self, root: Path) -> list[Scored]:
        """Return the score of each configuration."""
        return [
            Scored(
                environment=self.config.environment,
                algorithm=self.algorithm,
                configuration=one.number,
                seeds=len(one.runs),
                score=_score(one.runs, root),
                settings=json.dumps(one.settings),
                final_score=_score(one.longer_runs, root),
            )
            for one in self.configurations
        ]

    def write_preset(self, folder: Path, scores: Sequence[Scored]) -> str:
        """Write the best configuration to a TOML file, and return its text.

        UDRL's can be passed to ``udrl train --config``. It has all settings but the seeds, because
        the environment's preset may differ from the one of the search.
        """
        environment = self.config.environment
        scored = [(row.final_score, row) for row in scores if row.final_score is not None] or [
            (row.score, row) for row in scores if row.score is not None
        ]
        if not scored:
            return f"# {self.algorithm}, {environment}: every configuration has a failed run"
        value, best = max(scored, key=lambda pair: pair[0])
        drawn = json.loads(best.settings)
        if self.algorithm == "UDRL":
            settings = flat(change(self.config, **drawn))
            values = {name: v for name, v in settings.items() if name not in ("seed", "eval_seeds")}
        else:
            values = {"environment": environment, **drawn}
        text = f"# Configuration {best.configuration}: score {value:.1f}, seeds: {best.seeds}.\n"
        text += "".join(f"{name} = {as_toml(value)}\n" for name, value in values.items())
        path = folder / f"{self.algorithm.lower()}-{file_name(environment)}.toml"
        write_atomically(path, text.encode())
        return f"# {path}\n{text}"


def _score(runs: Sequence[Job], root: Path) -> float | None:
    """Return the mean score of a configuration's runs; None if there are none, or one failed."""
    try:
        finished = [finished_run(run, root) for run in runs]
    except InvalidData:
        return None
    scores = [score([row.mean for row in run.evaluations]) for run in finished]
    return fmean(scores) if scores else None


def file_name(environment: str) -> str:
    """Return an environment's id as part of a file name."""
    return re.sub(r"[^\w.-]+", "-", environment)
