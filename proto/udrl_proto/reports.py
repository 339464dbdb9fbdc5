"""Messages that report the state of a run: its status, its history, its buffer."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from udrl_proto.messages import MAX_NUMBER, Message, Name, Number, Text

#: Maximum number of iterations in one :class:`History`.
HISTORY_PAGE = 2000
#: Maximum number of episodes and of commands in one :class:`Contents`.
MOST_SHOWN = 2000

#: A setting of the budget that ends a run.
Limit = Literal["max_env_steps", "stop_return"]


class StatusRequest(Message, frozen=True, kw_only=True):
    """Request for the :class:`Status` of the run."""


class CommandLedger(Message, frozen=True, kw_only=True):
    """``issued = accepted + cancelled + outstanding``, at every moment."""

    issued: Number
    accepted: Number
    cancelled: Number
    outstanding: Number


class EpisodeLedger(Message, frozen=True, kw_only=True):
    """``delivered = accepted + duplicate + rejected``, at every moment."""

    delivered: Number
    accepted: Number
    duplicate: Number
    rejected: Number


class BufferStatus(Message, frozen=True, kw_only=True):
    """The replay buffer; returns are None while it is empty."""

    episodes: Number
    return_min: float | None
    return_mean: float | None
    return_max: float | None


class ActorStatus(Message, frozen=True, kw_only=True):
    """An actor that has joined."""

    id: Name
    host: Text
    environments: int
    env_steps_per_s: float
    weights_version: int
    weights_lag: int
    running: int
    reruns: Number
    failures: Number
    last_seen_s: float


class Waiting(Message, frozen=True, kw_only=True):
    """A service that waits: for what, why, and for how long."""

    who: Text
    on: Annotated[Text, Meta()] = msgspec.field(name="for")
    why: Text
    seconds: float


class EvaluationStatus(Message, frozen=True, kw_only=True):
    """An evaluation."""

    iteration: Number
    env_steps: Number
    mean: float
    std: float
    ci95_low: float
    ci95_high: float
    episodes: Number


class AuditStatus(Message, frozen=True, kw_only=True):
    """Episodes that are rerun by a second actor and compared."""

    rate: float
    agreed: Number
    open: Number
    disputed: Number


class Quarantined(Message, frozen=True, kw_only=True):
    """An actor that is excluded from the run."""

    id: Name
    why: Text


class Status(Message, frozen=True, kw_only=True):
    """The state of a run; every name is explained in ``docs/metrics.md``.

    ``stopped`` is never reported by a replay service, only when the file of a run is read that no
    process is running.

    Attributes:
        limit_reached: the setting that is raised to continue the run after its end; None: it has
            not reached a limit.
        deceived: whether the run failed because it learned from a false episode; it cannot be
            resumed.
    """

    run_id: Name
    state: Literal["running", "finishing", "ended", "failed", "stopped"]
    environment: Text
    iteration: Number
    env_steps: Number
    eval_env_steps: Number
    env_steps_per_s: float
    wall_s: float
    max_env_steps: Number
    stop_return: float | None
    time_left_s: float | None
    commands: CommandLedger
    episodes: EpisodeLedger
    buffer: BufferStatus
    weights_version: Number
    weights_lag: Number
    weights_lag_s: float
    weights_sha256: Text
    replay_sha256: Text
    weights_kept: tuple[Number, ...]
    loss: float | None
    evaluation: EvaluationStatus | None
    final_evaluation: EvaluationStatus | None
    exact: bool
    inexact_reason: Text
    useful_concurrency: Number
    env_failures: Number
    actors: tuple[ActorStatus, ...]
    waiting: tuple[Waiting, ...]
    problem: Text
    deceived: bool
    ended_because: Text
    limit_reached: Limit | None
    advice: Text
    audit: AuditStatus
    quarantined: tuple[Quarantined, ...]


class HistoryRequest(Message, frozen=True, kw_only=True):
    """Request for the results of the iterations after ``after``; -1: all."""

    after: Annotated[int, Meta(ge=-1, le=MAX_NUMBER)]


class IterationStatus(Message, frozen=True, kw_only=True):
    """A completed iteration: a row of the store, and of ``metrics.csv``, where it is explained."""

    iteration: Number
    commands: Number
    env_steps: Number
    eval_env_steps: Number
    wall_s: float
    weights_version: Number
    loss: float | None
    return_min: float
    return_mean: float
    return_max: float
    explored_return: float
    commanded_min: float | None
    commanded_max: float | None
    admitted: Number


class History(Message, frozen=True, kw_only=True):
    """The first requested iterations and their evaluations; request the rest again.

    Attributes:
        iterations: completed iterations in order, at most :data:`HISTORY_PAGE`.
        evaluations: the evaluations of these iterations, without the final evaluation.
        more: whether there are later iterations.
    """

    iterations: tuple[IterationStatus, ...]
    evaluations: tuple[EvaluationStatus, ...]
    more: bool


class ContentsRequest(Message, frozen=True, kw_only=True):
    """Request for the content of the replay buffer and the commands drawn from it."""


class Contents(Message, frozen=True, kw_only=True):
    """The episodes of the replay buffer and the commands drawn from it.

    Attributes:
        iteration: the iteration after which the buffer is shown.
        returns: returns of the episodes, lowest first; a regular subset if there are more than
            :data:`MOST_SHOWN`.
        lengths: lengths of the same episodes, steps.
        iterations: the iterations that produced them.
        desired_return: desired return of evaluations, M of the ``last_few`` best; None if the
            buffer is empty.
        desired_horizon: desired horizon of evaluations, steps.
        return_std: S of the ``last_few`` best.
        desired_returns: desired returns of the outstanding exploratory commands.
        desired_horizons: desired horizons of the same commands.
        versions: weights versions that are kept.
    """

    iteration: Number
    returns: tuple[float, ...]
    lengths: tuple[Number, ...]
    iterations: tuple[Number, ...]
    desired_return: float | None
    desired_horizon: Number | None
    return_std: float | None
    desired_returns: tuple[float, ...]
    desired_horizons: tuple[Number, ...]
    versions: tuple[Number, ...]
