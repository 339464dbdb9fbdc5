"""How long a run takes on a machine that is not here: a simulation of actors, replay and learner.

A run is a function of its configuration, so its episodes, their lengths and the order of versions
do not depend on the hardware; only time does. One run is made here and its episode lengths are
recorded; the costs of its parts are measured, that of a version in a run with services; then the
same run is simulated with any number of cores and actors. ``--check`` makes the same run with real
services and prints both::

    python benchmarks/pipeline.py --max-env-steps 100000 --actors 1 2 4 --check
    python benchmarks/pipeline.py --max-env-steps 100000 --cores 2 4 8 16 --actors 1 3 7 15
"""

import argparse
import heapq
import itertools
import json
import math
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

from speed import _window
from udrl.acting import EpisodeGenerator
from udrl.commands import CLOSING, TRAINING_SEEDS, Command
from udrl.config import COMMANDS_PER_ITERATION, Config
from udrl.graph import acting_graph
from udrl.inference import ActingFunction, probe_weights
from udrl.schedule import opened_by, weights_version
from udrl.streams import Purpose, stream_key
from udrl_launch.settings import Settings, gather
from udrl_launch.training import train
from udrl_replay.run import Run

#: Seconds on this machine, in runs: between a question and its answer; from an episode's end to the
#: sync that acknowledges it; from an iteration's end to its episodes at the learner; from a version
#: trained to commands that name it (docs/performance.md).
_ANSWER_S, _SYNC_S, _FETCH_S, _VERSION_S = 0.001, 0.005, 0.010, 0.0126


class Costs(NamedTuple):
    """Seconds.

    Attributes:
        round: CPU of a round of an actor besides its rows.
        row: CPU of a row in a round: the environment's step, and the network's.
        sleep: of a row, without CPU.
        version: from the buffer to a version trained.
        answer: between a question and its answer.
        sync: from an episode's end to its acknowledgement.
        fetch: from an iteration's end to its episodes at the learner.
        delivery: from a version trained to commands that name it.
    """

    round: float
    row: float
    version: float
    sleep: float = 0.0
    answer: float = _ANSWER_S
    sync: float = _SYNC_S
    fetch: float = _FETCH_S
    delivery: float = _VERSION_S


class Recorded(NamedTuple):
    """A run: the length of each episode by command id, and its settings."""

    lengths: dict[int, int]
    config: Config


@dataclass
class Actor:
    """Environments, what runs in them, and whether a round or a question is under way."""

    free: int
    running: dict[int, int] = field(default_factory=dict)
    stepping: bool = False
    asking: bool = False


