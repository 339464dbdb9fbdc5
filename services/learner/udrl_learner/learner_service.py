"""The learner service: fetch the buffer, train a version, deliver it, publish it; repeat.

While a version is trained, the previous one is delivered, and the buffer for the next one is
fetched as soon as its iteration is complete.

The learner keeps no files. When it starts, or is out of step with the replay service, it continues
from the latest version there; the trained weights are the same either way.
"""

import logging
import os
import platform
import threading
import time
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from functools import cached_property
from typing import Any, NamedTuple

from udrl.checkpoint import decode_state, encode_optimizer
from udrl.episode import Episode, fault
from udrl.errors import Interrupted, InvalidMessage, Refused
from udrl.experience import Experience
from udrl.training import TrainingState, exact_arithmetic, train, untrained
from udrl.training_class import training_class
from udrl.version import __version__
from udrl.weights import encode_weights
from udrl_proto import key_expressions, verbs
from udrl_proto.codec import LARGEST, decode, decode_episode, encode
from udrl_proto.messages import (
    ChangesRequest,
    EpisodeMessage,
    EpisodesRequest,
    Hello,
    JoinRequest,
    StateRequest,
    VersionMessage,
    WeightsMessage,
)
from udrl_proto.replay_client import ReplayClient
from udrl_proto.transport import Transport

log = logging.getLogger("udrl")

#: Maximum number of episodes in one request; the reply usually has fewer.
_EPISODES_PER_REQUEST = 10_000

#: Pauses before the restarts of a learner without progress, seconds; after the last it gives up.
_PAUSES_S = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2)

#: Longest pause between two requests for the same buffer, seconds. The replay service's
#: ``retry_after_s`` grows with the number of actors, to spread their requests. There are few
#: learners, and the run waits for them if a publication of progress is lost.
_LONGEST_WAIT_S = 1.0

#: Interval at which a wait for the buffer checks ``stop``, seconds.
_STOP_CHECK_S = 0.5


class Buffer(NamedTuple):
    """The replay buffer after an iteration.

    Attributes:
        ids: ids of its episodes, by rank.
        new: the episodes that the learner did not have yet.
    """

    ids: tuple[int, ...]
    new: list[Episode]


