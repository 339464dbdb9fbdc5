"""Jobs: the runs of a study, by their settings.

A run is a function of its settings, so studies share runs: jobs with equal settings are the same
run. A study uses the evaluations of a run up to the number of steps that it needs.
"""

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import msgspec

from udrl.config import Config, Configured, FlatSettings, KeywordValue, flat
from udrl_experiments.protocol import Algorithm, shared
from udrl_experiments.records import agent_name
from udrl_experiments.tuned import DqnHyperparameters, complete


class Job(Configured, msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A run that a study needs.

    Attributes:
        algorithm: the algorithm.
        settings: settings of UDRL. Other algorithms use its environment, networks and evaluations.
        hyperparameters: hyperparameters of other algorithms.
        exploration_steps: env steps over which DQN's exploration rate decreases; 0 for others.
        max_env_steps: length of the run.
        variant: label that distinguishes agents of a study; not part of the run's identity.
    """

    algorithm: Algorithm
    settings: FlatSettings = msgspec.field(name="config")
    hyperparameters: dict[str, bool | int | float | str] = {}
    exploration_steps: int = 0
    max_env_steps: int
    variant: str = ""

    @property
    def name(self) -> str:
        """Name of the run, with a hash of its settings: equal settings, equal names.

        Defaults are not hashed, so that a new setting does not change the names of kept runs.
        """
        config = self.config
        defaults = flat(Config(environment=config.environment))
        settings = {name: v for name, v in flat(config).items() if v != defaults[name]}
        identity = msgspec.json.encode(
            [self.algorithm, settings, self.hyperparameters, self.exploration_steps], order="sorted"
        )
        digest = hashlib.sha256(identity).hexdigest()[:12]
        environment = re.sub(r"[^a-z0-9]+", "-", self.config.environment.lower()).strip("-")
        return f"{self.algorithm.lower()}-{environment}-seed{self.config.seed}-{digest}"

    @property
    def described(self) -> str:
        """Description in one line."""
        return (
            f"{agent_name(self.algorithm, self.variant)}, {self.config.environment}, "
            f"seed {self.config.seed}: {self.max_env_steps:,} env steps"
        )

    def folder(self, root: Path) -> Path:
        """Return the folder of the run."""
        return root / "runs" / self.name


def make_job(
    algorithm: Algorithm,
    config: Config,
    max_env_steps: int,
    *,
    hyperparameters: Mapping[str, KeywordValue] = {},
    variant: str = "",
) -> Job:
    """Return a job.

    Args:
        algorithm: the algorithm.
        config: settings of UDRL. Other algorithms use its shared ones
            (:func:`udrl_experiments.protocol.shared`).
        max_env_steps: length of the run. DQN's exploration depends on it.
        hyperparameters: those of other algorithms that differ from the defaults.
        variant: as in :class:`Job`.

    Raises:
        ConfigError: a hyperparameter is unknown or invalid.
    """
    explored = 0.0
    if algorithm != "UDRL":
        config, chosen = shared(config), complete(algorithm, hyperparameters)
        if isinstance(chosen, DqnHyperparameters):
            explored = chosen.exploration_fraction
    return Job(
        algorithm=algorithm,
        settings=flat(config),
        hyperparameters=dict(hyperparameters),
        exploration_steps=round(explored * max_env_steps),
        max_env_steps=max_env_steps,
        variant=variant,
    )


def merge_jobs(jobs: Iterable[Job]) -> Sequence[Job]:
    """Return one job per run, the longest, in the order of first appearance."""
    merged: dict[str, Job] = {}
    for job in jobs:
        kept = merged.setdefault(job.name, job)
        if job.max_env_steps > kept.max_env_steps:
            merged[job.name] = job
    return list(merged.values())
