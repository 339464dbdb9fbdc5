"""Reports of a run: its status, ``metrics.csv``, ``weights.safetensors``."""

import csv
import logging
import math
from collections import deque
from contextlib import suppress
from pathlib import Path

from udrl.atomic_files import write_atomically
from udrl.commands import episodes_due
from udrl.digests import replay_digest
from udrl.strategies import Best
from udrl.targets import ReturnInTime
from udrl_proto.messages import MAX_TEXT
from udrl_proto.reports import (
    HISTORY_PAGE,
    MOST_SHOWN,
    ActorStatus,
    AuditStatus,
    BufferStatus,
    CommandLedger,
    Contents,
    EpisodeLedger,
    EvaluationStatus,
    History,
    Quarantined,
    Status,
)
from udrl_replay.advice import advice
from udrl_replay.remedies import unwritable
from udrl_replay.run_state import RunState
from udrl_replay.store import COLUMNS, EvaluationRow, Store

log = logging.getLogger("udrl")

#: Period over which the throughput is averaged, in seconds.
_WINDOW_S = 10.0
#: Maximum number of characters of an actor's host name in the status. Actors choose this name, and
#: a status with many long ones would be larger than observers accept.
_MAX_HOST = 100


class MetricsFile:
    """``metrics.csv``: one line per iteration, rewritten from the store at every start.

    Raises:
        StoreError: the file cannot be written.
    """

    def __init__(self, run_dir: Path, store: Store) -> None:
        self._path = run_dir / "metrics.csv"
        self._store = store
        self._written = -1
        try:
            with self._path.open("w", newline="", encoding="utf-8") as file:
                csv.writer(file, lineterminator="\n").writerow(COLUMNS)
            # Kept open, so that later iterations do not depend on the limit of open files.
            self._file = self._path.open("a", newline="", encoding="utf-8")
        except OSError as error:
            raise unwritable(self._path, error) from error

    def update(self, iteration: int) -> None:
        """Append the lines of all iterations up to ``iteration``.

        Raises:
            StoreError: the file cannot be written.
        """
        if iteration <= self._written:
            return
        try:
            rows = self._store.metrics(self._written)
            csv.writer(self._file, lineterminator="\n").writerows(rows)
            self._file.flush()
        except OSError as error:
            raise unwritable(self._path, error) from error
        self._written = iteration

    def close(self) -> None:
        """Close the file."""
        with suppress(OSError):  # update() has already reported a full disk
            self._file.close()


def write_weights(run_dir: Path, store: Store, version: int) -> None:
    """Write the final weights to a file beside the store; version 0 has none.

    Raises:
        StoreError: the file cannot be written.
    """
    found = store.version(version)
    if found is None:
        return
    path = run_dir / "weights.safetensors"
    try:
        write_atomically(path, found.weights)
    except OSError as error:
        raise unwritable(path, error) from error
    log.info("the weights are in %s", path)


class Throughput:
    """Env steps per second over the last ten seconds."""

    def __init__(self) -> None:
        self._arrivals: deque[tuple[float, int]] = deque()

    def add(self, now: float, steps: int) -> None:
        """Count the steps of an accepted episode."""
        self._forget(now)  # here, too: no status may ever be requested
        self._arrivals.append((now, steps))

    def per_second(self, now: float) -> float:
        """Return the mean rate."""
        self._forget(now)
        if not self._arrivals:
            return 0.0
        span = max(now - self._arrivals[0][0], 1.0)
        return sum(steps for _, steps in self._arrivals) / span

    def _forget(self, now: float) -> None:
        """Forget the episodes that arrived too long ago."""
        while self._arrivals and now - self._arrivals[0][0] > _WINDOW_S:
            self._arrivals.popleft()


