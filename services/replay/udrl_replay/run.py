"""The run itself: issue commands, accept episodes, complete iterations, close.

It is a state machine over a :class:`~udrl_replay.store.Store`, driven by one thread inside the
store's transactions; it knows nothing of messaging. Everything that it must remember is in the
store when the transaction ends; everything else it can find out again.
"""

import logging
import math
import time
from typing import Literal

import msgspec

from udrl.commands import CLOSING, Command, CommandSampler
from udrl.config import COMMANDS_PER_ITERATION, Budget
from udrl.errors import Deceived, Refused, RunFailed
from udrl.evaluation import summarise
from udrl.replay import Entry, ReplayBuffer
from udrl.schedule import evaluation_due, opened_by, weights_version
from udrl_proto.messages import CommandsRequest, FailureMessage, Hello
from udrl_replay.arrival import Arrival
from udrl_replay.auditing import Auditor
from udrl_replay.dealing import MAX_DEALT, SUSPICIOUS, Dealer
from udrl_replay.quarantine import OFFENCES, Quarantine
from udrl_replay.store import EvaluationRow, Store, Version

log = logging.getLogger("udrl")

State = Literal["running", "closing", "ended", "failed"]


class Progress(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """Where a run stands, apart from its episodes, commands and weights.

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
    deceived: bool = False
    audit: float = 0.0
    agreed: int = 0


class Run:
    """A run, new or resumed.

    Args:
        store: its file.
        budget: when it ends; may differ from the one it was started with.
        audit: share of the episodes that a second actor makes again, 0 to 1.

    Raises:
        Deceived: it was stopped because an actor had lied.
    """

    def __init__(self, store: Store, budget: Budget, audit: float = 0.0) -> None:
        self.store = store
        self.budget = budget
        self.hello = store.fact("hello", Hello)
        self.config = self.hello.config
        self.progress = store.fact("progress", Progress)
        self.dealer = Dealer()
        self.auditor = Auditor(audit)
        self.quarantined = Quarantine(store)
        self._entered = store.fact("entered", dict[str, int], {})
        self._evaluated = {
            weights_version(e.iteration, self.config.lead)
            for e in store.evaluations(-1, self.progress.iteration)
        }
        self.sampler = CommandSampler(self.config, self.hello.environment)
        self._began = time.monotonic() - self.progress.wall_s
        held = store.buffer(self.progress.iteration)
        self.buffer = ReplayBuffer(self.config, (p.entry for p in held))
        self.digests = {p.entry.id: p.digest for p in held}
        outstanding = store.commands(cancelled=False)
        arrived = store.pending_ids()
        self.dealer.add(c for c in outstanding if c.id not in arrived)
        self._open = {c.id: c for c in outstanding}
        if store.read_only:
            return
        if self.progress.deceived:
            raise Deceived(self.progress.problem)
        self.progress.audit = audit
        with store.transaction():
            if self.progress.issued == 0:
                self._issue(self.sampler.warm_up())
            if self.progress.state == "failed":
                self._try_again()
            if self.progress.state != "running" and not self._budget_spent():
                self._reopen()
            self._advance()
            self.save()

    @property
    def wall_s(self) -> float:
        """Seconds that the run was being worked on."""
        return time.monotonic() - self._began

    def save(self) -> None:
        """Write the progress; belongs at the end of every transaction that changed something."""
        if self.progress.state in ("running", "closing"):
            self.progress.wall_s = self.wall_s
        self.store.set_fact("progress", self.progress)

    def mark_inexact(self, reason: str) -> None:
        """Say that the result no longer depends on the configuration alone."""
        if self.progress.exact:
            log.warning("the run is no longer exact: %s", reason)
            self.progress.exact = False
            self.progress.inexact_reason = reason

    # Episodes.

    def accept(self, arrival: Arrival, now: float) -> Literal["accepted", "duplicate"]:
        """Take in an episode once.

        Raises:
            Refused: it is not the answer to a command of this run, or to none that is still wanted.
        """
        self.progress.delivered += 1
        self.dealer.hear(arrival.actor, now)
        command_id = arrival.entry.id
        if arrival.actor in self.quarantined:
            self.progress.rejected += 1
            raise self.quarantined.refusal(arrival.actor)
        item = self.dealer.outstanding.get(command_id)
        if item is None:
            if self.auditor.asked(arrival.actor, command_id):
                return self._compare(arrival)
            return self._accept_again(arrival)
        if arrival.entry.length > item.command.max_steps:
            self.offend(arrival.actor, f"an episode longer than command {command_id} allows")
            raise self.reject(
                f"episode {command_id} has {arrival.entry.length} steps, its command allows "
                f"{item.command.max_steps}"
            )
        self._begin_audit(item.command, arrival)
        self.dealer.remove(command_id, now)
        self.store.add_episode(arrival.entry, arrival.digest, arrival.body)
        self.progress.accepted += 1
        self._advance()
        if self.progress.state == "closing" and command_id % COMMANDS_PER_ITERATION >= CLOSING:
            self._end_if_closed()
        return "accepted"

    def _accept_again(self, arrival: Arrival) -> Literal["duplicate"]:
        command_id = arrival.entry.id
        iteration, index = divmod(command_id, COMMANDS_PER_ITERATION)
        digest = self.store.episode_digest(command_id)
        if digest is not None and digest != arrival.digest:
            self.mark_inexact(
                f"two actors carried out command {command_id} and their episodes differ; the "
                f"environment {self.config.environment} or their machines are not deterministic"
            )
        if digest is not None or self._is_done(iteration, index):
            self.progress.duplicate += 1
            return "duplicate"
        if command_id in self._open or index >= CLOSING or iteration > self.progress.iteration:
            raise self.reject(f"command {command_id} is cancelled or unknown; drop the episode")
        self.offend(arrival.actor, f"an episode of command {command_id}, which was never issued")
        raise self.reject(f"command {command_id} was never issued; drop the episode")

    def _is_done(self, iteration: int, index: int) -> bool:
        """Say whether a command's episode has come and had its effect."""
        if index < CLOSING:
            return iteration <= self.progress.iteration and index < self.store.issued_in(iteration)
        closed = self.progress.state == "ended" and iteration == self.progress.iteration > 0
        return closed and index < CLOSING + self.config.eval_episodes

    def reject(self, why: str) -> Refused:
        """Count a rejected episode and return the refusal to raise."""
        self.progress.rejected += 1
        return Refused("rejected", why)

    def fail(self, failure: FailureMessage) -> None:
        """Note that an actor could not carry out a command that it holds."""
        if not self.dealer.holds(failure.actor, failure.command_id):
            return  # said again, or by an actor whose commands have gone to others
        self.progress.env_failures += 1
        log.warning("%s failed on command %d: %s", failure.actor, failure.command_id, failure.error)
        self.dealer.fail(failure.command_id, failure.actor)
        if self.dealer.is_hopeless(failure.command_id):
            self._give_up(
                failure.command_id,
                f"command {failure.command_id} failed three times: {failure.error}",
            )

    def lose(self, actor: str) -> None:
        """Note that an actor is gone, perhaps through a command that it held."""
        self.auditor.leave(actor)
        for item in self.dealer.leave(actor):
            command_id = item.command.id
            if len(item.vanished) == SUSPICIOUS:
                log.warning(
                    "command %d was held by %d actors that vanished and is now carried out alone",
                    command_id, SUSPICIOUS,
                )  # fmt: skip
            if self.dealer.is_hopeless(command_id):
                self._give_up(
                    command_id,
                    f"command {command_id} ended three actors that carried out nothing else: its "
                    f"environment hangs or crashes",
                )

    def _give_up(self, command_id: int, why: str) -> None:
        if self.progress.state == "failed":
            return
        self.progress.state = "failed"
        self.progress.problem = f"{why}; reproduce it with: udrl reproduce RUN_DIR {command_id}"
        log.error("%s", RunFailed(self.progress.problem))

    # Whom to believe.

    def deal(self, request: CommandsRequest, now: float) -> list[Command]:
        """Return commands for an actor that has joined; those to be checked come first."""
        actor = self.dealer.actors[request.actor]
        again = self.auditor.assign(
            actor.join.id, actor.join.numerics_class, request.running,
            min(request.wanted, MAX_DEALT),
        )  # fmt: skip
        actor.reruns += len(again)
        rest = msgspec.structs.replace(request, wanted=request.wanted - len(again))
        return again + self.dealer.deal(rest, self.progress.latest_version, now)

    def _begin_audit(self, command: Command, arrival: Arrival) -> None:
        """Remember who brings an episode, and perhaps have it made again."""
        name = arrival.actor
        if name not in self._entered:
            self._entered[name] = command.iteration
            self.store.set_fact("entered", self._entered)
        if name in self.dealer.actors:
            numerics_class = self.dealer.actors[name].join.numerics_class
            self.auditor.consider(command, name, numerics_class, arrival.digest)

    def _compare(self, arrival: Arrival) -> Literal["duplicate"]:
        """Take in an episode that was asked for to check another actor's."""
        self.progress.duplicate += 1
        command_id = arrival.entry.id
        verdict = self.auditor.compare(arrival.actor, command_id, arrival.digest)
        if verdict is None and command_id in self.auditor.open:
            log.warning("actors differ on command %d; a third will decide who lied", command_id)
        elif verdict is None:
            self.progress.agreed += 1
        elif verdict.liar is None:
            self.auditor.stop()
            self.progress.audit = 0.0
            self.mark_inexact(
                f"three actors carried out command {command_id} and all their episodes differ; the "
                f"environment {self.config.environment} or their machines are not deterministic; "
                f"nothing is audited any more"
            )
        else:
            self._convict(verdict.liar, command_id)
        return "duplicate"

    def _convict(self, liar: str, command_id: int) -> None:
        why = f"its episode of command {command_id} differs from that of two others"
        self.quarantine(liar, why)
        if liar in self._entered and self.progress.state not in ("ended", "failed"):
            self.progress.state = "failed"
            self.progress.deceived = True
            self.progress.problem = (
                f"actor {liar} lied: {why}. Since iteration {self._entered[liar]} the run has "
                f"learned from its episodes; start a new run without it, in another --run-dir"
            )
            log.error("%s", self.progress.problem)

    def offend(self, actor: str, what: str) -> None:
        """Note that an actor delivered what it may not; too often is once too many."""
        if self.quarantined.count(actor):
            self.quarantine(actor, f"it delivered {OFFENCES} invalid episodes, the last: {what}")

    def quarantine(self, actor: str, why: str) -> None:
        """Take nothing from an actor any more, and give what it holds to others."""
        self.quarantined.add(actor, why)
        self.lose(actor)

    # Iterations.

    def _advance(self) -> None:
        """Complete every iteration whose turn it is and whose episodes are all there."""
        while self.progress.state == "running":
            following = self.progress.iteration + 1
            issued = following * COMMANDS_PER_ITERATION in self._open
            if not issued or self.dealer.left(following):
                return
            self._complete(following)

    def _complete(self, iteration: int) -> None:
        """Admit an iteration's episodes, in the order of their ids, and issue what that opens."""
        progress = self.progress
        arrived = self.store.pending(iteration)
        ids = [p.entry.id for p in arrived]
        evaluated = [p.entry for p in arrived if self._open[p.entry.id].kind == "evaluate"]
        explored = [p for p in arrived if self._open[p.entry.id].kind != "evaluate"]
        steps_before = progress.env_steps
        progress.env_steps += sum(p.entry.length for p in explored)
        progress.eval_env_steps += sum(e.length for e in evaluated)
        progress.iteration = iteration

        evicted = {e.id for e in self.buffer.admit(p.entry for p in explored)}
        admitted = [p for p in explored if p.entry.id not in evicted]
        self.store.admit(iteration, (p.entry.id for p in admitted), sorted(evicted - set(ids)))
        self.store.remove_episodes(sorted(set(ids) - {p.entry.id for p in admitted}))
        self.digests |= {p.entry.id: p.digest for p in admitted}
        for gone in evicted & self.digests.keys():
            del self.digests[gone]

        if evaluated:
            self._note_evaluation(iteration, evaluated, closing=False)
        best = self.buffer.best(self.config.replay_size)
        returns = [e.episode_return for e in best]
        commands = [self._open[i] for i in ids]
        self.store.add_iteration(
            iteration,
            len(ids),
            progress.env_steps,
            progress.eval_env_steps,
            self.wall_s,
            returns[0],
            math.fsum(returns) / len(returns),
            returns[-1],
            math.fsum(p.entry.episode_return for p in explored) / len(explored),
            weights_version(iteration, self.config.lead),
            *_range([c.desired_return for c in commands if c.kind == "explore"]),
            sum(e.iteration == iteration for e in best),
        )
        self.store.remove_commands(ids)
        for i in ids:
            del self._open[i]

        due = evaluation_due(iteration, steps_before, progress.env_steps, self.config.eval_every)
        for opened in opened_by(iteration, self.config.lead):
            self._issue(self.sampler.explore(opened, self.buffer))
            if due:
                self._issue(self.sampler.evaluate(opened, self.buffer))
            due = False
        if self._budget_spent():
            self._close()

    def _note_evaluation(self, iteration: int, entries: list[Entry], *, closing: bool) -> None:
        result = summarise([e.episode_return for e in entries])
        command = self._open[entries[0].id]
        version = command.weights_version
        source = self.progress.env_steps if closing else self.store.env_steps_after(version - 1)
        self.store.add_evaluation(
            EvaluationRow(
                iteration, closing, source, command.desired_return, command.desired_horizon, result
            )
        )
        log.info(
            "iteration %d, evaluation at %d env steps: mean return %.1f (95 %% from %.1f to %.1f)",
            iteration, source, result.mean, result.ci95_low, result.ci95_high,
        )  # fmt: skip
        if not closing:
            self._evaluated.add(version)
        best = self.progress.best_mean
        if not closing and (best is None or result.mean > best):
            self.progress.best_mean, self.progress.best_version = result.mean, version

    def _issue(self, commands: list[Command]) -> None:
        self.store.add_commands(commands)
        self.dealer.add(commands)
        self._open |= {c.id: c for c in commands}
        self.progress.issued += len(commands)

    # The end, and going on after it.

    def _budget_spent(self) -> bool:
        last = self.store.last_evaluation(closing=False)
        lands = (
            self.budget.stop_return is not None
            and last is not None
            and last.iteration == self.progress.iteration
            and last.evaluation.mean >= self.budget.stop_return
        )
        return self.progress.env_steps >= self.budget.max_env_steps or lands

    def _close(self) -> None:
        """Iteration N is complete: cancel what was issued beyond and wait for version N."""
        self.progress.state = "closing"
        self._cancel(list(self.dealer.outstanding))
        self.store.remove_versions(self.progress.iteration)
        self.progress.latest_version = min(self.progress.latest_version, self.progress.iteration)
        self._keep_needed_weights()
        self._issue_closing()

    def _issue_closing(self) -> None:
        """Issue the closing evaluation once version N is there; version 0 cannot act."""
        final = self.progress.iteration
        if final == 0:
            self.progress.state = "ended"
        elif self.progress.latest_version == final:
            self._issue(self.sampler.close(final, self.buffer))

    def _end_if_closed(self) -> None:
        final = self.progress.iteration
        if self.dealer.outstanding:
            return
        ids = [i for i in self._open if i % COMMANDS_PER_ITERATION >= CLOSING]
        entries = [p.entry for p in self.store.pending(final)]
        self.progress.eval_env_steps += sum(e.length for e in entries)
        self._note_evaluation(final, entries, closing=True)
        self.store.remove_episodes(e.id for e in entries)
        self.store.remove_commands(ids)
        for i in ids:
            del self._open[i]
        self.progress.wall_s = self.wall_s
        self.progress.state = "ended"

    def _cancel(self, ids: list[int]) -> None:
        for i in ids:
            self.dealer.remove(i)
            del self._open[i]
        self.store.mark_commands(ids, cancelled=True)
        self.progress.cancelled += len(ids)

    def _reopen(self) -> None:
        """Go on after the end with a larger budget, as if it had not come."""
        final = self.progress.iteration
        closing = [i for i in self._open if i % COMMANDS_PER_ITERATION >= CLOSING]
        unfinished = [i for i in closing if i in self.dealer.outstanding]
        for i in closing:
            del self._open[i]
        for i in unfinished:
            self.dealer.remove(i)
        self.progress.cancelled += len(unfinished)
        self.store.remove_commands(closing)
        self.store.remove_episodes(p.entry.id for p in self.store.pending(final))
        again = self.store.commands(cancelled=True)
        self.store.mark_commands((c.id for c in again), cancelled=False)
        self.progress.cancelled -= len(again)
        self._open |= {c.id: c for c in again}
        self.dealer.add(again)
        self.progress.state = "running"

    def _try_again(self) -> None:
        """Go on with the command that could not be carried out."""
        closing = any(i % COMMANDS_PER_ITERATION >= CLOSING for i in self._open)
        self.progress.state = "closing" if closing else "running"
        self.progress.problem = ""

    # Weights.

    def awaits_version(self) -> int | None:
        """Return the version that can be trained now, or None: its buffer is not there yet."""
        version = self.progress.latest_version + 1
        return version if self.is_trainable(version) else None

    def is_trainable(self, version: int) -> bool:
        """Whether the buffer that a version is trained on is there, and the run needs it."""
        needed = self.progress.state == "running" or version <= self.progress.iteration
        return needed and version <= self.progress.iteration + 1

    def add_version(self, version: Version, train_s: float) -> Literal["accepted", "duplicate"]:
        """Take in a weights version once.

        Raises:
            Refused: it is not the next one, or differs from the one of that number.
        """
        known = self.store.version(version.version)
        if known is not None:
            if known.digest != version.digest:
                raise Refused(
                    "unequal_version",
                    f"weights version {version.version} was delivered before with other values: "
                    f"{known.digest.hex()[:16]}, now {version.digest.hex()[:16]}; the learner is "
                    f"not deterministic, or belongs to another run",
                )
            return "duplicate"
        if not math.isfinite(version.loss):
            raise Refused(
                "invalid",
                f"weights version {version.version} has the loss {version.loss}; training "
                f"diverged, lower learning_rate",
            )
        if version.version != self.awaits_version():
            raise Refused(
                "rewind",
                f"weights version {version.version} was delivered, "
                f"{self.progress.latest_version + 1} is next; ask for the state and go on there",
            )
        self.store.add_version(version, train_s)
        self.progress.latest_version = version.version
        self._keep_needed_weights()
        if self.progress.state == "closing" and version.version == self.progress.iteration:
            self._issue_closing()
        return "accepted"

    def _keep_needed_weights(self) -> None:
        """Forget what nobody can ask for any more: weights, optimizers and evicted episodes."""
        latest = self.progress.latest_version
        # A run that is resumed after its end takes its cancelled commands up again.
        wanted = [*self._open.values(), *self.store.commands(cancelled=True)]
        needed = {c.weights_version for c in wanted} | {latest, self.progress.best_version}
        needed |= self.auditor.versions
        needed |= self._evaluated  # for whoever wants to look at them later
        self.store.drop_weights(v for v in self.store.versions_kept() if v not in needed)
        self.store.drop_optimizers(latest)
        # The learner that trains version latest + 1 needs the buffer after iteration `latest`.
        self.store.remove_evicted(latest)


def _range(numbers: list[float]) -> tuple[float | None, float | None]:
    return (min(numbers), max(numbers)) if numbers else (None, None)
