"""The replay service: replies to requests in one thread, which owns the run.

Requests are taken from the inbox in groups. A group is handled inside one transaction, and its
replies are sent after the sync: under load many episodes share a sync; without load an episode
waits only for its own.
"""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from udrl.config import Budget
from udrl.digests import arrays_digest
from udrl.errors import InvalidData, InvalidMessage, Refused
from udrl.graph import critic_shapes, weight_shapes
from udrl.weights import decode_weights, optimizer_shapes
from udrl_proto import key_expressions, verbs
from udrl_proto.codec import PAGE, encode
from udrl_proto.inbox import Inbox
from udrl_proto.messages import (
    MAX_TEXT,
    Acknowledged,
    ChangesReply,
    ChangesRequest,
    CommandsReply,
    CommandsRequest,
    EpisodeMessage,
    EpisodeReply,
    EpisodesReply,
    EpisodesRequest,
    FailureMessage,
    Hello,
    HelloRequest,
    JoinReply,
    JoinRequest,
    Message,
    Problem,
    Progress,
    StateReply,
    StateRequest,
    VersionMessage,
    VersionReply,
    Wait,
    WeightsMessage,
    WeightsRequest,
)
from udrl_proto.reports import ContentsRequest, HistoryRequest, StatusRequest
from udrl_proto.serving import ReceivedRequest, serve
from udrl_proto.text import printable
from udrl_proto.transport import Declaration, Presence, Transport
from udrl_replay.admission import Admission
from udrl_replay.arrival import Arrival, Malformed, inspect_episode
from udrl_replay.reporting import (
    MetricsFile,
    Throughput,
    contents,
    history,
    status,
    write_weights,
)
from udrl_replay.run import StoredRun
from udrl_replay.store import Store, Version

log = logging.getLogger("udrl")

#: Maximum number of waiting requests, and of their bytes; others are dropped, and their senders
#: retry.
_INBOX, _INBOX_BYTES = 4096, 512 << 20
#: Maximum number of requests in one transaction, and bytes after which no more are added.
_GROUP, _GROUP_BYTES = 64, 8 << 20
#: Seconds for which the service continues after the end of the run, so that all peers learn of it.
_LINGER_S = 10.0
#: Seconds for which it continues if no peers are connected.
_LINGER_ALONE_S = 0.3


class _Delivery(NamedTuple):
    """A weights version that has been checked."""

    message: VersionMessage
    version: Version


