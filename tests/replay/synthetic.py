"""Runs without networks and environments, in which episodes and weights are digests.

An episode is a function of its command and of the weights that the command names; weights are
a function of the version before and of the buffer. Every mistake of a run changes a digest.
"""

import hashlib
import sqlite3
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np

from udrl.actions import Categorical
from udrl.commands import Command, CommandSampler
from udrl.config import Budget, Config, build, flat
from udrl.digests import episode_digest, replay_digest
from udrl.environments import EnvironmentSpec
from udrl.episode import Episode
from udrl.evaluation import Evaluation, summarise
from udrl.graph import acting_graph
from udrl.replay_buffer import Entry, ReplayBuffer
from udrl.schedule import evaluation_due, opened_by, weights_version
from udrl.spaces import Vector
from udrl_proto import PROTOCOL
from udrl_proto.codec import decode, encode_episode
from udrl_proto.messages import EpisodeMessage, Hello, JoinRequest
from udrl_replay.arrival import Arrival, inspect_episode
from udrl_replay.progress import RunProgress
from udrl_replay.run import StoredRun
from udrl_replay.run_state import RunState
from udrl_replay.store import Store, Version

#: Several pages of the file.
BLOB = bytes(range(256)) * 40
MAX_AGE = 3
SPEC = EnvironmentSpec(
    observation_space=Vector(size=2), action_space=Categorical(n=3), max_episode_steps=4
)


def config(lead: int = 0) -> Config:
    """Return the settings of a run with a dozen steps an iteration, evaluations and many ties."""
    return build(
        Config,
        {
            "environment": "Synthetic-v0",
            "lead": lead,
            "n_warm_up_episodes": 4,
            "n_episodes_per_iter": 3,
            "replay_size": 5,
            "max_age": MAX_AGE,
            "recent_size": 4,
            "last_few": 2,
            "eval_every": 9,
            "eval_episodes": 2,
        },
    )


def hello(lead: int = 0) -> Hello:
    return Hello(
        protocol=PROTOCOL,
        software="0",
        run_id="synthetic",
        settings=flat(config(lead)),
        environment=SPEC,
        graph=acting_graph(config(lead).network, SPEC),
    )


def create(run_dir: Path, lead: int = 0) -> Store:
    """Create a run."""
    return Store.create(run_dir, hello=hello(lead), progress=RunProgress())


def join(name: str, environments: int = 4) -> JoinRequest:
    return JoinRequest(
        role="actor",
        id=name,
        host="h",
        pid=1,
        software="0",
        environments=environments,
        numerics_class="c",
        environment=SPEC,
    )


def episode(command: Command, weights: bytes, other: bool = False) -> Episode:
    """Run a command; ``other``: with the result of a machine that rounds differently."""
    text = f"{command.id}|{command.desired_return}|{command.desired_horizon}"
    cause = hashlib.sha256(text.encode() + weights).digest()
    length = 1 + cause[0] % command.max_steps
    return Episode(
        command_id=command.id,
        observations=np.frombuffer(cause[: 2 * length], np.uint8).reshape(-1, 2).astype(np.float32),
        actions=np.frombuffer(cause[:length], np.uint8) % 3,
        rewards=(np.frombuffer(cause[-length:], np.uint8) % 3 - other).astype(np.float32),
        terminated=True,
        truncated=False,
    )


def arrive(made: Episode, actor: str = "a") -> Arrival:
    """Encode, decode and check an episode."""
    return inspect_episode(decode(encode_episode(made, actor), EpisodeMessage), SPEC)


def entry(made: Episode) -> Entry:
    return Entry(made.episode_return, made.command_id, made.length)


def trained(version: int, before: bytes, buffer: Iterable[bytes]) -> Version:
    """Train a version on a buffer, given as the episodes' digests by rank."""
    weights = hashlib.sha256(b"|".join([before, *buffer])).digest()
    return Version(version, hashlib.sha256(weights).digest(), 1.0 / version, weights, b"adam")


class Result(NamedTuple):
    """The state of a run, to be compared with :func:`reference`."""

    iteration: int
    env_steps: int
    weights: bytes
    replay: bytes
    evaluation: Evaluation | None
    final: Evaluation | None


