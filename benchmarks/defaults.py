"""Learning with one preset in different kinds of environments (docs/results.md).

::

    .venv/bin/python benchmarks/defaults.py
    .venv/bin/python benchmarks/defaults.py --tasks MountainCar Taxi --seeds 1 2 --set last_few=10

Each run is Algorithm 1 in one process, with one run per core at a time. Each row of the table is a
run: the mean return of random actions, and those of evaluations during training.
"""

import argparse
import os
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from typing import Any, NamedTuple

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.algorithm1 import Run, algorithm1
from udrl.commands import CommandSampler
from udrl.config import Config, change
from udrl_launch.settings import ANY_PRESET, gather

_EVALUATIONS = 5


class DefaultsTask(NamedTuple):
    """An environment, its budget in env steps, and settings that it needs."""

    environment: str
    max_env_steps: int
    settings: dict[str, Any]


TASKS = {
    "FrozenLake": DefaultsTask(
        "FrozenLake-v1", 20_000, {"environment_kwargs": {"is_slippery": False}}
    ),
    "FrozenLakeSlippery": DefaultsTask("FrozenLake-v1", 200_000, {}),
    # Returns vary greatly, so an evaluation needs many episodes.
    "Blackjack": DefaultsTask(
        "Blackjack-v1", 60_000, {"eval_episodes": 5_000, "max_episode_steps": 20}
    ),
    "CliffWalking": DefaultsTask("CliffWalking-v1", 60_000, {"max_episode_steps": 200}),
    "Taxi": DefaultsTask("Taxi-v4", 200_000, {}),
    "CartPole": DefaultsTask("CartPole-v1", 100_000, {}),
    "Acrobot": DefaultsTask("Acrobot-v1", 100_000, {}),
    "MountainCar": DefaultsTask("MountainCar-v0", 150_000, {}),
    "LunarLander": DefaultsTask("LunarLander-v3", 200_000, {}),
    "LunarLanderSparse": DefaultsTask("LunarLanderSparse-v3", 200_000, {}),
    "Pendulum": DefaultsTask("Pendulum-v1", 300_000, {"normalise_observations": True}),
    "MountainCarContinuous": DefaultsTask(
        "MountainCarContinuous-v0", 300_000, {"normalise_observations": True}
    ),
}


class LearningCurve(NamedTuple):
    """A run: mean return of random actions, those of evaluations by env steps, CPU seconds."""

    random: float
    evaluations: list[tuple[int, float]]
    cpu_s: float


def learn(name: str, seed: int, preset: str, assignments: list[str]) -> LearningCurve:
    """Train on one task."""
    task = TASKS[name]
    given = {"seed": seed, "lead": 0, "max_env_steps": task.max_env_steps, "eval_episodes": 200}
    given["eval_every"] = task.max_env_steps // _EVALUATIONS
    settings = gather(
        task.environment,
        preset_name=preset,
        options=given | task.settings,
        assignments=assignments,
    )
    steps: dict[int, int] = {}

    def note(run: Run) -> None:
        steps[run.iteration] = run.env_steps

    began = time.process_time()
    run = algorithm1(settings.config, settings.budget, report=note, automatic=settings.automatic)
    return LearningCurve(
        _random_return(settings.config),
        [(steps[i - 1], e.mean) for i, e in sorted(run.evaluations.items())],
        time.process_time() - began,
    )


def _random_return(config: Config) -> float:
    """Return the mean return of random actions."""
    config = change(config, n_warm_up_episodes=200)
    with closing(EpisodeGenerator(config, 16)) as generator:
        commands = CommandSampler(config, generator.spec).warm_up()
        episodes = generate_episodes(generator, commands, None)
    return sum(e.episode_return for e in episodes) / len(episodes)


def main() -> None:
    """Train on all tasks and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--preset", default=ANY_PRESET)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    options = parser.parse_args()
    print("| task | seed | random | evaluations: mean return at env steps | CPU, s |")
    print("|---|---|---|---|---|", flush=True)
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        runs = {
            (name, seed): pool.submit(learn, name, seed, options.preset, options.set)
            for name in options.tasks
            for seed in options.seeds
        }
        for (name, seed), run in runs.items():
            curve = run.result()
            points = ", ".join(f"{mean:.4g} at {at // 1000}K" for at, mean in curve.evaluations)
            print(f"| {name} | {seed} | {curve.random:.4g} | {points} | {curve.cpu_s:.0f} |",
                  flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
