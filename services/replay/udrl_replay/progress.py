"""Where a run stands, apart from its episodes, commands and weights."""

from typing import Literal

import msgspec

State = Literal["running", "closing", "ended", "failed"]

#: Why nobody works on a run: its service was told to end, or could not say that it would.
STOPPED = "stopped on request"
KILLED = "stopped without notice: its replay service was killed, or its machine went down"


class RunProgress(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """What the store keeps as one fact, written at the end of every transaction that changed it.

    Attributes:
        state: ``running`` up to the last iteration N; ``closing`` while N's final weights are
            awaited and evaluated; then ``ended``. ``failed``: a command cannot be carried out.
        iteration: the last one completed; -1 before the warm-up is.
        env_steps: of warm-up and exploratory episodes of completed iterations.
        eval_env_steps: of evaluation episodes of completed iterations, closing ones included.
        issued, accepted, cancelled: the ledger of commands, except what is outstanding.
        delivered, duplicate, rejected: the ledger of episodes, with ``accepted``.
        env_failures: commands that actors could not carry out.
        wall_s: seconds that the run was being worked on, until this was written.
        latest_version: the newest weights version; 0: none yet.
        best_version: the version with the best evaluation; 0: none yet.
        exact: whether the result is still a function of the configuration alone.
        problem: why the run failed.
        ended_because: why there is no iteration after the last one, or :data:`STOPPED`.
        deceived: the run failed because episodes of an actor that lied have entered it.
        audit: share of the episodes that a second actor makes again.
        agreed: those that it made alike.
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

    def why_ended(self) -> str:
        """Return why the run ended, in words; empty: it has not."""
        return f"failed: {self.problem}"[:4000] if self.state == "failed" else self.ended_because

    def why_stopped(self) -> str:
        """Return why nobody works on the run, though it has not ended."""
        return STOPPED if self.ended_because == STOPPED else KILLED
