"""Asking a run's replay service: at least once, until it answers or patience ends.

A query that stays empty or times out is asked again, since every request may be repeated without
harm. Nothing waits without a deadline, and a wait that gets long is logged: who waits for what.
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

#: Seconds that one query may take before it is asked again, at first and at last: twice as long
#: each time, so that what answers slowly is not given ever more to do.
ATTEMPT_S, LONGEST_ATTEMPT_S = 3.0, 30.0
#: Seconds that a service goes on asking a replay service that does not answer.
PATIENCE_S = 300.0
#: Times that a service joins again for one question; more often nobody forgets it by chance.
_JOINS = 5


class Asker:
    """One service's line to the replay service of a run.

    Args:
        transport: reaches the replay service.
        run_id: the run.
        who: the asking service, for the log.
        stop: ends every wait.
        patience_s: seconds after which a question is given up.
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

    def ask(self, verb: Verb[Request, Reply], request: Request | bytes) -> Reply:
        """Return the answer to a request.

        Args:
            verb: what is asked.
            request: its message, encoded or not.

        Raises:
            Refused: the answer is no.
            Unreachable: no answer within the patience.
            InvalidMessage: the answer is not of that kind.
            Interrupted: the service is being stopped.
        """
        payload = request if isinstance(request, bytes) else encode(request)
        began = time.monotonic()
        pause, attempt_s = 0.02, ATTEMPT_S
        warn_at = 2.0
        while not self._stop.is_set():
            asked = time.monotonic()
            key = key_expressions.key(self._run_id, verb.name)
            for answer in self._transport.ask(key, payload, attempt_s):
                if answer.is_problem:
                    problem = decode(answer.data, Problem)
                    raise Refused(problem.code, printable(problem.message))
                return decode(answer.data, verb.reply, verb.reply_limit)
            now = time.monotonic()
            if now - asked >= attempt_s:
                attempt_s = min(2 * attempt_s, LONGEST_ATTEMPT_S)
            waited = now - began
            if waited >= self._patience_s:
                raise Unreachable(
                    f"{self._who} asked the replay service of {self._run_id} for {verb.name!r} and "
                    f"got no answer in {waited:.0f} s; is it running and reachable?"
                )
            if waited >= warn_at:
                log.warning(
                    "%s has been waiting %.0f s for the replay service to answer %r",
                    self._who, waited, verb.name,
                )  # fmt: skip
                warn_at *= 2
            self._stop.wait(pause)
            pause = min(2 * pause, 1.0)
        raise Interrupted(f"{self._who} was stopped while asking for {verb.name!r}")

    def ask_joined(
        self, verb: Verb[Request, Reply], request: Request | bytes, join: JoinRequest
    ) -> Reply:
        """Ask as :meth:`ask` does, and join again where the replay service was started again."""
        for _ in range(_JOINS):
            try:
                return self.ask(verb, request)
            except Refused as refusal:
                if refusal.code != "join_first":
                    raise
            self.ask(JOIN, join)
        return self.ask(verb, request)
