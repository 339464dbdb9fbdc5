"""Delivers an actor's outcomes with several threads until the replay service acknowledges them.

A single thread would wait for each reply before the next episode: with a round-trip time of 20 ms,
fifty episodes a second. Large episodes are still sent one at a time, since in parallel they would
delay each other's replies on a slow link until requests time out and are sent again.
"""

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable

from udrl.acting import Failure
from udrl.episode import Episode
from udrl.errors import Refused
from udrl_proto import verbs
from udrl_proto.codec import encode_episode
from udrl_proto.messages import MAX_TEXT, FailureMessage, JoinRequest
from udrl_proto.replay_client import ReplayClient

log = logging.getLogger("udrl")

#: Number of threads, each with one delivery in transit.
_THREADS = 8
#: Maximum size of observations in transit, in bytes; a larger episode is sent alone.
_BYTES_IN_TRANSIT = 256 * 1024
#: Interval at which a waiting thread checks whether the outbox is closed, seconds.
_CLOSED_CHECK_S = 0.5


def deliver(client: ReplayClient, join: JoinRequest, outcome: Episode | Failure) -> int:
    """Deliver the outcome of a command; return the command's id when that is acknowledged.

    Args:
        client: sends the actor's requests to the replay service.
        join: the actor's request to join.
        outcome: the command's episode or failure.

    Raises:
        Refused: the replay service refuses the actor or cannot read its messages.
        Unreachable: the replay service has not replied for too long.
    """
    if isinstance(outcome, Failure):
        command_id = outcome.command.id
        error = str(outcome.error)[:MAX_TEXT]
        failure = FailureMessage(actor=join.id, command_id=command_id, error=error)
        client.request(verbs.FAILURE, failure)
        return command_id
    try:
        client.request_joined(verbs.EPISODE, encode_episode(outcome, join.id), join)
    except Refused as refusal:
        if refusal.code != "rejected":
            raise
        # The command was cancelled, because the run has ended.
        log.info("episode %d was rejected: %s", outcome.command_id, refusal)
    return outcome.command_id


class Outbox:
    """Delivers outcomes in its own threads, in no particular order.

    Args:
        name: prefix of the threads' names.
        deliver: returns when an outcome is acknowledged.
        failed: called with an exception of ``deliver``, which ends that thread.
    """

    def __init__(
        self,
        name: str,
        deliver: Callable[[Episode | Failure], None],
        failed: Callable[[Exception], None],
    ) -> None:
        self._deliver = deliver
        self._failed = failed
        self._changed = threading.Condition()
        self._waiting: deque[Episode | Failure] = deque()
        self._in_transit = 0
        self._bytes = 0
        self._closed = False
        for i in range(_THREADS):
            threading.Thread(target=self._work, name=f"{name}, {i}", daemon=True).start()

    def __len__(self) -> int:
        """Return the number of outcomes that are not acknowledged."""
        return len(self._waiting) + self._in_transit

    def put(self, outcomes: Iterable[Episode | Failure]) -> None:
        """Queue outcomes for delivery."""
        with self._changed:
            before = len(self._waiting)
            self._waiting.extend(outcomes)
            self._changed.notify(len(self._waiting) - before)

    def close(self) -> None:
        """Start no more deliveries; those in transit are not waited for."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _work(self) -> None:
        while (outcome := self._next()) is not None:
            try:
                self._deliver(outcome)
            except Exception as error:  # noqa: BLE001 - raised by the loop that steps environments
                self._failed(error)
                return
            with self._changed:
                self._in_transit -= 1
                self._bytes -= _size(outcome)
                self._changed.notify(len(self._waiting))

    def _next(self) -> Episode | Failure | None:
        """Wait for the next outcome that may be sent and return it; None: closed."""
        with self._changed:
            while not self._closed:
                if self._waiting:
                    together = self._bytes + _size(self._waiting[0])
                    if not self._in_transit or together <= _BYTES_IN_TRANSIT:
                        outcome = self._waiting.popleft()
                        self._in_transit += 1
                        self._bytes = together
                        return outcome
                self._changed.wait(_CLOSED_CHECK_S)
            return None


def _size(outcome: Episode | Failure) -> int:
    return outcome.observations.nbytes if isinstance(outcome, Episode) else 0
