"""The state and counters of a run, apart from its episodes, commands and weights."""

from typing import Literal

import msgspec

from udrl_proto.messages import MAX_TEXT

State = Literal["running", "finishing", "ended", "failed"]

#: Reasons why no process is running a run that has not ended.
STOPPED = "stopped on request"
KILLED = "stopped without notice: its replay service failed or was killed, or its machine went down"


class RunProgress(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """One fact of the store, written at the end of every transaction that changes it.

    Attributes:
        state: ``running`` up to the last iteration N; ``finishing`` while the weights of version N
            are trained and evaluated; then ``ended``. ``failed``: a command failed too often, or
            an actor delivered a false episode.
        iteration: last completed iteration; -1: the warm-up is not complete.
        env_steps: steps of the warm-up and exploratory episodes of completed iterations.
        eval_env_steps: steps of the evaluation episodes, those of the final evaluation included.
        issued, accepted, cancelled: the ledger of commands, without the outstanding ones.
        delivered, duplicate, rejected: the ledger of episodes, together with ``accepted``.
        env_failures: number of failures that actors reported.
        wall_s: running time until this was written, seconds; pauses are not counted.
        latest_version: newest weights version; 0: none yet.
        best_version: version with the best evaluation; 0: none yet.
        best_mean: mean return of that evaluation; None: none yet.
        exact: whether the result still depends only on the configuration.
        inexact_reason: why it does not; empty if it does.
        problem: why the run failed.
        ended_because: why the run ended, or :data:`STOPPED`.
        deceived: whether the run failed because it learned from episodes of an actor that
            delivered false ones; it cannot be resumed.
        audit: share of the episodes that are audited.
        agreed: number of audits in which both episodes were equal.
    """

    state: State = "running"
    iteration: int = -1
    env_steps: int = 0
    eval_env_steps: int = 0
    issued: int = 0
    accepted: int = 0
    cancelled: int = 0
    delivered: int = 0
    duplicate: int = 0
    rejected: int = 0
    env_failures: int = 0
    wall_s: float = 0.0
    latest_version: int = 0
    best_version: int = 0
    best_mean: float | None = None
    exact: bool = True
    inexact_reason: str = ""
    problem: str = ""
    ended_because: str = ""
    deceived: bool = False
    audit: float = 0.0
    agreed: int = 0

    def version_named(self, wanted: int | Literal["latest", "best"]) -> int:
        """Return a weights version by its name or number; 0: there is none yet."""
        if isinstance(wanted, int):
            return wanted
        return self.latest_version if wanted == "latest" else self.best_version

    def why_ended(self) -> str:
        """Return why the run ended; empty: it has not."""
        if self.state == "failed":
            return f"failed: {self.problem}"[:MAX_TEXT]
        return self.ended_because

    def why_stopped(self) -> str:
        """Return why no process is running the run, although it has not ended."""
        return STOPPED if self.ended_because == STOPPED else KILLED
