"""Fleets of logical actors with synthetic episodes: what one replay service carries.

::

    .venv/bin/python benchmarks/scale.py --actors 1 10 100 1000 --kilobytes 20 1000

A real replay service runs in a process of its own. One more process holds the Zenoh sessions of the
fleet; each logical actor there asks for commands, answers every one with an episode that was made
up beforehand, and has one episode in flight at a time, like a real one. A learner that does not
train delivers the same weights as every version.
"""

import argparse
import contextlib
import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import zenoh

from udrl.checkpoint import encode_optimizer, encode_weights
from udrl.commands import Command
from udrl.config import Budget, Config
from udrl.environments import EnvironmentSpec
from udrl.episode import Episode
from udrl.errors import Interrupted
from udrl.numerics import use_one_thread
from udrl.training import untrained
from udrl_launch.training import free_port
from udrl_proto import PROTOCOL, keys
from udrl_proto import session as sessions
from udrl_proto.asking import Asker
from udrl_proto.codec import LARGEST, decode, encode, encode_array
from udrl_proto.messages import (
    ChangesReply,
    ChangesRequest,
    CommandsReply,
    CommandsRequest,
    EpisodeMessage,
    EpisodeReply,
    Hello,
    JoinReply,
    JoinRequest,
    Message,
    Status,
    StatusRequest,
    VersionMessage,
    VersionReply,
    Weights,
)
from udrl_replay.creation import write_config
from udrl_replay.run import Progress
from udrl_replay.store import Store

_TICK = os.sysconf("SC_CLK_TCK")
_RUN = "scale"
#: Made-up episodes that an actor chooses from.
_VARIETY = 64
_WANTED = 16


class Load(msgspec.Struct, frozen=True):
    """What a fleet process is told."""

    endpoint: str
    actors: int
    sessions: int
    steps: int
    seconds: float


class Measured(msgspec.Struct, frozen=True):
    """What a fleet process found; latencies in seconds, arrivals by weights version."""

    acknowledged: float
    episode_s: list[float]
    command_s: list[float]
    retries: int
    arrivals: dict[str, float]


def spec_of(kilobytes: int) -> EnvironmentSpec:
    """Return an environment whose longest episode has so many kilobytes."""
    size = 8 if kilobytes < 100 else 256
    return EnvironmentSpec(
        observation_size=size, n_actions=4, max_episode_steps=kilobytes * 1000 // (4 * size + 5)
    )


# The fleet, in a process of its own.


@dataclass
class Actor:
    """A logical actor: what it holds, and what it is waiting for an answer to."""

    name: str
    session: zenoh.Session
    commands: deque[Command] = field(default_factory=deque)
    verb: str = ""
    payload: bytes = b""
    asked_at: float = 0.0
    query: int = 0


