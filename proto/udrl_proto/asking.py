"""Asking a run's replay service: at least once, until it answers or patience ends.

A query that stays empty or times out is asked again, since every request may be repeated without
harm. Nothing waits without a deadline, and a wait that gets long is logged: who waits for what.
"""

import logging
import threading
import time

import zenoh

from udrl.errors import Interrupted, Refused, Unreachable
from udrl_proto import keys
from udrl_proto.codec import decode, encode
from udrl_proto.messages import Problem
from udrl_proto.verbs import Reply, Request, Verb

log = logging.getLogger("udrl")

#: Seconds that one query may take before it is asked again, at first and at last: twice as long
#: each time, so that what answers slowly is not given ever more to do.
ATTEMPT_S, LONGEST_ATTEMPT_S = 3.0, 30.0
#: Seconds that a service goes on asking a replay service that does not answer.
PATIENCE_S = 300.0


class Asker:
    """One service's line to the replay service of a run.

    Args:
        session: connected to the run's router.
        run_id: the run.
        who: the asking service, for the log.
        stop: ends every wait.
        patience_s: seconds after which a question is given up.
    """

    def __init__(
        self,
        session: zenoh.Session,
        run_id: str,
        who: str,
        stop: threading.Event | None = None,
        patience_s: float = PATIENCE_S,
    ) -> None:
        self._session = session
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
            replies = self._session.get(
                keys.key(self._run_id, verb.name),
                payload=payload,
                timeout=attempt_s,
                consolidation=zenoh.ConsolidationMode.NONE,
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
            for reply in replies:
                if reply.ok is not None:
                    return decode(reply.ok.payload.to_bytes(), verb.reply, verb.reply_limit)
                if reply.err is not None and (problem := _problem(reply.err)) is not None:
                    raise Refused(problem.code, problem.message)
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


def _problem(error: zenoh.ReplyError) -> Problem | None:
    """Return our own error reply; None for Zenoh's, e.g. a timeout, after which we ask again."""
    data = error.payload.to_bytes()
    if data == b"Timeout" or error.encoding != zenoh.Encoding.APPLICATION_OCTET_STREAM:
        return None
    return decode(data, Problem)
