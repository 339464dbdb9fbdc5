"""The state of a run as read from its store, for inspection or to resume it."""

import logging
import time

from udrl.commands import Command
from udrl.config import Budget
from udrl.replay_buffer import ReplayBuffer
from udrl_proto.messages import Hello
from udrl_proto.reports import Limit
from udrl_replay.auditing import Auditor
from udrl_replay.dispatching import Dispatcher
from udrl_replay.progress import RunProgress
from udrl_replay.quarantine import Quarantine
from udrl_replay.store import Store
from udrl_replay.waits import Waits

log = logging.getLogger("udrl")


class RunState:
    """The state of a run. Creating it does not change the store.

    Args:
        store: the run's file.
        budget: the run's stopping criteria.
        audit: share of the episodes that are audited, 0 to 1.

    Attributes:
        hello: the run specification.
        progress: counters and state.
        buffer: the replay buffer after the last completed iteration.
        digests: digests of the buffer's episodes, by id.
        dispatcher: the outstanding commands and the actors.
        auditor: the open audits.
        quarantined: the quarantined actors.
        waits: the services that wait.
    """

    def __init__(self, store: Store, budget: Budget, audit: float = 0.0) -> None:
        self.store = store
        self.budget = budget
        self.hello = store.fact("hello", Hello)
        self.config = self.hello.config
        self.progress = store.fact("progress", RunProgress)
        self.dispatcher = Dispatcher()
        self.auditor = Auditor(audit)
        self.quarantined = Quarantine(store)
        self.waits = Waits()
        held = store.buffer(self.progress.iteration)
        self.buffer = ReplayBuffer(self.config.buffer, (p.entry for p in held))
        self.digests = {p.entry.id: p.digest for p in held}
        arrived = store.pending_ids()
        self.dispatcher.add(c for c in self.open_commands() if c.id not in arrived)
        self._began = time.monotonic() - self.progress.wall_s

    def open_commands(self) -> list[Command]:
        """Return the commands of iterations that are not complete, by id."""
        return self.store.commands(cancelled=False)

    @property
    def wall_s(self) -> float:
        """Running time, seconds; pauses between processes are not counted."""
        return time.monotonic() - self._began

    def limit_reached(self) -> Limit | None:
        """Return which limit of the budget is reached; None: neither."""
        wanted = self.budget.stop_return
        if (
            wanted is not None
            and (last := self.store.last_evaluation(is_final=False)) is not None
            and last.iteration == self.progress.iteration
            and last.evaluation.mean >= wanted
        ):
            return "stop_return"
        return "max_env_steps" if self.progress.env_steps >= self.budget.max_env_steps else None

    def awaits_version(self) -> int | None:
        """Return the version that can be trained now; None: its buffer is not complete."""
        version = self.progress.latest_version + 1
        return version if self.is_trainable(version) else None

    def is_trainable(self, version: int) -> bool:
        """Return whether the run needs a version and the buffer to train it on is complete."""
        needed = self.progress.state == "running" or version <= self.progress.iteration
        return needed and version <= self.progress.iteration + 1

    def mark_inexact(self, reason: str) -> None:
        """Note that the result no longer depends only on the configuration."""
        if self.progress.exact:
            log.warning("the run is no longer exact: %s", reason)
            self.progress.exact = False
            self.progress.inexact_reason = reason