class Fleet:
    """All logical actors, driven by one thread; answers come through one queue."""

    def __init__(self, load: Load) -> None:
        self._load = load
        self._answers: queue.SimpleQueue[tuple[Actor, int, bytes | None]] = queue.SimpleQueue()
        self._sessions = [sessions.connect(load.endpoint, 30.0) for _ in range(load.sessions)]
        hello = sessions.find_run(self._sessions[0], _RUN, 30.0)
        self._spec = hello.environment
        self._episodes = [_made_up(self._spec, load.steps, i) for i in range(_VARIETY)]
        self._arrivals: dict[str, float] = {}
        self._episode_s: list[float] = []
        self._command_s: list[float] = []
        self._retries = 0
        self._news = False

    def run(self) -> Measured:
        """Join, then work for the time that the load says."""
        subscribers = [
            s.declare_subscriber(keys.key(_RUN, keys.NEW_WEIGHTS), self._note_weights)
            for s in self._sessions
        ]
        actors = [
            Actor(f"logical-{i}", self._sessions[i % len(self._sessions)])
            for i in range(self._load.actors)
        ]
        for actor in actors:
            Asker(actor.session, _RUN, actor.name).ask(keys.JOIN, self._join(actor), JoinReply)
        for actor in actors:
            self._next(actor)
        warm = time.monotonic() + self._load.seconds / 4
        began = 0.0
        end = warm + self._load.seconds
        pauses: list[tuple[float, Actor]] = []
        while (now := time.monotonic()) < end:
            if not began and now >= warm:
                began = now
                self._episode_s.clear()
                self._command_s.clear()
            if self._news:  # new weights mean new commands: nobody waits any longer
                self._news = False
                pauses = [(now, actor) for _, actor in pauses]
            for _, actor in [p for p in pauses if p[0] <= now]:
                self._next(actor)
            pauses = [p for p in pauses if p[0] > now]
            with contextlib.suppress(queue.Empty):
                pause_s = self._take(*self._answers.get(timeout=0.01))
                if pause_s is not None:
                    actor, seconds = pause_s
                    pauses.append((now + seconds, actor))
        took = time.monotonic() - began
        for subscriber in subscribers:
            subscriber.undeclare()
        measured = Measured(
            len(self._episode_s) / took,
            self._episode_s,
            self._command_s,
            self._retries,
            self._arrivals,
        )
        for session in self._sessions:
            session.close()
        return measured

    def _join(self, actor: Actor) -> JoinRequest:
        return JoinRequest(
            role="actor", id=actor.name, host="fleet", pid=os.getpid(), software="0",
            environments=_WANTED, numerics_class="synthetic", environment=self._spec,
        )  # fmt: skip

    def _note_weights(self, sample: zenoh.Sample) -> None:
        version = decode(sample.payload.to_bytes(), Weights, LARGEST).version
        self._arrivals[str(version)] = time.monotonic()  # the last session's counts
        self._news = True

    def _next(self, actor: Actor) -> None:
        """Deliver the next episode, or ask for commands."""
        if actor.commands:
            command_id = actor.commands[0].id
            made_up = self._episodes[command_id % _VARIETY]
            message = msgspec.structs.replace(made_up, actor=actor.name, command_id=command_id)
            self._send(actor, keys.EPISODE, message)
        else:
            self._send(actor, keys.COMMANDS, CommandsRequest(actor=actor.name, wanted=_WANTED))

    def _send(self, actor: Actor, verb: str, message: Message) -> None:
        actor.verb, actor.payload = verb, encode(message)
        actor.asked_at = time.monotonic()
        self._ask(actor)

    def _ask(self, actor: Actor) -> None:
        actor.query = query = actor.query + 1

        def reply(answer: zenoh.Reply) -> None:
            if answer.ok is not None:
                self._answers.put((actor, query, answer.ok.payload.to_bytes()))

        # On Zenoh's own thread, which only fills the queue: another thread for every query would
        # cost more than the query.
        actor.session.get(
            keys.key(_RUN, actor.verb),
            zenoh.handlers.Callback(
                reply, lambda: self._answers.put((actor, query, None)), indirect=False
            ),
            payload=actor.payload,
            timeout=10.0,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def _take(self, actor: Actor, query: int, answer: bytes | None) -> tuple[Actor, float] | None:
        """Handle an answer; return when an actor has to wait, and for how long."""
        if query != actor.query:
            return None  # the end of a query that has had its answer
        if answer is None:
            self._retries += 1
            self._ask(actor)
            return None
        actor.query += 1
        took = time.monotonic() - actor.asked_at
        if actor.verb == keys.EPISODE:
            decode(answer, EpisodeReply)
            self._episode_s.append(took)
            actor.commands.popleft()
        else:
            reply = decode(answer, CommandsReply)
            self._command_s.append(took)
            actor.commands.extend(reply.commands)
            if not reply.commands:
                return actor, reply.wait.retry_after_s if reply.wait else 0.05
        self._next(actor)
        return None


def _made_up(spec: EnvironmentSpec, steps: int, seed: int) -> EpisodeMessage:
    rng = np.random.default_rng(seed)
    episode = Episode(
        command_id=0,
        observations=rng.normal(size=(steps, spec.observation_size)).astype(np.float32),
        actions=rng.integers(0, spec.n_actions, steps).astype(np.uint8),
        rewards=rng.normal(size=steps).astype(np.float32),
        terminated=True,
        truncated=False,
    )
    return EpisodeMessage(
        actor="nobody", command_id=0, observations=encode_array(episode.observations),
        actions=encode_array(episode.actions), rewards=encode_array(episode.rewards),
        terminated=True, truncated=False,
    )  # fmt: skip


# The learner that does not train, in this process.


class Announced(NamedTuple):
    """When a weights version was published."""

    version: int
    at: float


def deliver_versions(
    endpoint: str, hello: Hello, stop: threading.Event, announced: list[Announced]
) -> None:
    """Deliver the same weights as every version until ``stop`` is set, and note when."""
    use_one_thread()
    state = untrained(hello.config, hello.environment)
    for parameter in state.behavior.parameters():
        parameter.grad = parameter.new_zeros(parameter.shape)
    state.optimizer.step()  # gives Adam the state that a delivery must have
    weights, optimizer = encode_weights(state.behavior), encode_optimizer(state)
    with contextlib.suppress(Interrupted), sessions.connect(endpoint, 30.0, stop) as session:
        asker = Asker(session, _RUN, "learner scale", stop)
        version = 1
        while not stop.is_set():
            request = ChangesRequest(learner="scale", version=version)
            changes = asker.ask(keys.CHANGES, request, ChangesReply, LARGEST)
            if changes.wait is not None:
                stop.wait(min(changes.wait.retry_after_s, 0.05))
                continue
            message = VersionMessage(
                learner="scale", version=version, weights=weights, optimizer=optimizer, loss=1.0,
                train_s=0.0,
            )  # fmt: skip
            asker.ask(keys.VERSION, message, VersionReply)
            announced.append(Announced(version, time.monotonic()))
            news = encode(Weights(version=version, weights=weights))
            session.put(keys.key(_RUN, keys.NEW_WEIGHTS), news)
            version += 1


# One measurement.


class Sample(NamedTuple):
    """The replay process at one moment: CPU seconds, resident MB, episodes accepted."""

    cpu: float
    resident: float
    accepted: int


@contextlib.contextmanager
def replay_service(run_dir: Path, hello: Hello, endpoint: str) -> Iterator[int]:
    """Run a real replay service; yield its process id."""
    Store.create(run_dir, hello=hello, progress=Progress()).close()
    write_config(run_dir, hello.config, Budget(max_env_steps=2**50))
    command = [
        sys.executable, "-m", "udrl_launch", "replay", hello.config.environment, "--resume",
        "--run-dir", str(run_dir), "--listen", endpoint,
    ]  # fmt: skip
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        yield process.pid
    finally:
        process.terminate()
        process.wait(10)


def measure(actors: int, kilobytes: int, options: argparse.Namespace) -> dict[str, Any]:
    """Return the figures of one fleet."""
    spec = spec_of(kilobytes)
    config = Config(
        environment="Synthetic-v0",
        hidden=(64, 128, 128),
        n_warm_up_episodes=max(100, 2 * actors),
        n_episodes_per_iter=max(100, 2 * actors),
        replay_size=options.replay_size,
        last_few=50,
        lead=2,
        eval_every=2**31 - 1,
    )
    hello = Hello(protocol=PROTOCOL, software="0", run_id=_RUN, config=config, environment=spec)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    stop = threading.Event()
    announced: list[Announced] = []
    samples: list[Sample] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        replay_service(Path(folder) / "run", hello, endpoint) as pid,
        sessions.connect(endpoint, 30.0) as session,
    ):
        asker = Asker(session, _RUN, "scale", patience_s=30.0)
        learner = threading.Thread(
            target=deliver_versions, args=(endpoint, hello, stop, announced), daemon=True
        )
        learner.start()
        load = Load(
            endpoint, actors, min(actors, options.sessions), spec.max_episode_steps, options.seconds
        )
        report = Path(folder) / "fleet.json"
        command = [sys.executable, __file__, "--fleet", msgspec.json.encode(load).decode()]
        fleet = subprocess.Popen([*command, "--json", str(report)])
        try:
            status = asker.ask(keys.STATUS, StatusRequest(), Status)
            deadline = time.monotonic() + 60.0 + 3 * options.seconds
            while fleet.poll() is None and time.monotonic() < deadline:
                status = asker.ask(keys.STATUS, StatusRequest(), Status)
                samples.append(_sample(pid, status))
                with contextlib.suppress(subprocess.TimeoutExpired):
                    fleet.wait(1.0)
            measured = msgspec.json.decode(report.read_bytes(), type=Measured)
        finally:
            fleet.kill()
            stop.set()
            learner.join(10)
    return _figures(load, kilobytes, measured, announced, samples, status)


