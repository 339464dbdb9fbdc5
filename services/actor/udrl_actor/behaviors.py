"""The behavior functions of an actor, received by publication or on request."""

import logging
import threading
import time

from udrl.errors import InvalidData
from udrl.inference import ActingFunction
from udrl.weights import decode_behavior
from udrl_proto import verbs
from udrl_proto.codec import LARGEST, decode
from udrl_proto.messages import Hello, WeightsMessage, WeightsRequest
from udrl_proto.replay_client import ReplayClient

log = logging.getLogger("udrl")

#: Seconds to wait for the publication of a version that a command needs, before requesting it.
_ANNOUNCEMENT_S = 0.25


class Behaviors:
    """Keeps the behavior functions of recent weights versions.

    Args:
        hello: the run specification.
        client: sends requests to the replay service.
        changed: notified when a version is published.

    Attributes:
        newest: greatest version decoded so far; 0: none.
    """

    def __init__(self, hello: Hello, client: ReplayClient, changed: threading.Condition) -> None:
        self._hello = hello
        self._client = client
        self._changed = changed
        self._announced: bytes | None = None
        self._kept: dict[int, ActingFunction] = {}
        self.newest = 0

    def note(self, announcement: bytes) -> None:
        """Keep a published version; its arrival also means that there may be new commands."""
        with self._changed:
            self._announced = announcement
            self._changed.notify_all()

    @property
    def is_announced(self) -> bool:
        """Whether a published version has not been decoded yet."""
        return self._announced is not None

    def decode_announced(self) -> None:
        """Decode the version published last, unless that is done."""
        with self._changed:
            payload, self._announced = self._announced, None
        if payload is None:
            return
        try:
            self._decode(decode(payload, WeightsMessage, LARGEST))
        except InvalidData as error:
            log.warning("an announcement of weights was ignored: %s", error)

    def of(self, version: int) -> ActingFunction | None:
        """Return the behavior function of a version, or None for version 0, random actions.

        Raises:
            Refused: the version is no longer kept.
        """
        if version == 0:
            return None
        if version > self.newest:
            self._await_announcement(version)
        if version not in self._kept:
            self._decode(self._client.request(verbs.WEIGHTS, WeightsRequest(version=version)))
        return self._kept[version]

    def _await_announcement(self, version: int) -> None:
        """Wait briefly for weights that may be on their way, so that they are sent only once."""
        deadline = time.monotonic() + _ANNOUNCEMENT_S
        while self.newest < version and (left := deadline - time.monotonic()) > 0:
            with self._changed:
                self._changed.wait_for(lambda: self.is_announced, left)
            self.decode_announced()

    def _decode(self, message: WeightsMessage) -> None:
        self._kept[message.version] = decode_behavior(self._hello.graph, message.weights)
        self.newest = max(self.newest, message.version)
        # Commands of lead + 1 iterations are outstanding, each with its own version. Discard in
        # order of arrival, not of version: a restored run may go back to earlier versions.
        while len(self._kept) > self._hello.config.lead + 2:
            del self._kept[next(iter(self._kept))]