def reference(lead: int, max_env_steps: int) -> Result:
    """Compute the expected result in the obvious way, from the beginning for each buffer."""
    settings = config(lead)
    sample = CommandSampler(settings, SPEC)
    weights = [b""]
    steps: list[int] = []
    explored: list[list[Episode]] = []
    evaluation = None

    def buffer(iteration: int) -> list[Episode]:
        held: list[Episode] = []
        for i in range(iteration + 1):
            held = [e for e in held + explored[i] if i - entry(e).iteration < MAX_AGE]
            best = sorted(held, key=entry)[-settings.buffer.replay_size :]
            newest = held[-settings.buffer.recent_size :]
            held = [e for e in held if e in best or e in newest]
        return sorted(held, key=entry)

    def run_commands(commands: Sequence[Command]) -> list[Episode]:
        return [episode(c, weights[c.weights_version]) for c in commands]

    while not steps or steps[-1] < max_env_steps:
        i = len(steps)
        if i == 0:
            explored.append(run_commands(sample.warm_up()))
        else:
            weights.append(trained(i, weights[-1], map(episode_digest, buffer(i - 1))).weights)
            source = weights_version(i, lead) - 1
            drawn_from = ReplayBuffer(settings.buffer, map(entry, buffer(source)))
            explored.append(run_commands(sample.explore(i, drawn_from)))
            before = steps[source - 1] if source else 0
            due = evaluation_due(before, steps[source], settings.evaluation.eval_every)
            if due and i == opened_by(source, lead)[0]:
                returns = [e.episode_return for e in run_commands(sample.evaluate(i, drawn_from))]
                evaluation = summarise(returns)
        steps.append(sum(e.length for done in explored for e in done))
    digest = replay_digest(map(episode_digest, buffer(i)))
    final = None
    if i > 0:
        last = ReplayBuffer(settings.buffer, map(entry, buffer(i)))
        final = summarise([e.episode_return for e in run_commands(sample.evaluate_final(i, last))])
    return Result(i, steps[-1], weights[-1], digest, evaluation, final)


def result(run: RunState) -> Result:
    """Return the state of a run in the terms of :func:`reference`."""
    version = run.store.version(run.progress.latest_version)
    last = run.store.last_evaluation(is_final=False)
    final = run.store.last_evaluation(is_final=True)
    return Result(
        run.progress.iteration,
        run.progress.env_steps,
        version.weights if version else b"",
        replay_digest(run.digests[e.id] for e in run.buffer),
        last.evaluation if last else None,
        final.evaluation if final else None,
    )


def train_next(run: StoredRun) -> Version:
    """Act as the learner: return the version that the run waits for."""
    number = run.progress.latest_version + 1
    before = run.store.version(number - 1)
    buffer = run.store.buffer(number - 1)
    return trained(number, before.weights if before else b"", (p.digest for p in buffer))


def weights_of(run: StoredRun, command: Command) -> bytes:
    """Return the weights that a command names, which the run must have kept."""
    if command.weights_version == 0:
        return b""
    version = run.store.version(command.weights_version)
    assert version is not None
    assert version.weights, (
        f"version {command.weights_version} is missing, but command {command.id} needs it"
    )
    return version.weights


def work(run: StoredRun) -> None:
    """Deliver a version if one is awaited, and an episode for each command whose weights exist."""
    with run.store.transaction():
        if run.awaits_version() is not None:
            run.add_version(train_next(run), 0.0)
        for item in list(run.dispatcher.outstanding.values()):
            command = item.command
            wanted = command.id in run.dispatcher.outstanding
            if wanted and command.weights_version <= run.progress.latest_version:
                run.accept(arrive(episode(command, weights_of(run, command))), 0.0)
        run.save()


def finish(run: StoredRun) -> None:
    """Work until the run has ended."""
    while run.progress.state in ("running", "finishing"):
        work(run)


def reopen(run: StoredRun, run_dir: Path, budget: Budget | None = None) -> StoredRun:
    """End a replay service and start another on the same file."""
    run.store.close()
    return StoredRun(Store(run_dir), budget or run.budget)


def edit(path: Path, statement: str, *values: object) -> None:
    with closing(sqlite3.connect(path)) as db, db:
        db.execute(statement, values)