class Simulation:
    """Plays a recorded run.

    Args:
        recorded: the run.
        costs: of its parts.
        cores: for all actors and the learner, who has one of them whenever it trains.
        actors: how many.
        environments: of each actor.
    """

    def __init__(
        self, recorded: Recorded, costs: Costs, cores: float, actors: int, environments: int
    ) -> None:
        self._lengths, self._costs, self._cores = recorded.lengths, costs, cores
        self._lead = recorded.config.lead
        self._actors = [Actor(environments) for _ in range(actors)]
        self._events: list[tuple[float, int, str, Any]] = []
        self._tie = itertools.count()
        self._of_iteration: dict[int, list[int]] = defaultdict(list)
        for command_id in sorted(self._lengths):
            self._of_iteration[command_id // COMMANDS_PER_ITERATION].append(command_id)
        self._last = max(self._of_iteration)
        self._undealt: list[int] = []
        self._left: dict[int, int] = {}
        self._completed, self._held, self._version, self._trained = -1, -1, 0, 0
        self._is_training = False
        self._ends: dict[int, float] = {}
        self._now = 0.0

    def run(self) -> float:
        """Return env steps per second from the end of the warm-up to the end of the run."""
        self._open(0)
        self._wake()
        while self._events and self._completed < self._last:
            self._now, _, kind, payload = heapq.heappop(self._events)
            getattr(self, f"_{kind}")(payload)
        seconds = self._ends[self._last] - self._ends[0]
        steps = sum(n for i, n in self._lengths.items() if i >= COMMANDS_PER_ITERATION)
        return steps / seconds

    def _at(self, delay: float, kind: str, payload: Any) -> None:
        heapq.heappush(self._events, (self._now + delay, next(self._tie), kind, payload))

    def _open(self, iteration: int) -> None:
        ids = self._of_iteration.get(iteration, [])
        self._left[iteration] = len(ids)
        for command_id in ids:
            heapq.heappush(self._undealt, command_id)

    def _wake(self) -> None:
        for actor in self._actors:
            if actor.free and not actor.asking:
                actor.asking = True
                self._at(self._costs.answer, "answered", actor)

    def _answered(self, actor: Actor) -> None:
        actor.asking = False
        in_play = len(self._undealt) + sum(len(a.running) for a in self._actors)
        share = math.ceil(in_play / len(self._actors)) - len(actor.running)
        while self._undealt and actor.free and share > 0:
            iteration = self._undealt[0] // COMMANDS_PER_ITERATION
            if weights_version(iteration, self._lead) > self._version:
                break
            command_id = heapq.heappop(self._undealt)
            actor.running[command_id] = self._lengths[command_id]
            actor.free -= 1
            share -= 1
        self._step(actor)

    def _step(self, actor: Actor) -> None:
        if actor.stepping or not actor.running:
            return
        actor.stepping = True
        stepping = sum(a.stepping for a in self._actors)
        cores = max(self._cores - self._is_training, 0.1)
        rows = len(actor.running)
        cpu = (self._costs.round + rows * self._costs.row) * max(1.0, stepping / cores)
        self._at(cpu + rows * self._costs.sleep, "stepped", actor)

    def _stepped(self, actor: Actor) -> None:
        actor.stepping = False
        for command_id in list(actor.running):
            actor.running[command_id] -= 1
            if not actor.running[command_id]:
                del actor.running[command_id]
                actor.free += 1
                self._at(self._costs.sync, "arrived", command_id)
        if actor.free and not actor.asking and self._undealt:
            actor.asking = True
            self._at(self._costs.answer, "answered", actor)
        self._step(actor)

    def _arrived(self, command_id: int) -> None:
        self._left[command_id // COMMANDS_PER_ITERATION] -= 1
        while self._completed < self._last and self._left.get(self._completed + 1) == 0:
            self._completed += 1
            self._ends[self._completed] = self._now
            self._at(self._costs.fetch, "fetched", self._completed)
            for iteration in opened_by(self._completed, self._lead):
                self._open(iteration)
        self._wake()

    def _fetched(self, iteration: int) -> None:
        self._held = iteration
        self._train()

    def _train(self) -> None:
        if not self._is_training and self._held >= self._trained:
            self._is_training = True
            self._at(self._costs.version, "trained_one", None)

    def _trained_one(self, _: None) -> None:
        self._is_training = False
        self._trained += 1
        self._at(self._costs.delivery, "delivered", self._trained)
        self._train()

    def _delivered(self, version: int) -> None:
        self._version = version
        self._wake()


def record(settings: Settings) -> Recorded:
    """Make a run in this process."""
    lengths: dict[int, int] = {}
    accept = Run.accept

    def note_episode(self: Run, arrival: Any, now: float) -> Any:
        if arrival.entry.id % COMMANDS_PER_ITERATION < CLOSING:
            lengths[arrival.entry.id] = arrival.entry.length
        return accept(self, arrival, now)

    with (
        tempfile.TemporaryDirectory() as folder,
        mock.patch.object(Run, "accept", note_episode),
    ):
        train(settings, Path(folder) / "run", threading.Event(), in_process=True)
    complete = max(lengths) // COMMANDS_PER_ITERATION - settings.config.lead - 1
    kept = {i: n for i, n in lengths.items() if i // COMMANDS_PER_ITERATION <= complete}
    return Recorded(kept, settings.config)


def measure(config: Config, version_s: float) -> Costs:
    """Time rounds of 1 to 8 rows alone; a version's training has been timed in a run."""
    times = {n: _round(config, n) for n in (1, 2, 4, 8)}
    mean_n, mean_t = sum(times) / len(times), sum(times.values()) / len(times)
    row = sum((n - mean_n) * (t - mean_t) for n, t in times.items()) / sum(
        (n - mean_n) ** 2 for n in times
    )
    return Costs(max(mean_t - row * mean_n, 0.0), row, version_s)


def _round(config: Config, rows: int) -> float:
    with closing(EpisodeGenerator(config, rows)) as generator:
        graph = acting_graph(config.network, generator.spec)
        behavior = ActingFunction(graph, probe_weights(graph))
        numbers = itertools.count()
        rounds, began = 0, time.process_time()
        while rounds < 4000:
            while generator.free:
                generator.start(_command(next(numbers), generator.spec.max_episode_steps), behavior)
            generator.step()
            rounds += 1
        return (time.process_time() - began) / rounds


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


def real(options: argparse.Namespace, actors: int) -> tuple[float, float]:
    """Return the env steps per second of the services, and the median training of a version."""
    with tempfile.TemporaryDirectory() as folder:
        run_dir = Path(folder) / "run"
        command = [
            sys.executable, "-m", "udrl_launch", "train", options.env, "--run-dir", str(run_dir),
            "--max-env-steps", str(options.max_env_steps), "--actors", str(actors),
            "--envs-per-actor", str(options.envs_per_actor), "--json",
        ]  # fmt: skip
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        window = _window(run_dir)
        with closing(sqlite3.connect(run_dir / "run.sqlite")) as file:
            trained = [seconds for (seconds,) in file.execute("SELECT train_s FROM versions")]
    return window.steps / window.seconds, statistics.median(trained)


def main() -> None:
    """Simulate, and compare if that is wanted."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="LunarLander-v3")
    parser.add_argument("--max-env-steps", type=int, default=100_000)
    parser.add_argument("--cores", type=float, nargs="+", default=[2.0])
    parser.add_argument("--actors", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--envs-per-actor", type=int, default=16)
    parser.add_argument("--check", action="store_true", help="make the same runs with services")
    options = parser.parse_args()
    settings = gather(options.env, options={"max_env_steps": options.max_env_steps})
    found = {n: real(options, n) for n in (options.actors if options.check else [2])}
    version_s = statistics.median(seconds for _, seconds in found.values())
    recorded, costs = record(settings), measure(settings.config, version_s)
    print(json.dumps(costs._asdict()))
    pairs: Iterator[tuple[float, int]] = (
        itertools.product(options.cores, options.actors)
        if len(options.cores) == 1
        else zip(options.cores, options.actors, strict=True)
    )
    for cores, actors in pairs:
        speed = Simulation(recorded, costs, cores, actors, options.envs_per_actor).run()
        line = f"{cores:6.0f} cores {actors:4d} actors: {speed:10,.0f} env steps/s"
        if options.check:
            services = found[actors][0]
            line += f", the services {services:10,.0f} ({speed / services - 1:+.1%})"
        print(line, flush=True)


if __name__ == "__main__":
    main()
