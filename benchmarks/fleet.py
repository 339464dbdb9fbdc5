"""A fleet of logical actors in one process, with synthetic episodes. ``scale.py`` starts it.

Each logical actor requests commands, delivers a prepared episode for each, and has one episode in
flight at a time, like a real actor.
"""

import contextlib
import os
import queue
import sys
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np
import zenoh

from udrl.commands import Command
from udrl.environments import EnvironmentSpec
from udrl.episode import Episode
from udrl_proto import key_expressions, verbs
from udrl_proto import session as sessions
from udrl_proto.codec import LARGEST, decode, encode, encode_array
from udrl_proto.messages import (
    CommandsReply,
    CommandsRequest,
    EpisodeMessage,
    EpisodeReply,
    JoinRequest,
    Message,
    WeightsMessage,
)
from udrl_proto.replay_client import ReplayClient
from udrl_proto.zenoh_transport import ZenohTransport

RUN = "scale"
#: Number of different synthetic episodes.
_VARIETY = 64
_WANTED = 16


class Load(msgspec.Struct, frozen=True):
    """The task of a fleet process."""

    endpoint: str
    actors: int
    sessions: int
    steps: int
    seconds: float


class Measured(msgspec.Struct, frozen=True):
    """The results of a fleet process: latencies in seconds, arrivals by weights version."""

    acknowledged: float
    episode_s: list[float]
    command_s: list[float]
    retries: int
    arrivals: dict[str, float]


@dataclass
class LogicalActor:
    """A logical actor: its commands, and its current request."""

    name: str
    session: zenoh.Session
    commands: deque[Command] = field(default_factory=deque)
    verb: str = ""
    payload: bytes = b""
    requested_at: float = 0.0
    answered: bool = True
    query: int = 0


class LogicalFleet:
    """All logical actors, driven by one thread. Replies come through one queue."""

    def __init__(self, load: Load) -> None:
        self._load = load
        self._answers: queue.SimpleQueue[tuple[LogicalActor, int, bytes | None]] = (
            queue.SimpleQueue()
        )
        self._sessions = [sessions.connect(load.endpoint, 30.0) for _ in range(load.sessions)]
        hello = sessions.find_run(self._sessions[0], RUN, 30.0)
        self._spec = hello.environment
        self._episodes = [_made_up(self._spec, load.steps, i) for i in range(_VARIETY)]
        self._arrivals: dict[str, float] = {}
        self._episode_s: list[float] = []
        self._command_s: list[float] = []
        self._retries = 0
        self._news = False

    def run(self) -> Measured:
        """Join, then run for the load's duration."""
        subscribers = [
            s.declare_subscriber(
                key_expressions.key(RUN, key_expressions.NEW_WEIGHTS), self._note_weights
            )
            for s in self._sessions
        ]
        actors = [
            LogicalActor(f"logical-{i}", self._sessions[i % len(self._sessions)])
            for i in range(self._load.actors)
        ]
        for actor in actors:
            ReplayClient(ZenohTransport(actor.session), RUN, actor.name).request(
                verbs.JOIN, self._join(actor)
            )
        for actor in actors:
            self._next(actor)
        warm = time.monotonic() + self._load.seconds / 4
        began = 0.0
        end = warm + self._load.seconds
        pauses: list[tuple[float, LogicalActor]] = []
        while (now := time.monotonic()) < end:
            if not began and now >= warm:
                began = now
                self._episode_s.clear()
                self._command_s.clear()
            if self._news:  # new weights mean new commands, so waiting ends
                self._news = False
                pauses = [(now, actor) for _, actor in pauses]
            for _, actor in [p for p in pauses if p[0] <= now]:
                self._go_on(actor)
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

    def _join(self, actor: LogicalActor) -> JoinRequest:
        return JoinRequest(
            role="actor", id=actor.name, host="fleet", pid=os.getpid(), software="0",
            environments=_WANTED, numerics_class="synthetic", environment=self._spec,
        )  # fmt: skip

    def _note_weights(self, sample: zenoh.Sample) -> None:
        version = decode(sample.payload.to_bytes(), WeightsMessage, LARGEST).version
        self._arrivals[str(version)] = time.monotonic()  # that of the last session
        self._news = True

    def _go_on(self, actor: LogicalActor) -> None:
        """Repeat a request without a reply, or send the next one."""
        if actor.answered:
            self._next(actor)
        else:
            self._ask(actor)

    def _next(self, actor: LogicalActor) -> None:
        """Deliver the next episode, or request commands."""
        if actor.commands:
            command_id = actor.commands[0].id
            made_up = self._episodes[command_id % _VARIETY]
            message = msgspec.structs.replace(made_up, actor=actor.name, command_id=command_id)
            self._send(actor, verbs.EPISODE.name, message)
        else:
            self._send(
                actor, verbs.COMMANDS.name, CommandsRequest(actor=actor.name, wanted=_WANTED)
            )

    def _send(self, actor: LogicalActor, verb: str, message: Message) -> None:
        actor.verb, actor.payload = verb, encode(message)
        actor.requested_at, actor.answered = time.monotonic(), False
        self._ask(actor)

    def _ask(self, actor: LogicalActor) -> None:
        actor.query = query = actor.query + 1

        def reply(answer: zenoh.Reply) -> None:
            if answer.ok is not None:
                self._answers.put((actor, query, answer.ok.payload.to_bytes()))

        # The callback runs on Zenoh's thread and only fills the queue. A thread per query, the
        # default, would cost more than the query.
        actor.session.get(
            key_expressions.key(RUN, actor.verb),
            zenoh.handlers.Callback(
                reply, lambda: self._answers.put((actor, query, None)), indirect=False
            ),
            payload=actor.payload,
            timeout=10.0,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def _take(
        self, actor: LogicalActor, query: int, answer: bytes | None
    ) -> tuple[LogicalActor, float] | None:
        """Handle a reply; return the actor and the seconds to wait if it has to wait."""
        if query != actor.query:
            return None  # the end of a query that had a reply
        if answer is None:  # dropped or late: repeat after a pause, like a real actor
            self._retries += 1
            actor.query += 1
            return actor, 0.5
        actor.query += 1
        actor.answered = True
        took = time.monotonic() - actor.requested_at
        if actor.verb == verbs.EPISODE.name:
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
    rng, acted = np.random.default_rng(seed), spec.action_space
    episode = Episode(
        command_id=0,
        observations=rng.normal(size=(steps, *spec.observation_space.shape)).astype(np.float32),
        actions=rng.integers(0, acted.n_parameters, steps).astype(acted.dtype),
        rewards=rng.normal(size=steps).astype(np.float32),
        terminated=True,
        truncated=False,
    )
    return EpisodeMessage(
        actor="nobody", command_id=0, observations=encode_array(episode.observations),
        actions=encode_array(episode.actions), rewards=encode_array(episode.rewards),
        terminated=True, truncated=False,
    )  # fmt: skip


if __name__ == "__main__":
    load = msgspec.json.decode(sys.argv[1], type=Load)
    Path(sys.argv[2]).write_bytes(msgspec.json.encode(LogicalFleet(load).run()))