def _sample(pid: int, status: Status) -> Sample:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    cpu = (int(fields[11]) + int(fields[12])) / _TICK
    return Sample(cpu, pages * os.sysconf("SC_PAGE_SIZE") / 1e6, status.episodes.accepted)


def _figures(
    load: Load,
    kilobytes: int,
    measured: Measured,
    announced: list[Announced],
    samples: list[Sample],
    status: Status,
) -> dict[str, Any]:
    first, last = samples[len(samples) // 4], samples[-1]
    fan_out = [
        measured.arrivals[str(a.version)] - a.at
        for a in announced
        if str(a.version) in measured.arrivals
    ]
    ledger = status.episodes
    assert ledger.delivered == ledger.accepted + ledger.duplicate + ledger.rejected
    return {
        "logical actors": load.actors,
        "sessions": load.sessions,
        "episode, KB": kilobytes,
        "acknowledged episodes/s": round(measured.acknowledged, 1),
        "acknowledged, MB/s": round(measured.acknowledged * kilobytes / 1e3, 1),
        "episode p50, ms": _percentile(measured.episode_s, 50),
        "episode p99, ms": _percentile(measured.episode_s, 99),
        "commands p50, ms": _percentile(measured.command_s, 50),
        "commands p99, ms": _percentile(measured.command_s, 99),
        "replay CPU, ms/episode": round(
            1e3 * (last.cpu - first.cpu) / max(1, last.accepted - first.accepted), 3
        ),
        "replay resident, MB, first to last": f"{first.resident:.0f} to {last.resident:.0f}",
        "weights fan-out p50, ms": _percentile(fan_out, 50),
        "iterations": status.iteration,
        "duplicates": ledger.duplicate,
        "rejected": ledger.rejected,
        "queries asked again": measured.retries,
    }


def _percentile(seconds: list[float], percent: float) -> float:
    return round(1e3 * float(np.percentile(seconds, percent)), 2) if seconds else float("nan")


def main() -> None:
    """Measure every combination and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--actors", nargs="+", type=int, default=[1, 10, 100, 1000])
    parser.add_argument("--kilobytes", nargs="+", type=int, default=[20, 1000])
    parser.add_argument("--sessions", type=int, default=64, help="the most Zenoh sessions")
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--replay-size", type=int, default=500)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--fleet", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.fleet:
        load = msgspec.json.decode(options.fleet, type=Load)
        options.json.write_bytes(msgspec.json.encode(Fleet(load).run()))
        return
    rows = []
    for kilobytes in options.kilobytes:
        for actors in options.actors:
            rows.append(measure(actors, kilobytes, options))
            print(json.dumps(rows[-1]), flush=True)
    names = list(rows[0])
    print("| " + " | ".join(names) + " |\n|" + "---|" * len(names))
    for row in rows:
        print("| " + " | ".join(str(row[n]) for n in names) + " |")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
