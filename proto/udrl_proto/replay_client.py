"""Requests to a run's replay service, with at-least-once delivery and a deadline.

A query without a reply is retried, since every request is harmless to repeat. Long waits are
logged.
"""

import logging
import threading
import time

from udrl.errors import Interrupted, Refused, Unreachable
from udrl_proto import key_expressions
from udrl_proto.codec import decode, encode
from udrl_proto.messages import JoinRequest, Problem
from udrl_proto.text import printable
from udrl_proto.transport import Transport
from udrl_proto.verbs import JOIN, Reply, Request, Verb

log = logging.getLogger("udrl")

#: Timeout of the first query and the longest timeout, seconds. It doubles after every timeout, so
#: that retries do not overload a slow service.
ATTEMPT_S, LONGEST_ATTEMPT_S = 3.0, 30.0
#: Seconds that a service retries a request without a reply.
PATIENCE_S = 300.0
#: Maximum number of times that a service rejoins for one request before it raises the refusal.
_JOINS = 5


class ReplayClient:
    """Sends one service's requests to the replay service of a run.

    Args:
        transport: reaches the replay service.
        run_id: the run.
        who: name of the requesting service, for the log.
        stop: ends every wait.
        patience_s: deadline of a request, seconds.
    """

    def __init__(
        self,
        transport: Transport,
        run_id: str,
        who: str,
        stop: threading.Event | None = None,
        patience_s: float = PATIENCE_S,
    ) -> None:
        self._transport = transport
        self._run_id = run_id
        self._who = who
        self._stop = stop or threading.Event()
        self._patience_s = patience_s

    def request(self, verb: Verb[Request, Reply], request: Request | bytes) -> Reply:
        """Send a request and return the reply.

        Args:
            verb: the kind of request.
            request: its message, encoded or not.

        Raises:
            Refused: the request is refused.
            Unreachable: there is no reply within ``patience_s``.
            InvalidMessage: the reply is not a valid message of its kind.
            Interrupted: the service is being stopped.
        """
        payload = request if isinstance(request, bytes) else encode(request)
        began = time.monotonic()
        pause, attempt_s = 0.02, ATTEMPT_S
        warn_at = 2.0
        while not self._stop.is_set():
            sent = time.monotonic()
            key = key_expressions.key(self._run_id, verb.name)
            for reply in self._transport.query(key, payload, attempt_s):
                if reply.is_problem:
                    problem = decode(reply.data, Problem)
                    raise Refused(problem.code, printable(problem.message))
                return decode(reply.data, verb.reply, verb.reply_limit)
            now = time.monotonic()
            if now - sent >= attempt_s:
                attempt_s = min(2 * attempt_s, LONGEST_ATTEMPT_S)
            waited = now - began
            if waited >= self._patience_s:
                raise Unreachable(
                    f"{self._who} got no reply to {verb.name!r} from the replay service of "
                    f"{self._run_id} in {waited:.0f} s; restart that service, or check the network"
                )
            if waited >= warn_at:
                log.warning(
                    "%s has been waiting %.0f s for the replay service to reply to %r",
                    self._who, waited, verb.name,
                )  # fmt: skip
                warn_at *= 2
            self._stop.wait(pause)
            pause = min(2 * pause, 1.0)
        raise Interrupted(f"{self._who} was stopped while waiting for {verb.name!r}")

    def request_joined(
        self, verb: Verb[Request, Reply], request: Request | bytes, join: JoinRequest
    ) -> Reply:
        """Send a request like :meth:`request`; rejoin if the replay service was restarted.

        Args:
            verb: the kind of request.
            request: its message, encoded or not.
            join: the request to join with.

        Raises:
            UdrlError: see :meth:`request`.
        """
        for _ in range(_JOINS):
            try:
                return self.request(verb, request)
            except Refused as refusal:
                if refusal.code != "join_first":
                    raise
            self.request(JOIN, join)
        return self.request(verb, request)
