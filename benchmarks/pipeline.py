"""The duration of a run on other machines, by simulation of actors, replay service and learner.

A run is a function of its configuration, so its episodes, their lengths and the order of versions
do not depend on the hardware; only time does. The episode lengths of one run are recorded, and the
costs of its parts are measured, that of a version in a run with services. Then the same run is
simulated with any number of cores and actors (``simulation.py``). ``--check`` also runs the
services, and prints both::

    python benchmarks/pipeline.py --max-env-steps 100000 --actors 1 2 4 --check

``--table`` instead prints the time that presets need for a number of env steps on machines with 2
to 256 cores, for environments of different speed, and the bottleneck of each::

    python benchmarks/pipeline.py --table LunarLander-v3=350000
"""

import argparse
import itertools
import json
import logging
import math
import os
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

from simulation import Costs, Recorded, Simulation
from speed import _random_speed, _window
from udrl.acting import EpisodeGenerator
from udrl.commands import FINAL_EVALUATION, TRAINING_SEEDS, Command
from udrl.config import COMMANDS_PER_ITERATION, Config
from udrl.graph import acting_graph
from udrl.inference import ActingFunction, probe_weights
from udrl.streams import Purpose, stream_key
from udrl_launch.settings import Settings, gather
from udrl_launch.training_run import run_training
from udrl_replay.run import StoredRun

#: Seconds on the machine of docs/performance.md, measured in runs; see :class:`Costs`.
_MESSAGES = {"replay": 0.002, "answer": 0.001, "sync": 0.003, "fetch": 0.010, "delivery": 0.0126}
#: Seconds from the first commands until the learner has loaded torch.
_START_S = 1.9

_CORES = (2, 4, 8, 16, 32, 64, 128, 256)
#: Durations of an environment step in the table, in seconds.
_STEPS = (30e-6, 1e-3, 20e-3)


class Real(NamedTuple):
    """A run with services: env steps per second after the warm-up, seconds per version."""

    speed: float
    version: float


def record(settings: Settings) -> Recorded:
    """Train in this process, and record episode lengths."""
    found: dict[int, dict[int, int]] = defaultdict(dict)
    accept = StoredRun.accept

    def note_episode(self: StoredRun, arrival: Any, now: float) -> Any:
        iteration, index = divmod(arrival.entry.id, COMMANDS_PER_ITERATION)
        if index < FINAL_EVALUATION:
            found[iteration][index] = arrival.entry.length
        return accept(self, arrival, now)

    with (
        tempfile.TemporaryDirectory() as folder,
        mock.patch.object(StoredRun, "accept", note_episode),
    ):
        status = run_training(settings, Path(folder) / "run", threading.Event(), in_process=True)
    complete = range(status.iteration + 1)
    return Recorded([[n for _, n in sorted(found[i].items())] for i in complete], settings.config)


def measure(config: Config, version_s: float) -> Costs:
    """Return the costs of a run; rounds of 1 to 8 rows are timed here."""
    sizes = (1, 2, 4, 8)
    cpu, wall = zip(*(_round(config, n) for n in sizes), strict=True)
    row, beside = statistics.linear_regression(sizes, cpu)
    sleep = statistics.linear_regression(sizes, wall).slope - row
    return Costs(
        round=max(beside, 0.0),
        row=row,
        sleep=max(sleep, 0.0),
        version=version_s,
        start=_START_S,
        **_MESSAGES,
    )


def _round(config: Config, rows: int) -> tuple[float, float]:
    """Return the CPU seconds and the duration of a round."""
    with closing(EpisodeGenerator(config, rows)) as generator:
        graph = acting_graph(config.network, generator.spec)
        behavior = ActingFunction(graph, probe_weights(graph))
        numbers = itertools.count()
        rounds, began, cpu_began = 0, time.perf_counter(), time.process_time()
        while rounds < 4000 and time.perf_counter() - began < 5.0:
            while generator.free:
                generator.start(_command(next(numbers), generator.spec.max_episode_steps), behavior)
            generator.step()
            rounds += 1
        cpu, wall = time.process_time() - cpu_began, time.perf_counter() - began
        return cpu / rounds, wall / rounds


def _command(number: int, max_steps: int) -> Command:
    return Command(
        id=number,
        kind="explore",
        desired_return=0.0,
        desired_horizon=100,
        environment_seed=TRAINING_SEEDS[0] + number,
        stream_key=stream_key(0, Purpose.PROBE, 1, number),
        weights_version=1,
        max_steps=max_steps,
    )


