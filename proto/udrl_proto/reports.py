"""Messages in which a run tells how it is doing: its status, its history, its buffer."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from udrl_proto.messages import Message, Name, Number, Text

#: Iterations in one :class:`History`.
HISTORY_PAGE = 2000
#: Episodes and commands in one :class:`Contents`.
MOST_SHOWN = 2000


class StatusRequest(Message, frozen=True, kw_only=True):
    """Anyone asks how the run is doing; the reply is :class:`Status`."""


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
    """An actor that is here."""

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
    """Who waits for whom, why, and for how long."""

    who: Text
    on: Annotated[Text, Meta()] = msgspec.field(name="for")
    why: Text
    seconds: float


class EvaluationStatus(Message, frozen=True, kw_only=True):
    """The last evaluation, or the closing one."""

    iteration: Number
    env_steps: Number
    mean: float
    std: float
    ci95_low: float
    ci95_high: float
    episodes: Number


class AuditStatus(Message, frozen=True, kw_only=True):
    """Episodes that a second actor makes again, to compare."""

    rate: float
    agreed: Number
    open: Number
    disputed: Number


class Quarantined(Message, frozen=True, kw_only=True):
    """An actor that nothing is taken from any more."""

    id: Name
    why: Text


class Status(Message, frozen=True, kw_only=True):
    """How a run is doing; every name is explained in ``docs/metrics.md``.

    A replay service never says ``stopped``; who reads the file of a run that nobody works on does.
    """

    run_id: Name
    state: Literal["running", "closing", "ended", "failed", "stopped"]
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
    loss: float | None
    evaluation: EvaluationStatus | None
    closing_evaluation: EvaluationStatus | None
    exact: bool
    inexact_reason: Text
    useful_concurrency: Number
    env_failures: Number
    actors: tuple[ActorStatus, ...]
    waiting: tuple[Waiting, ...]
    problem: Text
    ended_because: Text
    advice: Text
    audit: AuditStatus
    quarantined: tuple[Quarantined, ...]


class HistoryRequest(Message, frozen=True, kw_only=True):
    """Anyone asks what came of the iterations after one; -1: of all."""

    after: Annotated[int, Meta(ge=-1, le=2**62)]


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
    """The first of them, and the evaluations that were made in these; ask again for the others.

    Attributes:
        iterations: in their order, at most :data:`HISTORY_PAGE`.
        evaluations: likewise, without closing ones.
        more: whether there are iterations after the last of these.
    """

    iterations: tuple[IterationStatus, ...]
    evaluations: tuple[EvaluationStatus, ...]
    more: bool


class ContentsRequest(Message, frozen=True, kw_only=True):
    """Anyone asks what the replay buffer holds, and what its next commands ask for."""


class Contents(Message, frozen=True, kw_only=True):
    """The replay buffer, episode by episode, and what is drawn from it.

    Attributes:
        iteration: the buffer is as it was after this one.
        returns: of its episodes, least first; of more than :data:`MOST_SHOWN` every so many.
        lengths: of the same episodes, steps.
        iterations: in which they were made.
        desired_return: what evaluations ask for, M of the ``last_few`` best; None: it is empty.
        desired_horizon: in how many steps.
        return_std: S of the ``last_few`` best.
        desired_returns: of exploratory commands that are outstanding.
        desired_horizons: of the same commands.
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
