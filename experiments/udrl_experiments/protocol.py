"""The protocol of all studies (section 3.2), at the paper's scale and at one for two cores."""

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from udrl.config import Config, build, flat, parse_assignment, preset
from udrl.errors import ConfigError
from udrl_launch.settings import with_steps_as_numbers

#: Algorithms of Stable-Baselines3 that UDRL is compared with.
BaselineAlgorithm = Literal["DQN", "A2C", "PPO"]
Algorithm = Literal["UDRL", BaselineAlgorithm]
#: Participants of a comparison; ``UDRL-paper`` is UDRL with the preset that has only what is in the
#: paper.
Participant = Literal["UDRL", "UDRL-paper", BaselineAlgorithm]
#: The participants in Figures 4 and 5.
DEFAULT_PARTICIPANTS: tuple[Participant, ...] = ("UDRL", "DQN", "A2C")
StudyScale = Literal["small", "paper"]

#: Number of evaluations in a score (Appendix B).
LAST = 20


@dataclass(frozen=True, eq=False)
class Task:
    """An environment of the paper.

    Attributes:
        environment: Gymnasium's id; its preset has the same name.
        title: title in figures.
        small_steps: env steps of a run of UDRL at the small scale.
        small_baseline_steps: env steps of a run of another algorithm at the small scale.
        desired_returns: desired returns of trained agents in the study of section 3.5.
        landmarks: returns that the paper names, by label.
        lowest: lowest return in figures; well below that of random actions.
        thresholds: mean returns whose first evaluation is reported (``reached.csv``).
        module: module that the environment needs.
    """

    environment: str
    title: str
    small_steps: int
    small_baseline_steps: int
    desired_returns: tuple[float, ...]
    landmarks: dict[str, float]
    lowest: float
    thresholds: tuple[float, ...]
    module: str


_LANDING = {"lands": 100.0, "close to optimal": 200.0}
_SMALL = 3_000_000, 1_000_000

TASKS = {
    "lander": Task(
        "LunarLander-v3", "LunarLander", *_SMALL, tuple(range(-150, 301, 25)), _LANDING,
        -500.0, (100.0, 150.0, 200.0), "Box2D",
    ),
    "sparse": Task(
        "LunarLanderSparse-v3", "LunarLanderSparse", *_SMALL, tuple(range(-150, 301, 25)),
        _LANDING, -500.0, (100.0, 150.0, 200.0), "Box2D",
    ),
    "takecover": Task(
        "TakeCover-v0", "TakeCover", 300_000, 100_000,
        tuple(range(100, 2101, 200)), {"solved": 750.0}, 0.0, (300.0, 500.0, 750.0),
        "vizdoom",
    ),
}  # fmt: skip

#: Env steps of a run in the paper, of every algorithm in every environment.
PAPER_STEPS = 10_000_000

#: Env steps between evaluations (section 3.2).
EVAL_EVERY = 50_000

#: Settings of the networks of all algorithms.
NETWORKS = "frame_stack", "convolutions", "hidden"

#: Settings of UDRL that runs of other algorithms depend on.
_SHARED = (
    *NETWORKS, "environment", "environment_kwargs", "wrappers", "max_episode_steps", "seed",
    "eval_every", "eval_episodes", "eval_temperature", "eval_seeds", "device",
)  # fmt: skip


class StudyPlan(NamedTuple):
    """Seeds, steps and settings of a study.

    Attributes:
        scale: sets the defaults of seeds and steps.
        seeds: seeds of the runs; None: the scale's.
        max_env_steps: length of each run; None: the scale's.
        assignments: ``NAME=VALUE``, changes to UDRL's presets.
    """

    scale: StudyScale = "small"
    seeds: tuple[int, ...] | None = None
    max_env_steps: int | None = None
    assignments: tuple[str, ...] = ()

    def seeds_of_runs(self, paper: int = 20, small: int = 3) -> tuple[int, ...]:
        """Return the seeds of the runs, by default from 1 to a number that depends on the scale."""
        if self.seeds is not None:
            return self.seeds
        return tuple(range(1, 1 + (paper if self.scale == "paper" else small)))

    def steps(self, task: Task, algorithm: Algorithm = "UDRL") -> int:
        """Return the length of a run in env steps."""
        if self.max_env_steps is not None:
            return self.max_env_steps
        if self.scale == "paper":
            return PAPER_STEPS
        return task.small_steps if algorithm == "UDRL" else task.small_baseline_steps

    def config(
        self,
        task: Task,
        seed: int,
        *,
        paper: bool = False,
        defaults: Mapping[str, Any] = {},
        **changes: Any,
    ) -> Config:
        """Return the settings of a UDRL run: the preset, with changes and the plan's assignments.

        Args:
            task: the task, which determines environment and preset.
            seed: seed of the run.
            paper: use the preset that has only what is in the paper.
            defaults: settings in place of the preset's, which assignments may change.
            changes: settings of the study, which assignments must not change.

        Raises:
            ConfigError: a setting is unknown or invalid.
        """
        own = changes | {"environment": task.environment, "seed": seed}
        given = self.assigned(own)
        values = preset(f"{task.environment}-paper" if paper else task.environment)
        del values["max_env_steps"]
        return build(Config, values | {"eval_every": EVAL_EVERY, **defaults} | given | own)

    def assigned(self, own: Collection[str]) -> dict[str, Any]:
        """Return the plan's assignments as a dictionary.

        Args:
            own: settings that the study sets itself.

        Raises:
            ConfigError: an assignment is malformed, or names a setting in ``own``.
        """
        given = with_steps_as_numbers(dict(parse_assignment(text) for text in self.assignments))
        for name in given:
            if name in own:
                raise ConfigError(f"--set {name}=...: this study sets {name} itself; leave it out")
        return given


def shared(config: Config) -> Config:
    """Return the settings that a run of another algorithm shares with a run of UDRL."""
    settings = flat(config)
    return build(Config, {name: settings[name] for name in _SHARED})


def parse_seeds(text: str) -> tuple[int, ...]:
    """Return seeds from text such as ``1-3,7``.

    Raises:
        ConfigError: the text is not a list of numbers and ranges.
    """
    seeds: list[int] = []
    for part in text.split(","):
        found = re.fullmatch(r"\s*(\d{1,18})(?:\s*-\s*(\d{1,18}))?\s*", part)
        if found is None:
            raise ConfigError(f"--seeds {text}: expected numbers and ranges, e.g. 1-20 or 1,2,7-9")
        first = int(found[1])
        last = int(found[2] or first)
        if not first <= last < first + 10_000:
            raise ConfigError(
                f"--seeds {text}: {part.strip()}: expected an ascending range of at most 10,000 "
                f"seeds"
            )
        seeds.extend(range(first, last + 1))
    return tuple(dict.fromkeys(seeds))


def tasks(names: Iterable[str]) -> list[Task]:
    """Return tasks by name.

    Raises:
        ConfigError: a name is unknown.
    """
    names = tuple(names)
    for name in names:
        if name not in TASKS:
            raise ConfigError(f"unknown task {name!r}: expected one of {', '.join(TASKS)}")
    return [TASKS[name] for name in names]