def real(options: argparse.Namespace, preset: str | None, steps: int, actors: int) -> Real:
    """Train with services, and measure."""
    with tempfile.TemporaryDirectory() as folder:
        run_dir = Path(folder) / "run"
        command = [
            sys.executable, "-m", "udrl_launch", "train", options.env, "--run-dir", str(run_dir),
            "--max-env-steps", str(steps), "--actors", str(actors),
            "--envs-per-actor", str(options.envs_per_actor), "--json",
        ]  # fmt: skip
        command += [] if preset is None else ["--preset", preset]
        command += [f"--set={assignment}" for assignment in options.set]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        window = _window(run_dir)
        with closing(sqlite3.connect(run_dir / "run.sqlite")) as file:
            trained = [seconds for (seconds,) in file.execute("SELECT train_s FROM versions")]
    return Real(window.steps / window.seconds, statistics.fmean(trained))


def check(options: argparse.Namespace) -> None:
    """Print the speed in the simulation, and with ``--check`` that of the services."""
    settings = _settings(options, options.preset, options.max_env_steps)
    actors = options.actors if options.check else [2]
    found = {n: real(options, options.preset, options.max_env_steps, n) for n in actors}
    version_s = statistics.median(run.version for run in found.values())
    recorded, costs = record(settings), measure(settings.config, version_s)
    print(json.dumps(costs._asdict()))
    for n in options.actors:
        speed = Simulation(recorded, costs, options.cores, n, options.envs_per_actor).run().speed
        line = f"{options.cores:6.0f} cores {n:4d} actors: {speed:10,.0f} env steps/s"
        if options.check:
            line += f", the services {found[n].speed:10,.0f} ({speed / found[n].speed - 1:+.1%})"
        print(line, flush=True)


def table(options: argparse.Namespace) -> None:
    """Print the time and the bottleneck of presets by cores and environment speed."""
    for entry in options.table:
        preset, _, steps = entry.partition("=")
        settings = _settings(options, preset, int(steps))
        version_s = real(options, preset, int(steps), 2).version
        recorded, costs = record(settings), measure(settings.config, version_s)
        besides = costs.row - 1 / _random_speed(settings.config)
        print(f"\n{preset}, {int(steps):,} env steps; {json.dumps(costs._asdict())}\n")
        print("| cores |" + "".join(f" {1e3 * step:g} ms | bound by |" for step in _STEPS))
        print("|---|" + "---|---|" * len(_STEPS))
        for cores in _CORES:
            cells = [
                _bounded(recorded, costs._replace(row=besides + step), cores) for step in _STEPS
            ]
            print(f"| {cores} | " + " | ".join(cells) + " |", flush=True)


def _bounded(recorded: Recorded, costs: Costs, cores: int) -> str:
    """Return the seconds of a run, and its bottleneck: the part that saves most when halved."""
    seconds = _seconds(recorded, costs, cores)
    saved = {
        "actors": seconds - _seconds(recorded, costs, 2 * cores),
        "learner": seconds - _seconds(recorded, _halved(costs, "version"), cores),
        "messages": seconds - _seconds(recorded, _halved(costs, *_MESSAGES), cores),
    }
    steps = seconds - _seconds(recorded, _halved(costs, "round", "row", "sleep"), cores)
    saved["episodes"] = steps - saved["actors"]
    return f"{seconds:,.0f} s | {max(saved, key=saved.__getitem__)}"


def _halved(costs: Costs, *names: str) -> Costs:
    return costs._replace(**{name: getattr(costs, name) / 2 for name in names})


def _seconds(recorded: Recorded, costs: Costs, cores: int) -> float:
    """Return the seconds of a run with one actor per core, except for the learner's cores."""
    config = recorded.config
    actors = max(1, cores - config.arithmetic.training_threads)
    environments = math.ceil(config.commands.n_episodes_per_iter * (config.lead + 1) / actors)
    return Simulation(recorded, costs, cores, actors, environments).run().end


def _settings(options: argparse.Namespace, preset: str | None, steps: int) -> Settings:
    return gather(
        options.env,
        preset_name=preset,
        options={"max_env_steps": steps},
        assignments=options.set,
    )


def main() -> None:
    """Simulate, and print speeds or the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="LunarLander-v3")
    parser.add_argument("--preset")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--max-env-steps", type=int, default=100_000)
    parser.add_argument("--cores", type=int, default=os.cpu_count())
    parser.add_argument("--actors", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--envs-per-actor", type=int, default=16)
    parser.add_argument("--check", action="store_true", help="also run the services")
    parser.add_argument("--table", nargs="+", metavar="PRESET=ENV_STEPS", help="2 to 256 cores")
    options = parser.parse_args()
    logging.getLogger("udrl").setLevel(logging.ERROR)
    # So that --env can name environments in this folder.
    os.environ["PYTHONPATH"] = os.pathsep.join(sys.path)
    if options.table:
        table(options)
    else:
        check(options)


if __name__ == "__main__":
    main()
