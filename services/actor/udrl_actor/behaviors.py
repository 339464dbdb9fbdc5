"""The behavior functions that an actor has, and how it gets the others."""

import logging
import threading
import time

from udrl.errors import InvalidMessage
from udrl.inference import ActingFunction
from udrl.weights import decode_behavior
from udrl_proto import verbs
from udrl_proto.asking import Asker
from udrl_proto.codec import LARGEST, decode
from udrl_proto.messages import Hello, Weights, WeightsRequest

log = logging.getLogger("udrl")

#: Seconds that the announcement of a version may come later than a command that needs it.
_ANNOUNCEMENT_S = 0.25


class Behaviors:
    """Weights versions, announced or asked for, ready to act.

    Args:
        hello: the run's specification.
        asker: the line to the replay service.
        changed: is notified when a version is announced.

    Attributes:
        newest: the greatest version that was had so far; 0: none.
    """

    def __init__(self, hello: Hello, asker: Asker, changed: threading.Condition) -> None:
        self._hello = hello
        self._asker = asker
        self._changed = changed
        self._announced: bytes | None = None
        self._kept: dict[int, ActingFunction] = {}
        self.newest = 0

    def note(self, announcement: bytes) -> None:
        """Keep the newest announcement; it also means that there are new commands."""
        with self._changed:
            self._announced = announcement
            self._changed.notify_all()

    @property
    def is_announced(self) -> bool:
        """Whether a version was announced that has not been learned."""
        return self._announced is not None

    def learn_announced(self) -> None:
        """Make the version ready that was announced last, if it has not been yet."""
        with self._changed:
            payload, self._announced = self._announced, None
        if payload is None:
            return
        try:
            self._learn(decode(payload, Weights, LARGEST))
        except InvalidMessage as error:
            log.warning("an announcement of weights was ignored: %s", error)

    def of(self, version: int) -> ActingFunction | None:
        """Return the behavior function of a version, or None for version 0, which acts at random.

        Raises:
            Refused: the version is no longer kept.
        """
        if version == 0:
            return None
        if version > self.newest:
            self._await_announcement(version)
        if version not in self._kept:
            self._learn(self._asker.ask(verbs.WEIGHTS, WeightsRequest(version=version)))
        return self._kept[version]

    def _await_announcement(self, version: int) -> None:
        """Wait a moment for weights that may be on their way, so that they travel once."""
        deadline = time.monotonic() + _ANNOUNCEMENT_S
        while self.newest < version and (left := deadline - time.monotonic()) > 0:
            with self._changed:
                self._changed.wait_for(lambda: self.is_announced, left)
            self.learn_announced()

    def _learn(self, message: Weights) -> None:
        self._kept[message.version] = decode_behavior(self._hello.graph, message.weights)
        self.newest = max(self.newest, message.version)
        # Commands of lead + 1 iterations are about, each with its own version; the oldest to have
        # been learned goes first, whatever its number, since a restored run may go back.
        while len(self._kept) > self._hello.config.lead + 2:
            del self._kept[next(iter(self._kept))]
