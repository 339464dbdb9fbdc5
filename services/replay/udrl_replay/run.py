"""The run: issue commands, accept episodes, complete iterations, evaluate.

A state machine over a :class:`~udrl_replay.store.Store`, driven by one thread inside the store's
transactions; it imports no messaging. All persistent state is in the store when a transaction ends;
the rest is derived from it, or sent again by the services.
"""

import logging
import math
from functools import partial
from heapq import nlargest
from shlex import quote
from typing import Literal

from udrl.commands import FINAL_EVALUATION, Command, CommandSampler
from udrl.config import COMMANDS_PER_ITERATION, Budget
from udrl.errors import Deceived, Refused, RunFailed
from udrl.evaluation import return_text, summarise
from udrl.replay_buffer import Entry
from udrl.schedule import evaluation_due, opened_by, weights_version
from udrl_proto.messages import CommandsRequest, FailureMessage
from udrl_proto.reports import IterationStatus
from udrl_proto.text import printable
from udrl_replay.arrival import Arrival
from udrl_replay.dispatching import SUSPICIOUS, Outstanding
from udrl_replay.enforcement import Enforcement
from udrl_replay.progress import STOPPED
from udrl_replay.run_state import RunState
from udrl_replay.store import EvaluationRow, Store, StoredEpisode, Version
from udrl_replay.versions import is_known

log = logging.getLogger("udrl")


