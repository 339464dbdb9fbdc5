"""A thread of the actor that fetches commands and the weights that they name.

The loop that steps environments never waits for the network while it has commands to run.
"""

import logging
import os
import threading
import time
from collections import deque
from typing import NamedTuple

from udrl.commands import Command
from udrl.errors import Refused
from udrl.inference import ActingFunction
from udrl_actor.behaviors import Behaviors
from udrl_proto import key_expressions, verbs
from udrl_proto.messages import (
    CommandsRequest,
    Hello,
    JoinRequest,
)
from udrl_proto.replay_client import ReplayClient
from udrl_proto.transport import Transport

log = logging.getLogger("udrl")


class Assignment(NamedTuple):
    """A command and the behavior function to run it with; None: random actions."""

    command: Command
    behavior: ActingFunction | None


class CommandFetcher(threading.Thread):
    """Fetches one actor's commands from the replay service.

    Args:
        transport: reaches the run.
        hello: the run specification.
        join: the actor's request to join.
        client: sends the actor's requests to the replay service.
        stop: ends the thread.
    """

    def __init__(
        self,
        transport: Transport,
        hello: Hello,
        join: JoinRequest,
        client: ReplayClient,
        stop: threading.Event,
    ) -> None:
        super().__init__(name=f"command fetcher of {join.id}", daemon=True)
        self._transport = transport
        self._hello = hello
        self._join = join
        self._client = client
        self._stop_event = stop
        self._changed = threading.Condition()
        self._assignments: deque[Assignment] = deque()
        self._held: set[int] = set()  # ids of commands without an acknowledged outcome
        self._free = 0  # idle environments
        self._steps = 0  # env steps since the last rate was computed
        self._acknowledged = False  # whether an outcome was acknowledged since the last request
        self._behaviors = Behaviors(hello, client, self._changed)
        self.ended = False
        self.error: Exception | None = None

    # Called by the loop that steps environments.

    def take(self, free: int, steps: int, *, wait_s: float) -> list[Assignment]:
        """Return and remove assignments for idle environments.

        Args:
            free: number of idle environments.
            steps: env steps made since the last call.
            wait_s: seconds to wait if there are no assignments.
        """
        with self._changed:
            self._free = free
            self._steps += steps
            self._changed.notify_all()
            if not self._assignments and wait_s and self._alive():
                self._changed.wait(wait_s)
            assignments = [
                self._assignments.popleft() for _ in range(min(free, len(self._assignments)))
            ]
            self._free -= len(assignments)
            return assignments

    @property
    def has_assignments(self) -> bool:
        """Whether :meth:`take` would return assignments at once."""
        return bool(self._assignments)

    # Called by the threads of the outbox.

    def note_acknowledged(self, command_id: int) -> None:
        """Note that a command's outcome is acknowledged; there may be new commands."""
        with self._changed:
            self._held.discard(command_id)
            self._acknowledged = True
            self._changed.notify_all()

    def fail(self, error: Exception) -> None:
        """Make the loop that steps environments raise an error."""
        with self._changed:
            self.error = error
            self._changed.notify_all()

    def _alive(self) -> bool:
        return not (self.ended or self._stop_event.is_set() or self.error is not None)

    # The fetcher's own thread.

    def run(self) -> None:
        """Fetch until the run ends, ``stop`` is set, or the replay service refuses."""
        key = key_expressions.key(self._hello.run_id, key_expressions.NEW_WEIGHTS)
        try:
            subscriber = self._transport.subscribe(key, self._behaviors.note)
            try:
                self._work()
            finally:
                subscriber.undeclare()
        except Exception as error:  # noqa: BLE001 - raised by the loop that steps environments
            self.fail(error)
        finally:
            with self._changed:
                self._changed.notify_all()

    def _work(self) -> None:
        request_at = 0.0
        rate_at, rate = time.monotonic(), 0.0
        while self._alive():
            with self._changed:
                wants = self._free > len(self._assignments)
                pause = request_at - time.monotonic() if wants else 0.5
                if pause > 0 and not (wants and self._has_news):
                    self._changed.wait(min(pause, 0.5))
                if self._has_news:
                    request_at, self._acknowledged = 0.0, False
                wanted = self._free - len(self._assignments)
            if wanted > 0 and time.monotonic() >= request_at:
                now = time.monotonic()
                if now - rate_at >= 1.0:
                    with self._changed:
                        rate, self._steps = self._steps / (now - rate_at), 0
                    rate_at = now
                request_at = self._fetch(wanted, rate)

    @property
    def _has_news(self) -> bool:
        """Whether there may be new commands since the last request."""
        return self._behaviors.is_announced or self._acknowledged

    def _fetch(self, wanted: int, rate: float) -> float:
        """Request commands; return the earliest time of the next request."""
        self._behaviors.decode_announced()
        with self._changed:
            running = tuple(sorted(self._held))
        request = CommandsRequest(
            actor=self._join.id,
            wanted=wanted,
            running=running,
            spare_cores=(os.cpu_count() or 1) - os.getloadavg()[0],
            env_steps_per_s=round(rate, 1),
            weights_version=self._behaviors.newest,
        )
        reply = self._client.request_joined(verbs.COMMANDS, request, self._join)
        if reply.ended:
            self.ended = True
        with self._changed:
            self._held |= {command.id for command in reply.commands}
        assignments = [
            assignment for c in reply.commands if (assignment := self._assignment(c)) is not None
        ]
        with self._changed:
            self._assignments.extend(assignments)
            self._changed.notify_all()
        return time.monotonic() + (reply.wait.retry_after_s if reply.wait else 0.0)

    def _assignment(self, command: Command) -> Assignment | None:
        """Return a command with its weights; None if they are gone, so it is no longer needed."""
        try:
            return Assignment(command, self._behaviors.of(command.weights_version))
        except Refused as refusal:
            if refusal.code != "unknown_version":
                raise
            log.info("command %d is discarded: %s", command.id, refusal)
            with self._changed:
                self._held.discard(command.id)
            return None