class LearnerService:
    """Trains one run.

    Args:
        transport: reaches the run.
        hello: the run specification.
        name: unique to this learner.
        stop: ends the service.
    """

    def __init__(
        self, transport: Transport, hello: Hello, name: str, stop: threading.Event
    ) -> None:
        self._transport = transport
        self._hello = hello
        self._config = hello.config
        self._spec = hello.environment
        self._name = name
        self._stop = stop
        self._client = ReplayClient(transport, hello.run_id, f"learner {name}", stop)
        self._progress = threading.Event()
        self._delivered = False

    @exact_arithmetic()
    def run(self) -> None:
        """Train until the run ends or ``stop`` is set.

        Raises:
            Refused: the run does not accept this learner, or restarts bring no progress.
            Unreachable: the replay service has not replied for too long.
            InvalidMessage: a reply is invalid, or has other episodes than requested.
        """
        run_id = self._hello.run_id
        declared: list[Any] = []
        try:
            self._client.request(verbs.JOIN, self._join)
            log.info("%s joined run %s (%s)", self._name, run_id, self._config.environment)
            declared += [
                self._transport.declare_presence(
                    key_expressions.alive(run_id, "learner", self._name)
                ),
                self._transport.subscribe(
                    key_expressions.key(run_id, key_expressions.PROGRESS),
                    lambda _: self._progress.set(),
                ),
            ]
            self._train_until_ended()
            log.info("learner %s: the run has ended", self._name)
        except Interrupted as interruption:
            log.info("%s", interruption)
        finally:
            for declaration in declared:
                declaration.undeclare()

    @cached_property
    def _join(self) -> JoinRequest:
        """The request to join."""
        return JoinRequest(
            role="learner",
            id=self._name,
            host=platform.node(),
            pid=os.getpid(),
            software=__version__,
            numerics_class=training_class(self._config, self._spec),
        )

    def _train_until_ended(self) -> None:
        """Train from the latest version; start over whenever the replay service expects another.

        Raises:
            Refused: there is still no progress after the last pause.
        """
        began_with, failures = -1, 0
        while True:
            state = self._latest()
            if state.version > began_with:
                failures = 0  # another learner was faster
            began_with, self._delivered = state.version, False
            refusal = self._train_from(state)
            if refusal is None:
                return
            log.warning("learner %s starts over: %s", self._name, refusal)
            failures = 0 if self._delivered else failures + 1
            if failures > len(_PAUSES_S):
                raise Refused(
                    refusal.code,
                    f"learner {self._name} failed {failures} times to train the version after "
                    f"{began_with}: {refusal}; the replay service is inconsistent: stop it and "
                    f"restart it with --resume",
                )
            if failures:
                self._stop.wait(_PAUSES_S[failures - 1])

    def _latest(self) -> TrainingState:
        """Return the state of the replay service's latest version."""
        request = StateRequest(learner=self._name)
        reply = self._client.request(verbs.STATE, request)
        if reply.version == 0:
            return untrained(self._config, self._spec)
        log.info("learner %s continues from weights version %d", self._name, reply.version)
        return decode_state(reply.version, reply.weights, reply.optimizer, self._config, self._spec)

    def _train_from(self, state: TrainingState) -> Refused | None:
        """Train version after version until the run has ended.

        Returns the refusal if the replay service expects a version other than the next one here.
        """
        experience = Experience(self._config, self._spec)
        abandoned = threading.Event()
        with ThreadPoolExecutor(2, f"learner {self._name}") as pool:
            try:
                fetched = pool.submit(self._fetch, state.version + 1, experience.ids(), abandoned)
                delivered: Future[None] | None = None
                while (buffer := self._result(fetched, delivered)) is not None:
                    self._take(experience, buffer)
                    following = state.version + 2
                    fetched = pool.submit(self._fetch, following, experience.ids(), abandoned)
                    began = time.monotonic()
                    train(state, experience.by_rank(list(buffer.ids)), self._config)
                    message = self._message(state, time.monotonic() - began)
                    if delivered is not None:
                        delivered.result()
                    delivered = pool.submit(self._deliver, message)
                if delivered is not None:
                    delivered.result()
            except Refused as refusal:
                if refusal.code not in ("rewind", "unknown_episode"):
                    raise
                return refusal
            finally:
                abandoned.set()
                self._progress.set()
            return None

    def _result(
        self, fetched: "Future[Buffer | None]", delivered: "Future[None] | None"
    ) -> Buffer | None:
        """Wait for the buffer; raise at once if the delivery fails."""
        pending: list[Future[Any]] = [fetched] if delivered is None else [fetched, delivered]
        while not fetched.done() and not self._stop.is_set():
            wait(pending, _STOP_CHECK_S, FIRST_COMPLETED)
            if delivered is not None and delivered.done():
                delivered.result()
                pending = [fetched]
        if self._stop.is_set():
            self._progress.set()  # the next request raises
        return fetched.result()

    def _take(self, experience: Experience, buffer: Buffer) -> None:
        """Update ``experience`` to the episodes of the buffer."""
        for gone in experience.ids() - set(buffer.ids):
            experience.remove(gone)
        for episode in buffer.new:
            experience.add(episode)

    def _message(self, state: TrainingState, train_s: float) -> VersionMessage:
        return VersionMessage(
            learner=self._name,
            version=state.version,
            weights=encode_weights(state.weights),
            optimizer=encode_optimizer(state),
            loss=state.loss,
            train_s=train_s,
        )

    # Called in threads, in parallel with training.

    def _fetch(self, version: int, held: set[int], abandoned: threading.Event) -> Buffer | None:
        """Wait for the buffer that a version is trained on; None: the run or the wait has ended.

        Args:
            version: the version to train.
            held: ids of episodes that need not be fetched.
            abandoned: set when the buffer is no longer needed; ends the wait.
        """
        while not abandoned.is_set():
            self._progress.clear()
            request = ChangesRequest(learner=self._name, version=version)
            changes = self._client.request_joined(verbs.CHANGES, request, self._join)
            if changes.ended:
                break
            if changes.wait is None:
                return Buffer(
                    changes.ids, self._episodes([i for i in changes.ids if i not in held])
                )
            self._progress.wait(min(changes.wait.retry_after_s, _LONGEST_WAIT_S))
        return None

    def _episodes(self, missing: list[int]) -> list[Episode]:
        """Request episodes, page by page."""
        episodes: list[Episode] = []
        while left := missing[len(episodes) :]:
            requested = left[:_EPISODES_PER_REQUEST]
            page = self._client.request(verbs.EPISODES, EpisodesRequest(ids=tuple(requested)))
            if len(page.episodes) > len(requested):
                raise _wrong(f"{len(page.episodes)} episodes, expected at most {len(requested)}")
            pairs = zip(page.episodes, requested, strict=False)
            episodes += [self._decode(body, expected) for body, expected in pairs]
        return episodes

    def _decode(self, body: bytes, expected: int) -> Episode:
        """Return the episode in a reply, which must be the one that was requested."""
        message = decode(body, EpisodeMessage, LARGEST)
        episode = decode_episode(message, self._spec.observation_space)
        if episode.command_id != expected:
            raise _wrong(f"episode {episode.command_id}, expected episode {expected}")
        if found := fault(episode, self._spec):
            raise _wrong(f"an invalid episode {expected} ({found})")
        return episode

    def _deliver(self, message: VersionMessage) -> None:
        """Deliver a version, and publish its weights when the replay service has stored them."""
        self._client.request_joined(verbs.VERSION, message, self._join)
        self._delivered = True
        # Without acknowledgement, so that a stopped actor cannot stall training. An actor that
        # misses this requests the weights from the replay service.
        announcement = encode(WeightsMessage(version=message.version, weights=message.weights))
        self._transport.publish(
            key_expressions.key(self._hello.run_id, key_expressions.NEW_WEIGHTS), announcement
        )


def _wrong(received: str) -> InvalidMessage:
    return InvalidMessage(
        f"the replay service replied with {received}; stop it and restart it with --resume, with "
        f"the learner's version of udrl"
    )
