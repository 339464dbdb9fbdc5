"""What an actor has made and the replay service has not acknowledged, on several lines at once.

With one line the next episode would wait for the answer to the last: on a way of 20 ms, there and
back, fifty a second. Large episodes go one after another all the same, since they fill a slow
link, and an answer that is late is asked for again.
"""

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable

from udrl.acting import Failure
from udrl.episode import Episode
from udrl.errors import Refused
from udrl_proto import verbs
from udrl_proto.asking import Asker
from udrl_proto.codec import encode_episode
from udrl_proto.messages import FailureMessage, JoinRequest

log = logging.getLogger("udrl")

_LINES = 8
#: Bytes of observations that may be under way together; a larger episode is under way alone.
_BYTES_UNDER_WAY = 256 * 1024
#: Seconds after which a line looks whether it was closed meanwhile.
_LOOK_S = 0.5


def deliver(asker: Asker, join: JoinRequest, outcome: Episode | Failure) -> int:
    """Deliver what came of a command; return the command's id when that is acknowledged.

    Args:
        asker: the actor's line to the replay service.
        join: who the actor is.
        outcome: of the command.

    Raises:
        Refused: the replay service cannot read it, so it could not read the next one either.
        Unreachable: nobody has answered for long.
    """
    if isinstance(outcome, Failure):
        command_id = outcome.command.id
        error = str(outcome.error)[:4000]
        failure = FailureMessage(actor=join.id, command_id=command_id, error=error)
        asker.ask(verbs.FAILURE, failure)
        return command_id
    try:
        asker.ask_joined(verbs.EPISODE, encode_episode(outcome, join.id), join)
    except Refused as refusal:
        if refusal.code != "rejected":
            raise
        # Cancelled: the run has ended meanwhile.
        log.info("episode %d was rejected: %s", outcome.command_id, refusal)
    return outcome.command_id


class Outbox:
    """Delivers in threads of its own, in no certain order.

    Args:
        name: whose it is.
        deliver: returns when an outcome is acknowledged.
        failed: is told of what ``deliver`` raises, which ends that line.
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
        self._under_way = 0
        self._bytes = 0
        self._closed = False
        for line in range(_LINES):
            threading.Thread(target=self._work, name=f"{name}, line {line}", daemon=True).start()

    def __len__(self) -> int:
        """Return how many are not acknowledged."""
        return len(self._waiting) + self._under_way

    def put(self, outcomes: Iterable[Episode | Failure]) -> None:
        """Have outcomes delivered."""
        with self._changed:
            before = len(self._waiting)
            self._waiting.extend(outcomes)
            self._changed.notify(len(self._waiting) - before)

    def close(self) -> None:
        """Begin no more deliveries; what is under way is not waited for."""
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
                self._under_way -= 1
                self._bytes -= _size(outcome)
                self._changed.notify(len(self._waiting))

    def _next(self) -> Episode | Failure | None:
        """Return the next to deliver when there is room on the way; None: closed."""
        with self._changed:
            while not self._closed:
                if self._waiting:
                    together = self._bytes + _size(self._waiting[0])
                    if not self._under_way or together <= _BYTES_UNDER_WAY:
                        outcome = self._waiting.popleft()
                        self._under_way += 1
                        self._bytes = together
                        return outcome
                self._changed.wait(_LOOK_S)
            return None


def _size(outcome: Episode | Failure) -> int:
    return outcome.observations.nbytes if isinstance(outcome, Episode) else 0
