"""A discrete-event simulation of a run: actors, replay service and learner."""

import heapq
import itertools
import math
from collections import defaultdict
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from udrl.config import Config
from udrl.schedule import opened_by, weights_version

#: Iteration and index of a command.
CommandId = tuple[int, int]

#: Minimum number of cores for actors.
_LEAST_CORES = 0.1


class Costs(NamedTuple):
    """Durations of the parts of a run, in seconds.

    Attributes:
        round: CPU time of an actor's round, without its rows.
        row: CPU time of a row in a round: environment step and inference.
        sleep: time of a row without CPU.
        version: time to train a version, including other work of the learner.
        replay: CPU time of the replay service per episode.
        answer: from a request to its reply.
        sync: from an episode's end to its acknowledgement, without ``replay``.
        fetch: from an iteration's end until the learner has its episodes.
        delivery: from a trained version to the commands with this version.
        start: from the first commands until the learner can train.
    """

    round: float
    row: float
    sleep: float
    version: float
    replay: float
    answer: float
    sync: float
    fetch: float
    delivery: float
    start: float


class Recorded(NamedTuple):
    """A run: the episode lengths of each iteration, by index, and the settings."""

    lengths: list[list[int]]
    config: Config


class Timing(NamedTuple):
    """Times at which warm-up and last iteration end, in seconds, and the steps in between."""

    warm_up: float
    end: float
    steps: int

    @property
    def speed(self) -> float:
        """Env steps per second after the warm-up."""
        return self.steps / (self.end - self.warm_up)


@dataclass
class SimulatedActor:
    """The state of an actor.

    Attributes:
        free: number of environments without an episode.
        running: remaining steps of each episode.
        held: number of unacknowledged commands.
        load: cores that the current round uses; 0: no round is in progress.
        asking: whether it waits for commands.
    """

    free: int
    running: dict[CommandId, int] = field(default_factory=dict)
    held: int = 0
    load: float = 0.0
    asking: bool = False


class Simulation:
    """Simulates a recorded run.

    Args:
        recorded: the run.
        costs: durations of its parts.
        cores: number of cores; replay service and learner have priority.
        actors: number of actors.
        environments: environments per actor.
    """

    def __init__(
        self, recorded: Recorded, costs: Costs, cores: float, actors: int, environments: int
    ) -> None:
        self._lengths, self._costs, self._cores = recorded.lengths, costs, cores
        self._lead = recorded.config.lead
        self._training_threads = recorded.config.arithmetic.training_threads
        self._last = len(self._lengths) - 1
        self._actors = [SimulatedActor(environments) for _ in range(actors)]
        self._events: list[tuple[float, int, str, Any]] = []
        self._tie = itertools.count()
        self._now = 0.0
        # Commands that wait for a version; those that no actor has; the number of commands that
        # are neither waiting nor done.
        self._awaiting: dict[int, list[CommandId]] = defaultdict(list)
        self._unassigned: list[CommandId] = []
        self._in_play = 0
        self._left: dict[int, int] = {}
        self._ends: list[float] = []
        self._held, self._trained = -1, 0
        self._is_training = False
        self._load = 0.0
        self._replay_free = 0.0

    def run(self) -> Timing:
        """Simulate until the last iteration is complete. Later iterations have its lengths."""
        self._open(0)
        self._delivered(0)
        while len(self._ends) <= self._last:
            self._now, _, kind, payload = heapq.heappop(self._events)
            getattr(self, f"_{kind}")(payload)
        return Timing(self._ends[0], self._ends[-1], sum(map(sum, self._lengths[1:])))

    def _at(self, delay: float, kind: str, payload: Any) -> None:
        heapq.heappush(self._events, (self._now + delay, next(self._tie), kind, payload))

    def _open(self, iteration: int) -> None:
        n = self._left[iteration] = len(self._lengths[min(iteration, self._last)])
        version = weights_version(iteration, self._lead)
        self._awaiting[version] += [(iteration, index) for index in range(n)]

    # Actors.

    def _ask(self, actor: SimulatedActor) -> None:
        if actor.free and not actor.asking:
            actor.asking = True
            self._at(self._costs.answer, "answered", actor)

    def _answered(self, actor: SimulatedActor) -> None:
        actor.asking = False
        share = math.ceil(self._in_play / len(self._actors)) - actor.held
        for _ in range(min(len(self._unassigned), actor.free, share)):
            iteration, index = command = heapq.heappop(self._unassigned)
            actor.running[command] = self._lengths[min(iteration, self._last)][index]
            actor.free -= 1
            actor.held += 1
        self._step(actor)

    def _step(self, actor: SimulatedActor) -> None:
        if actor.load or not actor.running:
            return
        rows = len(actor.running)
        cpu = self._costs.round + rows * self._costs.row
        sleep = rows * self._costs.sleep
        actor.load = cpu / (cpu + sleep)
        self._load += actor.load
        others = self._training_threads * self._is_training + (self._now < self._replay_free)
        cores = max(self._cores - others, _LEAST_CORES)
        # Actors share the cores in proportion to their load: those that sleep need less.
        self._at((cpu + sleep) * max(1.0, self._load / cores), "stepped", actor)

    def _stepped(self, actor: SimulatedActor) -> None:
        self._load -= actor.load
        actor.load = 0.0
        for command in list(actor.running):
            actor.running[command] -= 1
            if not actor.running[command]:
                del actor.running[command]
                actor.free += 1
                stored = max(self._now, self._replay_free) + self._costs.replay
                self._replay_free = stored
                delay = stored - self._now + self._costs.sync
                self._at(delay, "arrived", (actor, command[0]))
        if self._unassigned:
            self._ask(actor)
        self._step(actor)

    # The replay service.

    def _arrived(self, episode: tuple[SimulatedActor, int]) -> None:
        actor, iteration = episode
        actor.held -= 1
        self._in_play -= 1
        self._left[iteration] -= 1
        while self._left.get(len(self._ends)) == 0:
            completed = len(self._ends)
            self._ends.append(self._now)
            awake = max(self._now, self._costs.start) - self._now
            self._at(awake + self._costs.fetch, "fetched", completed)
            for opened in opened_by(completed, self._lead):
                self._open(opened)
        self._ask(actor)

    # The learner.

    def _fetched(self, iteration: int) -> None:
        self._held = iteration
        self._train()

    def _train(self) -> None:
        if not self._is_training and self._held >= self._trained:
            self._is_training = True
            self._at(self._costs.version, "finished", None)

    def _finished(self, _: None) -> None:
        self._is_training = False
        self._trained += 1
        self._at(self._costs.delivery, "delivered", self._trained)
        self._train()

    def _delivered(self, version: int) -> None:
        for command in self._awaiting.pop(version, []):
            heapq.heappush(self._unassigned, command)
            self._in_play += 1
        for actor in self._actors:
            self._ask(actor)