class StoredRun(RunState):
    """A run in progress, new or resumed.

    Args:
        store: the run's file.
        budget: the run's stopping criteria; may differ from those it was started with.
        audit: share of the episodes that are audited, 0 to 1.

    Raises:
        Deceived: the run has failed because an actor delivered a false episode.
    """

    def __init__(self, store: Store, budget: Budget, audit: float = 0.0) -> None:
        super().__init__(store, budget, audit)
        self.sampler = CommandSampler(self.config, self.hello.environment)
        self.enforcement = Enforcement(self, partial(self.remove_actor, vanished=False))
        self._evaluated = {
            weights_version(e.iteration, self.config.lead)
            for e in store.evaluations(-1, self.progress.iteration)
        }
        if self.progress.deceived:
            raise Deceived(self.progress.problem)
        self.progress.audit = audit
        with store.transaction():
            if self.progress.issued == 0:
                self._issue(self.sampler.warm_up())
            if self.progress.state == "failed":
                self._clear_failure()
            why = self._spent()
            if self.progress.state != "running" and not why:
                self._reopen()
            self.progress.ended_because = "" if self.progress.state == "running" else why
            self._advance()
            if self._final_commands():
                self._end_if_evaluated()  # the command that failed may be done since
            if budget.keep_versions is not None:  # it may be fewer than before
                self._keep_needed_weights()
            self.save()

    def save(self) -> None:
        """Write the progress; call it at the end of every transaction that changes it."""
        if self.progress.state in ("running", "finishing"):
            self.progress.wall_s = self.wall_s
        self.store.set_fact("progress", self.progress)

    def stop(self) -> None:
        """Mark the run as stopped, for processes that read its file."""
        self.enforcement.mark_undecided(stops=True)  # open audits are lost
        if self.progress.state in ("running", "finishing"):
            self.progress.ended_because = STOPPED
        self.save()

    # Episodes.

    def accept(self, arrival: Arrival, now: float) -> Literal["accepted", "duplicate"]:
        """Accept an episode once.

        Raises:
            Refused: its actor is quarantined, its command was never issued or is cancelled, or it
                is too long.
        """
        self.progress.delivered += 1
        self.dispatcher.note_seen(arrival.actor, now)
        command_id = arrival.entry.id
        if arrival.actor in self.quarantined:
            self.progress.rejected += 1
            raise self.quarantined.refusal(arrival.actor)
        item = self.dispatcher.outstanding.get(command_id)
        if item is None:
            if self.auditor.is_assigned(arrival.actor, command_id):
                return self.enforcement.compare(arrival)
            return self._accept_again(arrival)
        if arrival.entry.length > item.command.max_steps:
            self.enforcement.count_offence(
                arrival.actor, f"an episode longer than command {command_id} allows"
            )
            raise self.reject(
                f"episode {command_id} has {arrival.entry.length} steps, its command allows "
                f"{item.command.max_steps}"
            )
        self.enforcement.record_delivery(item.command, arrival)
        self.dispatcher.remove_command(command_id, now)
        self.store.add_episode(arrival.entry, arrival.digest, arrival.body)
        self.progress.accepted += 1
        self._advance()
        if (
            self.progress.state == "finishing"
            and command_id % COMMANDS_PER_ITERATION >= FINAL_EVALUATION
        ):
            self._end_if_evaluated()
        return "accepted"

    def _accept_again(self, arrival: Arrival) -> Literal["duplicate"]:
        """Reply to an episode whose command is not outstanding: a duplicate, or to be rejected."""
        command_id = arrival.entry.id
        iteration, index = divmod(command_id, COMMANDS_PER_ITERATION)
        digest = self.store.episode_digest(command_id)
        if digest is not None and digest != arrival.digest:
            self.mark_inexact(
                f"two actors ran command {command_id} and their episodes differ; the "
                f"environment {self.config.environment} or their machines are not deterministic"
            )
        if digest is not None or self._is_done(iteration, index):
            self.progress.duplicate += 1
            return "duplicate"
        if index >= FINAL_EVALUATION or iteration > self.progress.iteration:
            raise self.reject(f"command {command_id} is cancelled or unknown; drop the episode")
        self.enforcement.count_offence(
            arrival.actor, f"an episode of command {command_id}, which was never issued"
        )
        raise self.reject(f"command {command_id} was never issued; drop the episode")

    def _is_done(self, iteration: int, index: int) -> bool:
        """Return whether a command's episode was accepted earlier, even if it is no longer kept."""
        if index < FINAL_EVALUATION:
            return iteration <= self.progress.iteration and index < self.store.issued_in(iteration)
        closed = self.progress.state == "ended" and iteration == self.progress.iteration > 0
        return closed and index < FINAL_EVALUATION + self.config.evaluation.eval_episodes

    def assign(self, request: CommandsRequest, now: float) -> list[Command]:
        """Assign commands to an actor that has joined, audits first."""
        again, rest = self.enforcement.assign(request)
        return again + self.dispatcher.assign(rest, self.progress.latest_version, now)

    def reject(self, why: str) -> Refused:
        """Count a rejected episode and return the refusal to raise."""
        self.progress.rejected += 1
        return Refused("rejected", why)

    def fail(self, failure: FailureMessage) -> None:
        """Note that a command failed in an actor's environment."""
        if not self.dispatcher.holds(failure.actor, failure.command_id):
            return  # a repetition, or the command has been assigned to another actor
        self.progress.env_failures += 1
        error = printable(failure.error)
        log.warning("%s failed on command %d: %s", failure.actor, failure.command_id, error)
        self.dispatcher.note_failure(failure.command_id, failure.actor)
        if self.dispatcher.is_hopeless(failure.command_id):
            self._give_up(self.dispatcher.outstanding[failure.command_id], error)

    def remove_actor(self, actor: str, *, vanished: bool = True) -> None:
        """Remove an actor that has vanished or was refused; its commands are assigned again."""
        self.auditor.remove_actor(actor)
        self.waits.end(f"actor {actor}")
        for item in self.dispatcher.remove_actor(actor, vanished=vanished):
            command_id = item.command.id
            if len(item.vanished) == SUSPICIOUS:
                log.warning(
                    "command %d was held by %d actors that vanished and is now run alone",
                    command_id, SUSPICIOUS,
                )  # fmt: skip
            if actor in item.ended and self.dispatcher.is_hopeless(command_id):
                self._give_up(item, "its environment hangs or crashes")

    def _give_up(self, item: Outstanding, cause: str) -> None:
        """Fail the run because of a command that cannot be run."""
        if self.progress.state == "failed":
            return
        cause = cause[:3000]  # so that the status has the rest, too
        command_id, ended = item.command.id, len(item.ended)
        how = f", {ended} of them by ending an actor that ran nothing else" if ended else ""
        self.progress.state = "failed"
        self.progress.problem = (
            f"command {command_id} failed {len(item.failures) + ended} times{how}: {cause}; "
            f"reproduce it with: udrl reproduce {quote(str(self.store.run_dir))} {command_id}"
        )
        log.error("%s", RunFailed(self.progress.problem))

    # Iterations.

    def _advance(self) -> None:
        """Complete iterations in order, as far as all their episodes have arrived."""
        while self.progress.state == "running":
            following = self.progress.iteration + 1
            if self.dispatcher.outstanding_in(following):
                return
            self._complete(following)

    def _complete(self, iteration: int) -> None:
        """Admit an iteration's episodes in the order of their ids and issue the next commands."""
        progress = self.progress
        arrived = self.store.pending(iteration)
        ids = [p.entry.id for p in arrived]
        commands = {c.id: c for c in self.open_commands() if c.iteration == iteration}
        evaluated = [p.entry for p in arrived if commands[p.entry.id].kind == "evaluate"]
        explored = [p for p in arrived if commands[p.entry.id].kind != "evaluate"]
        steps_before = progress.env_steps
        progress.env_steps += sum(p.entry.length for p in explored)
        progress.eval_env_steps += sum(e.length for e in evaluated)
        progress.iteration = iteration

        self._admit(iteration, set(ids), explored)
        if evaluated:
            self._note_evaluation(commands[evaluated[0].id], evaluated, is_final=False)
        desired = [c.desired_return for c in commands.values() if c.kind == "explore"]
        self._note_iteration(len(ids), [p.entry.episode_return for p in explored], desired)
        self.store.remove_commands(ids)

        due = evaluation_due(steps_before, progress.env_steps, self.config.evaluation.eval_every)
        for opened in opened_by(iteration, self.config.lead):
            self._issue(self.sampler.explore(opened, self.buffer))
            if due:
                self._issue(self.sampler.evaluate(opened, self.buffer))
            due = False
        if why := self._spent():
            self._begin_final_evaluation(why)

    def _admit(self, iteration: int, ids: set[int], explored: list[StoredEpisode]) -> None:
        """Admit an iteration's exploratory episodes to the buffer; delete the others of ``ids``."""
        evicted = {e.id for e in self.buffer.admit(p.entry for p in explored)}
        admitted = {p.entry.id: p.digest for p in explored if p.entry.id not in evicted}
        self.store.admit(iteration, admitted, sorted(evicted - ids))
        self.store.remove_episodes(sorted(ids - admitted.keys()))
        self.digests |= admitted
        for gone in evicted & self.digests.keys():
            del self.digests[gone]

    def _note_iteration(self, commands: int, explored: list[float], desired: list[float]) -> None:
        """Record the iteration that is now complete.

        Args:
            commands: number of its commands.
            explored: returns of its exploratory episodes.
            desired: desired returns of its exploratory commands; none in the warm-up.
        """
        progress = self.progress
        version = weights_version(progress.iteration, self.config.lead)
        best = self.buffer.best(self.config.buffer.replay_size)
        returns = [e.episode_return for e in best]
        self.store.add_iteration(
            IterationStatus(
                iteration=progress.iteration,
                commands=commands,
                env_steps=progress.env_steps,
                eval_env_steps=progress.eval_env_steps,
                wall_s=round(self.wall_s, 3),
                weights_version=version,
                loss=self.store.loss_of(version),
                return_min=returns[0],
                return_mean=math.fsum(returns) / len(returns),
                return_max=returns[-1],
                explored_return=math.fsum(explored) / len(explored),
                commanded_min=min(desired, default=None),
                commanded_max=max(desired, default=None),
                admitted=sum(e.iteration == progress.iteration for e in best),
            )
        )

    def _note_evaluation(self, command: Command, entries: list[Entry], *, is_final: bool) -> None:
        """Record the returns of an evaluation's episodes; ``command`` is one of its commands."""
        result = summarise([e.episode_return for e in entries])
        iteration, version = command.iteration, command.weights_version
        source = self.progress.env_steps if is_final else self.store.env_steps_after(version - 1)
        self.store.add_evaluation(
            EvaluationRow(
                iteration, is_final, source, command.desired_return, command.desired_horizon, result
            )
        )
        log.info(
            "iteration %d, evaluation at %d env steps: mean return %s (95 %% from %s to %s)",
            iteration, source,
            *map(return_text, (result.mean, result.ci95_low, result.ci95_high)),
        )  # fmt: skip
        if not is_final:
            self._evaluated.add(version)
        best = self.progress.best_mean
        if not is_final and (best is None or result.mean > best):
            self.progress.best_mean, self.progress.best_version = result.mean, version

    def _issue(self, commands: list[Command]) -> None:
        self.store.add_commands(commands)
        self.dispatcher.add(commands)
        self.progress.issued += len(commands)

    # The end, and resuming after it.

    def _spent(self) -> str:
        """Return that a limit of the budget is reached, for ``ended_because``; empty: none is."""
        match self.limit_reached():
            case "stop_return":
                return f"reached return {self.budget.stop_return:.10g}"
            case "max_env_steps":
                return f"spent its budget of {self.budget.max_env_steps:,} env steps"
        return ""

    def _begin_final_evaluation(self, why: str) -> None:
        """End at iteration N, now complete: cancel later commands and wait for version N."""
        self.progress.state, self.progress.ended_because = "finishing", why
        self._cancel(list(self.dispatcher.outstanding))
        self.store.remove_versions(self.progress.iteration)
        self.progress.latest_version = min(self.progress.latest_version, self.progress.iteration)
        self._keep_needed_weights()
        self._issue_final_evaluation()

    def _issue_final_evaluation(self) -> None:
        """Issue the final evaluation if version N has arrived; version 0 is not evaluated."""
        final = self.progress.iteration
        if final == 0:
            self._end()
        elif self.progress.latest_version == final:
            self._issue(self.sampler.evaluate_final(final, self.buffer))

    def _end_if_evaluated(self) -> None:
        """Record the final evaluation and end the run, if all its episodes have arrived."""
        final = self.progress.iteration
        if self.dispatcher.outstanding:
            return
        commands = self._final_commands()
        entries = [p.entry for p in self.store.pending(final)]
        self.progress.eval_env_steps += sum(e.length for e in entries)
        self._note_evaluation(commands[0], entries, is_final=True)
        self.store.remove_episodes(e.id for e in entries)
        self.store.remove_commands(c.id for c in commands)
        self.progress.wall_s = self.wall_s
        self._end()

    def _end(self) -> None:
        self.progress.state = "ended"
        self.enforcement.mark_undecided()  # no more audits are assigned

    def _final_commands(self) -> list[Command]:
        return [c for c in self.open_commands() if c.index >= FINAL_EVALUATION]

    def _cancel(self, ids: list[int]) -> None:
        """Cancel outstanding commands; a run that is resumed after its end restores them."""
        for i in ids:
            self.dispatcher.remove_command(i)
        self.store.mark_commands(ids, cancelled=True)
        self.progress.cancelled += len(ids)

    def _reopen(self) -> None:
        """Undo the end of the run, to continue with a larger budget."""
        final = self.progress.iteration
        final_ids = [c.id for c in self._final_commands()]
        unfinished = [i for i in final_ids if i in self.dispatcher.outstanding]
        for i in unfinished:
            self.dispatcher.remove_command(i)
        self.progress.cancelled += len(unfinished)
        self.store.remove_commands(final_ids)
        self.store.remove_episodes(p.entry.id for p in self.store.pending(final))
        again = self.store.commands(cancelled=True)
        self.store.mark_commands((c.id for c in again), cancelled=False)
        self.progress.cancelled -= len(again)
        self.dispatcher.add(again)
        self.progress.state = "running"

    def _clear_failure(self) -> None:
        """Continue after a failure; the command that failed is retried."""
        self.progress.state = "finishing" if self._final_commands() else "running"
        self.progress.problem = ""

    # Weights.

    def add_version(self, version: Version, train_s: float) -> Literal["accepted", "duplicate"]:
        """Accept a weights version once.

        Raises:
            Refused: it is not the next version, diverged, or differs from the stored one.
        """
        if is_known(self, version):
            return "duplicate"
        self.store.add_version(version, train_s)
        self.progress.latest_version = version.version
        self._keep_needed_weights()
        if self.progress.state == "finishing" and version.version == self.progress.iteration:
            self._issue_final_evaluation()
        return "accepted"

    def _keep_needed_weights(self) -> None:
        """Delete weights, optimizer states and evicted episodes that are no longer needed."""
        latest = self.progress.latest_version
        # A run that is resumed after its end restores its cancelled commands.
        wanted = self.open_commands() + self.store.commands(cancelled=True)
        needed = {c.weights_version for c in wanted} | {latest, self.progress.best_version}
        needed |= self.auditor.versions
        # Evaluated versions are for later use, e.g. by `udrl play`.
        most = self.budget.keep_versions
        needed |= self._evaluated if most is None else set(nlargest(most, self._evaluated))
        self.store.drop_weights(v for v in self.store.versions_kept() if v not in needed)
        self.store.drop_optimizers(latest)
        # The learner that trains version latest + 1 needs the buffer after iteration `latest`.
        self.store.remove_evicted(latest)
