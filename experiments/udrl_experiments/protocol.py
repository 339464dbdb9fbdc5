"""Section 3.2: what all studies share, at the paper's scale and at one for two cores."""

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from udrl.config import Config, build, flat, parse_assignment, preset
from udrl.errors import ConfigError
from udrl_launch.settings import with_steps_as_numbers

#: Algorithms of Stable-Baselines3 that UDRL is compared with.
BaselineAlgorithm = Literal["DQN", "A2C", "PPO"]
Algorithm = Literal["UDRL", BaselineAlgorithm]
#: Participants of a comparison; ``UDRL-paper`` is UDRL with the preset that has only what is
#: in the paper.
Participant = Literal["UDRL", "UDRL-paper", BaselineAlgorithm]
#: Those of Figures 4 and 5.
DEFAULT_PARTICIPANTS: tuple[Participant, ...] = ("UDRL", "DQN", "A2C")
Scale = Literal["small", "paper"]

#: Evaluations that a score is the mean of (Appendix B).
LAST = 20


@dataclass(frozen=True, eq=False)
class Task:
    """An environment of the paper, and what is asked of its agents.

    Attributes:
        environment: Gymnasium's id; its preset has the same name.
        title: in pictures.
        small_steps: env steps of a run of UDRL at the small scale.
        small_baseline_steps: those of a run of another algorithm.
        desired_returns: what trained agents are told in the study of section 3.5.
        landmarks: returns that the paper names, by what they mean.
        thresholds: returns whose first evaluation is looked for, in env steps and in seconds.
        module: what its environment needs.
    """

    environment: str
    title: str
    small_steps: int
    small_baseline_steps: int
    desired_returns: tuple[float, ...]
    landmarks: dict[str, float]
    thresholds: tuple[float, ...]
    module: str


_LANDING = {"lands": 100.0, "close to optimal": 200.0}
_SMALL = 3_000_000, 1_000_000

TASKS = {
    "lander": Task(
        "LunarLander-v3", "LunarLander", *_SMALL, tuple(range(-150, 301, 25)), _LANDING,
        (100.0, 150.0, 200.0), "Box2D",
    ),
    "sparse": Task(
        "LunarLanderSparse-v3", "LunarLanderSparse", *_SMALL, tuple(range(-150, 301, 25)),
        _LANDING, (100.0, 150.0, 200.0), "Box2D",
    ),
    "takecover": Task(
        "TakeCover-v0", "TakeCover", 300_000, 100_000,
        tuple(range(100, 2101, 200)), {"solved": 750.0}, (300.0, 500.0, 750.0), "vizdoom",
    ),
}  # fmt: skip

#: Env steps of a run in the paper, of every algorithm in every environment.
PAPER_STEPS = 10_000_000

#: Env steps between evaluations (section 3.2).
EVAL_EVERY = 50_000

#: Settings of networks that all algorithms have.
NETWORKS = "frame_stack", "convolutions", "hidden"

#: Settings of a UDRL run that other algorithms have too; their runs do not depend on any other.
_SHARED = (
    *NETWORKS, "environment", "environment_kwargs", "wrappers", "max_episode_steps", "seed",
    "eval_every", "eval_episodes", "eval_temperature", "eval_seeds", "device",
)  # fmt: skip


class StudyPlan(NamedTuple):
    """What a study is to do.

    Attributes:
        scale: where seeds and steps come from when they are not given.
        seeds: of the runs; None: 1 to 20 in the paper, 1 to 3 at the small scale.
        max_env_steps: of each run; None: as the scale says.
        assignments: ``NAME=VALUE``, changes of UDRL's presets.
    """

    scale: Scale = "small"
    seeds: tuple[int, ...] | None = None
    max_env_steps: int | None = None
    assignments: tuple[str, ...] = ()

    def seeds_of_runs(self) -> tuple[int, ...]:
        """Return the seeds."""
        if self.seeds is not None:
            return self.seeds
        return tuple(range(1, 21 if self.scale == "paper" else 4))

    def steps(self, task: Task, algorithm: Algorithm = "UDRL") -> int:
        """Return the env steps of a run."""
        if self.max_env_steps is not None:
            return self.max_env_steps
        if self.scale == "paper":
            return PAPER_STEPS
        return task.small_steps if algorithm == "UDRL" else task.small_baseline_steps

    def config(self, task: Task, seed: int, *, paper: bool = False, **changes: Any) -> Config:
        """Return the settings of a UDRL run: the preset, changes, and the plan's assignments.

        Args:
            task: whose environment and preset.
            seed: of the run.
            paper: start from the preset that has only what is in the paper.
            changes: of the preset.

        Raises:
            ConfigError: a setting is unknown or impossible.
        """
        own = changes | {"environment": task.environment, "seed": seed}
        given = self.assigned(own)
        values = preset(f"{task.environment}-paper" if paper else task.environment)
        del values["max_env_steps"]
        return build(Config, values | {"eval_every": EVAL_EVERY} | given | own)

    def baseline(self, task: Task, seed: int, **changes: Any) -> Config:
        """Return the settings of a run of another algorithm: what they have in common with UDRL's.

        Args:
            task: whose environment and networks.
            seed: of the run.
            changes: of the preset.

        Raises:
            ConfigError: a setting is unknown or impossible.
        """
        return shared(self.config(task, seed, **changes))

    def assigned(self, own: Collection[str]) -> dict[str, Any]:
        """Return the plan's assignments, by setting.

        Args:
            own: settings that the study sets itself.

        Raises:
            ConfigError: an assignment is none, or is of one of these.
        """
        given = with_steps_as_numbers(dict(parse_assignment(text) for text in self.assignments))
        for name in given:
            if name in own:
                raise ConfigError(f"--set {name}=...: this study sets {name} itself; leave it out")
        return given


def shared(config: Config) -> Config:
    """Return the settings that a run of another algorithm has in common with one of UDRL."""
    settings = flat(config)
    return build(Config, {name: settings[name] for name in _SHARED})


def parse_seeds(text: str) -> tuple[int, ...]:
    """Return the seeds that ``1-3,7`` names.

    Raises:
        ConfigError: it is something else.
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
                f"--seeds {text}: {part.strip()}: expected the smaller number first, and at most "
                f"10,000 seeds"
            )
        seeds.extend(range(first, last + 1))
    return tuple(dict.fromkeys(seeds))


def tasks(names: Iterable[str]) -> list[Task]:
    """Return tasks by name.

    Raises:
        ConfigError: there is no task of that name.
    """
    names = tuple(names)
    for name in names:
        if name not in TASKS:
            raise ConfigError(f"task {name!r}: there are {', '.join(TASKS)}")
    return [TASKS[name] for name in names]