class ReplayService:
    """Serves one run over one transport.

    Args:
        transport: receives the requests.
        store: the run's file.
        budget: the run's stopping criteria.
        run_dir: directory for ``metrics.csv`` and, at the end, the weights.
        audit: share of the episodes that are audited, 0 to 1.
    """

    def __init__(
        self,
        transport: Transport,
        store: Store,
        budget: Budget,
        run_dir: Path,
        audit: float = 0.0,
    ) -> None:
        self.run = StoredRun(store, budget, audit)
        self._admission = Admission(self.run)
        self._transport = transport
        self._store = store
        self._run_dir = run_dir
        self._metrics = MetricsFile(run_dir, store)
        self._metrics.update(self.run.progress.iteration)
        self._inbox: Inbox[ReceivedRequest | Presence] = Inbox(_INBOX, _INBOX_BYTES)
        self._throughput = Throughput()
        self._here: set[tuple[str, str]] = set()  # role and name of the connected services
        # When the versions were accepted that no actor has a command for; to measure the lag.
        self._accepted_at: dict[int, float] = {}
        self._lag_s = 0.0
        self._handlers: dict[str, Callable[[Any, float], Message]] = {
            verbs.HELLO.name: self._hello,
            verbs.JOIN.name: self._join,
            verbs.COMMANDS.name: self._commands,
            verbs.EPISODE.name: self._episode,
            verbs.FAILURE.name: self._failure,
            verbs.CHANGES.name: self._changes,
            verbs.EPISODES.name: self._episodes,
            verbs.VERSION.name: self._version,
            verbs.STATE.name: self._state,
            verbs.WEIGHTS.name: self._weights,
            verbs.STATUS.name: self._status,
            verbs.HISTORY.name: self._history,
            verbs.CONTENTS.name: self._contents,
        }

    def serve(self, stop: threading.Event) -> None:
        """Reply until the run has ended and its peers know, or ``stop`` is set.

        Raises:
            StoreError: the run's file cannot be written.
        """
        run_id = self.run.hello.run_id
        declared = self.open()
        log.info("serving run %s", run_id)
        if self.run.progress.state == "ended":
            why, limit = self.run.progress.ended_because, self.run.limit_reached()
            option = f"--{limit}".replace("_", "-")
            log.info("the run has ended: it %s; raise %s to continue it", why, option)
        try:
            self._reply_until_ended(stop)
            # Not after an error: then memory may be ahead of the disk.
            with self._store.transaction():
                self.run.stop()
            if self.run.progress.state == "ended":
                write_weights(self._run_dir, self._store, self.run.progress.latest_version)
        finally:
            for declaration in declared:
                declaration.undeclare()

    def _reply_until_ended(self, stop: threading.Event) -> None:
        """Reply until the run has ended and its peers can know it, or ``stop`` is set."""
        ended_at: float | None = None
        while not stop.is_set():
            # With a short timeout: silent actors and the end must be noticed without requests.
            self.answer_waiting(0.25)
            now = time.monotonic()
            if self.run.progress.state in ("ended", "failed"):
                ended_at = ended_at or now
                if now - ended_at > (_LINGER_S if self._here else _LINGER_ALONE_S):
                    return

    def close(self) -> None:
        """Close the files that the service keeps open, except the store."""
        self._metrics.close()

    def open(self) -> list[Declaration]:
        """Start to receive requests, and return the declarations; undeclare them to stop.

        Requests are checked on the thread that receives them.
        """
        spec = self.run.hello.environment
        shapes = weight_shapes(self.run.hello.graph)
        with_critic = optimizer_shapes(shapes, critic_shapes(self.run.config.network, spec))

        def check(message: VersionMessage) -> _Delivery:
            digest = arrays_digest(decode_weights(message.weights, shapes))
            decode_weights(message.optimizer, with_critic)
            version = Version(
                message.version, digest, message.loss, message.weights, message.optimizer
            )
            return _Delivery(message, version)

        def arrive(message: EpisodeMessage) -> Arrival | Malformed:
            try:
                return inspect_episode(message, spec)
            except InvalidMessage as error:
                return Malformed(message.actor, error)

        longest = spec.max_episode_steps * spec.step_bytes + verbs.FEW
        episode = replace(verbs.EPISODE, limit=longest)
        run_id = self.run.hello.run_id
        return [
            self._transport.watch(key_expressions.alive(run_id, "*", "*"), self._inbox.must_put),
            *serve(
                self._transport,
                run_id,
                self._inbox,
                [episode if verb is verbs.EPISODE else verb for verb in verbs.VERBS],
                {verbs.EPISODE.name: arrive, verbs.VERSION.name: check},
            ),
        ]

    def answer_waiting(self, timeout_s: float) -> None:
        """Reply to the waiting requests; wait up to ``timeout_s`` seconds for the first."""
        self._reply_to_all(self._inbox.take(_GROUP, _GROUP_BYTES, timeout_s))

    def _reply_to_all(self, group: list[ReceivedRequest | Presence]) -> None:
        """Handle requests and changes of presence in one transaction, then send the replies."""
        now = time.monotonic()
        run = self.run
        before = run.progress.iteration
        replies: list[tuple[ReceivedRequest, Message]] = []
        silent = run.dispatcher.silent_actors({name for _, name in self._here}, now)
        if not group and not silent:
            return
        with self._store.transaction():
            snapshot = msgspec.json.encode(run.progress)
            for name in silent:
                run.remove_actor(name)
            for item in group:
                if isinstance(item, Presence):
                    self._note_presence(item, now)
                else:
                    replies.append((item, self._reply(item, now)))
            if msgspec.json.encode(run.progress) != snapshot:
                run.save()
        self._metrics.update(run.progress.iteration)
        for received, reply in replies:
            received.reply(reply)
        if run.progress.iteration != before:
            news = encode(Progress(iteration=run.progress.iteration))
            self._transport.publish(
                key_expressions.key(run.hello.run_id, key_expressions.PROGRESS), news
            )

    def _reply(self, received: ReceivedRequest, now: float) -> Message:
        """Return the reply to a request; a refused or invalid one gets a :class:`Problem`."""
        request: Any = received.request
        if isinstance(request, Malformed):
            self.run.enforcement.count_offence(request.actor, str(request.error))
            request = request.error
        if isinstance(request, InvalidData):
            if received.verb.name == verbs.EPISODE.name:
                self.run.progress.delivered += 1
                self.run.progress.rejected += 1
            log.warning("invalid %s: %s", received.verb.name, printable(request))
            return Problem(code="invalid", message=str(request)[:MAX_TEXT])
        try:
            return self._handlers[received.verb.name](request, now)
        except Refused as error:
            log.warning("refused %s: %s", received.verb.name, printable(error))
            return Problem(code=error.code, message=str(error)[:MAX_TEXT])

    def _note_presence(self, presence: Presence, now: float) -> None:
        _, _, token = key_expressions.parse(presence.key)
        _, role, name = token.split("/", 2)
        peer = role, name
        if presence.here:
            self._here.add(peer)
            log.info("%s connected", printable(f"{role} {name}"))
        else:
            self._here.discard(peer)
            self._admission.remove_service(role, name)
            log.info("%s disconnected", printable(f"{role} {name}"))

    def _wait(self, who: str, on: str, why: str, now: float) -> Wait:
        """Note that a service waits, and return the part of its reply that says so."""
        self.run.waits.begin(who, on, why, now)
        return self._pause(f"{on}: {why}")

    def _pause(self, on: str) -> Wait:
        """Return the part of a reply that says what to wait for, and when to ask again."""
        return Wait(on=on, retry_after_s=self.run.dispatcher.retry_after_s())

    # One method per verb. Each returns the reply, or raises Refused.

    def _hello(self, request: HelloRequest, now: float) -> Hello:
        return msgspec.structs.replace(self.run.hello, exact=self.run.progress.exact)

    def _join(self, request: JoinRequest, now: float) -> JoinReply:
        self._admission.join(request, now)
        where = printable(f"{request.host}, process {request.pid}, udrl {request.software}")
        log.info("%s %s joined from %s", request.role, request.id, where)
        return JoinReply()

    def _commands(self, request: CommandsRequest, now: float) -> CommandsReply:
        run, who = self.run, f"actor {request.actor}"
        if run.progress.state in ("ended", "failed"):
            return CommandsReply(ended=True)
        if request.actor in run.quarantined:
            raise run.quarantined.refusal(request.actor)
        self._admission.check("actor", request.actor)
        commands = run.assign(request, now)
        if commands:
            run.waits.end(who)
            self._note_versions_in_use(max(c.weights_version for c in commands), now)
            return CommandsReply(commands=tuple(commands))
        if request.running:
            run.waits.end(who)
            return CommandsReply(wait=self._pause("nothing: it has work"))
        return CommandsReply(wait=self._wait(who, *self._what_actors_wait_for(), now))

    def _note_versions_in_use(self, newest: int, now: float) -> None:
        """Measure the lag of the newest version in use if this is its first command."""
        if newest in self._accepted_at:
            self._lag_s = now - self._accepted_at[newest]
            self._accepted_at = {v: at for v, at in self._accepted_at.items() if v > newest}

    def _what_actors_wait_for(self) -> tuple[str, str]:
        """Return which services idle actors wait for, and why."""
        run = self.run
        version = run.awaits_version()
        if version is not None:
            trains = any(role == "learner" for role, _ in self._here)
            return "learner", f"weights version {version}" + (
                "" if trains else ": no learner is connected"
            )
        if run.progress.state == "finishing":
            return "actors", "the final evaluation"
        return "actors", f"other actors' episodes of iteration {run.progress.iteration + 1}"

    def _episode(self, arrival: Arrival, now: float) -> EpisodeReply:
        if arrival.actor not in self.run.quarantined:
            self._admission.check("actor", arrival.actor)
        result = self.run.accept(arrival, now)
        if result == "accepted":
            self._admission.note_accepted("actor", arrival.actor)
            self._throughput.add(now, arrival.entry.length)
        return EpisodeReply(result=result)

    def _failure(self, request: FailureMessage, now: float) -> Acknowledged:
        self.run.fail(request)
        return Acknowledged()

    def _changes(self, request: ChangesRequest, now: float) -> ChangesReply:
        run, who = self.run, f"learner {request.learner}"
        if run.progress.state in ("ended", "failed"):
            return ChangesReply(ended=True)
        self._admission.check("learner", request.learner)
        following = run.progress.latest_version + 1
        if request.version < following:
            raise Refused(
                "rewind",
                f"version {following} is next, not {request.version}; request the state again",
            )
        if not run.is_trainable(request.version):
            if request.version > following:  # prefetched: the version before is not delivered
                return ChangesReply(wait=self._pause("nothing"))
            here = [n for r, n in self._here if r == "actor"]
            why = f"iteration {request.version - 1}" + ("" if here else ": no actor is connected")
            if run.progress.state == "finishing":
                why = "the final evaluation"
            return ChangesReply(wait=self._wait(who, "actors", why, now))
        run.waits.end(who)
        iteration = request.version - 1
        if iteration == run.progress.iteration:
            return ChangesReply(ids=tuple(e.id for e in run.buffer))
        return ChangesReply(ids=tuple(p.entry.id for p in self._store.buffer(iteration)))

    def _episodes(self, request: EpisodesRequest, now: float) -> EpisodesReply:
        bodies = self._store.episode_bodies(request.ids, PAGE)
        if not bodies:
            raise Refused(
                "unknown_episode",
                f"episode {request.ids[0]} is not kept; request the changes again",
            )
        return EpisodesReply(episodes=tuple(bodies))

    def _version(self, delivery: _Delivery, now: float) -> VersionReply:
        learner = delivery.message.learner
        self._admission.check("learner", learner)
        result = self.run.add_version(delivery.version, delivery.message.train_s)
        if result == "accepted":
            self._admission.note_accepted("learner", learner)
            self._accepted_at[delivery.version.version] = now
        return VersionReply(result=result)

    def _state(self, request: StateRequest, now: float) -> StateReply:
        if self.run.progress.latest_version == 0:
            return StateReply(version=0)
        version = self._store.state(self.run.progress.latest_version)
        return StateReply(
            version=version.version, weights=version.weights, optimizer=version.optimizer
        )

    def _weights(self, request: WeightsRequest, now: float) -> WeightsMessage:
        wanted = self.run.progress.version_named(request.version)
        version = self._store.version(wanted)
        if version is None or not version.weights:
            kept = self._store.versions_kept()
            raise Refused(
                "unknown_version",
                f"weights version {wanted} is not kept; request one of {kept}",
            )
        return WeightsMessage(version=version.version, weights=version.weights)

    def _status(self, request: StatusRequest, now: float) -> Message:
        return status(self.run, self._throughput, self._lag_s, now)

    def _history(self, request: HistoryRequest, now: float) -> Message:
        return history(self._store, request.after)

    def _contents(self, request: ContentsRequest, now: float) -> Message:
        return contents(self.run)