def status(run: RunState, throughput: Throughput, lag_s: float, now: float) -> Status:
    """Return the status of a run."""
    progress = run.progress
    latest = run.store.version(progress.latest_version)
    actors = _actor_statuses(run, now)
    final = run.store.last_evaluation(is_final=True) if progress.state == "ended" else None
    wall_s = run.wall_s if progress.state in ("running", "finishing") else progress.wall_s
    return Status(
        run_id=run.hello.run_id,
        state=progress.state,
        environment=run.config.environment,
        iteration=max(progress.iteration, 0),
        env_steps=progress.env_steps,
        eval_env_steps=progress.eval_env_steps,
        env_steps_per_s=round(throughput.per_second(now), 1),
        wall_s=round(wall_s, 3),
        max_env_steps=run.budget.max_env_steps,
        stop_return=run.budget.stop_return,
        time_left_s=_time_left_s(run),
        commands=CommandLedger(
            issued=progress.issued,
            accepted=progress.accepted,
            cancelled=progress.cancelled,
            outstanding=len(run.dispatcher.outstanding),
        ),
        episodes=EpisodeLedger(
            delivered=progress.delivered,
            accepted=progress.accepted,
            duplicate=progress.duplicate,
            rejected=progress.rejected,
        ),
        buffer=_buffer_status(run),
        weights_version=progress.latest_version,
        weights_lag=max((a.weights_lag for a in actors), default=0),
        weights_lag_s=round(lag_s, 4),
        weights_sha256=latest.digest.hex() if latest else "",
        replay_sha256=replay_digest(run.digests[e.id] for e in run.buffer).hex(),
        weights_kept=tuple(run.store.versions_kept()),
        loss=latest.loss if latest else None,
        evaluation=_evaluation(run.store.last_evaluation(is_final=False)),
        final_evaluation=_evaluation(final),
        exact=progress.exact,
        inexact_reason=progress.inexact_reason[:MAX_TEXT],
        useful_concurrency=episodes_due(run.config.commands, run.buffer) * (run.config.lead + 1),
        env_failures=progress.env_failures,
        actors=actors,
        waiting=run.waits.list(now),
        problem=progress.problem[:MAX_TEXT],
        deceived=progress.deceived,
        ended_because=progress.why_ended(),
        limit_reached=run.limit_reached(),
        advice=advice(run),
        audit=AuditStatus(
            rate=progress.audit,
            agreed=progress.agreed,
            open=len(run.auditor.open),
            disputed=sum(a.is_disputed for a in run.auditor.open.values()),
        ),
        quarantined=tuple(Quarantined(id=n, why=w) for n, w in run.quarantined.reasons.items()),
    )


def _actor_statuses(run: RunState, now: float) -> tuple[ActorStatus, ...]:
    return tuple(
        ActorStatus(
            id=name,
            host=actor.join.host[:_MAX_HOST],
            environments=actor.join.environments,
            env_steps_per_s=round(actor.request.env_steps_per_s, 1),
            weights_version=actor.request.weights_version,
            weights_lag=max(0, run.progress.latest_version - actor.request.weights_version),
            running=len(actor.holds),
            reruns=actor.reruns,
            failures=actor.failures,
            last_seen_s=round(now - actor.last_seen, 3),
        )
        for name, actor in sorted(run.dispatcher.actors.items())
    )


def _buffer_status(run: RunState) -> BufferStatus:
    returns = [e.episode_return for e in run.buffer.best(run.config.buffer.replay_size)]
    return BufferStatus(
        episodes=len(returns),
        return_min=returns[0] if returns else None,
        return_mean=math.fsum(returns) / len(returns) if returns else None,
        return_max=returns[-1] if returns else None,
    )


def _time_left_s(run: RunState) -> float | None:
    """Return the time until the budget is spent at the run's mean speed; None: unknown."""
    env_steps, wall_s = run.progress.env_steps, run.wall_s
    if run.progress.state != "running" or not env_steps or wall_s <= 0:
        return None
    left = max(0, run.budget.max_env_steps - env_steps)
    return round(left / (env_steps / wall_s), 1)


def _evaluation(row: EvaluationRow | None) -> EvaluationStatus | None:
    return None if row is None else _evaluated(row)


def _evaluated(row: EvaluationRow) -> EvaluationStatus:
    return EvaluationStatus(
        iteration=row.iteration, env_steps=row.env_steps, **row.evaluation._asdict()
    )


def history(store: Store, after: int) -> History:
    """Return a page of the iterations after ``after``, with their evaluations."""
    rows = store.iterations(after, HISTORY_PAGE + 1)
    page = tuple(rows[:HISTORY_PAGE])
    evaluations = store.evaluations(after, page[-1].iteration) if page else []
    return History(
        iterations=page,
        evaluations=tuple(map(_evaluated, evaluations)),
        more=len(rows) > HISTORY_PAGE,
    )


def contents(run: RunState) -> Contents:
    """Return the content of the replay buffer and the commands drawn from it."""
    config = run.config
    entries = list(run.buffer)
    # The best episode is always shown.
    shown = entries[:: -max(1, -(-len(entries) // MOST_SHOWN))][::-1]
    best = Best.of(run.buffer.best(config.commands.last_few)) if entries else None
    evaluated = best and ReturnInTime(config.network).initial(best.mean, best.horizon)
    commands = [
        o.command for o in run.dispatcher.outstanding.values() if o.command.kind == "explore"
    ]
    return Contents(
        iteration=max(run.progress.iteration, 0),
        returns=tuple(e.episode_return for e in shown),
        lengths=tuple(e.length for e in shown),
        iterations=tuple(e.iteration for e in shown),
        desired_return=evaluated[0] if evaluated else None,
        desired_horizon=evaluated[1] if evaluated else None,
        return_std=best.deviation if best else None,
        desired_returns=tuple(c.desired_return for c in commands[:MOST_SHOWN]),
        desired_horizons=tuple(c.desired_horizon for c in commands[:MOST_SHOWN]),
        versions=tuple(run.store.versions_kept()),
    )
