"""The learner service: ask for the buffer, train a version, deliver it, announce it; again.

It keeps no files. A learner that starts, or that finds itself out of step with the replay service,
takes the latest version from there and goes on; what it trains is the same either way.
"""

import logging
import os
import platform
import threading
import time
from typing import Any

import zenoh

import udrl
from udrl.checkpoint import decode_state, encode_optimizer
from udrl.errors import Interrupted, Refused
from udrl.segments import Experience
from udrl.training import TrainingState, train, untrained, use_one_thread
from udrl.training_class import training_class
from udrl.weights import encode_weights
from udrl_proto import keys
from udrl_proto.asking import Asker
from udrl_proto.codec import LARGEST, decode, decode_episode, encode
from udrl_proto.messages import (
    ChangesReply,
    ChangesRequest,
    EpisodeMessage,
    EpisodesReply,
    EpisodesRequest,
    Hello,
    JoinReply,
    JoinRequest,
    StateReply,
    StateRequest,
    VersionMessage,
    VersionReply,
    Weights,
)

log = logging.getLogger("udrl")

#: Episodes that are asked for at once; a page holds fewer, usually.
_ASK_FOR = 10_000


class LearnerService:
    """Trains one run.

    Args:
        session: connected to the run's router.
        hello: the run's specification.
        name: unique to this learner.
        stop: ends everything.
    """

    def __init__(
        self, session: zenoh.Session, hello: Hello, name: str, stop: threading.Event
    ) -> None:
        self._session = session
        self._hello = hello
        self._config = hello.config
        self._spec = hello.environment
        self._name = name
        self._stop = stop
        self._asker = Asker(session, hello.run_id, f"learner {name}", stop)
        self._progress = threading.Event()

    def run(self) -> None:
        """Train until the run ends or ``stop`` is set.

        Raises:
            Refused: the run does not want this learner.
            Unreachable: the replay service has not answered for long.
        """
        use_one_thread()
        run_id = self._hello.run_id
        declared: list[Any] = []
        try:
            self._join()
            declared += [
                self._session.liveliness().declare_token(keys.alive(run_id, "learner", self._name)),
                self._session.declare_subscriber(
                    keys.key(run_id, keys.PROGRESS), lambda _: self._progress.set()
                ),
            ]
            ended = False
            while not ended:
                ended = self._train_from(self._latest())
            log.info("learner %s: the run has ended", self._name)
        except Interrupted as interruption:
            log.info("%s", interruption)
        finally:
            for declaration in declared:
                declaration.undeclare()

    def _join(self) -> None:
        request = JoinRequest(
            role="learner",
            id=self._name,
            host=platform.node(),
            pid=os.getpid(),
            software=udrl.__version__,
            numerics_class=training_class(self._config, self._spec),
        )
        self._asker.ask(keys.JOIN, request, JoinReply)

    def _latest(self) -> TrainingState:
        """Return the state to go on from: the replay service's latest version."""
        request = StateRequest(learner=self._name)
        reply = self._asker.ask(keys.STATE, request, StateReply, LARGEST)
        if reply.version == 0:
            return untrained(self._config, self._spec)
        log.info("learner %s goes on from weights version %d", self._name, reply.version)
        return decode_state(reply.version, reply.weights, reply.optimizer, self._config, self._spec)

    def _train_from(self, state: TrainingState) -> bool:
        """Train version after version; return whether the run has ended.

        False means: the replay service expects another version than the next one here.
        """
        experience = Experience(self._config, self._spec)
        while True:
            self._progress.clear()
            request = ChangesRequest(learner=self._name, version=state.version + 1)
            try:
                changes = self._asker.ask(keys.CHANGES, request, ChangesReply, LARGEST)
                if changes.ended:
                    return True
                if changes.wait is not None:
                    self._progress.wait(changes.wait.retry_after_s)
                    continue
                self._catch_up(experience, changes.ids)
                began = time.monotonic()
                train(state, experience.by_rank(list(changes.ids)), self._config)
                self._deliver(state, time.monotonic() - began)
            except Refused as refusal:
                if refusal.code not in ("rewind", "unknown_episode"):
                    raise
                log.warning("learner %s starts over: %s", self._name, refusal)
                return False

    def _catch_up(self, experience: Experience, ids: tuple[int, ...]) -> None:
        """Make ``experience`` hold exactly the episodes of the buffer."""
        held = experience.ids()
        for gone in held - set(ids):
            experience.remove(gone)
        missing = [i for i in ids if i not in held]
        while missing:
            request = EpisodesRequest(ids=tuple(missing[:_ASK_FOR]))
            page = self._asker.ask(keys.EPISODES, request, EpisodesReply, LARGEST)
            for body in page.episodes:
                episode = decode_episode(decode(body, EpisodeMessage, LARGEST))
                experience.add(episode)
            missing = missing[len(page.episodes) :]

    def _deliver(self, state: TrainingState, train_s: float) -> None:
        weights = encode_weights(state.weights)
        message = VersionMessage(
            learner=self._name,
            version=state.version,
            weights=weights,
            optimizer=encode_optimizer(state),
            loss=state.loss,
            train_s=train_s,
        )
        self._asker.ask(keys.VERSION, message, VersionReply)
        # DROP, Zenoh's default: one stopped actor must not stall training, and whoever misses
        # this asks the replay service.
        announcement = encode(Weights(version=state.version, weights=weights))
        self._session.put(keys.key(self._hello.run_id, keys.NEW_WEIGHTS), announcement)
