"""Consequences of audits and offences: quarantine, and failure of the run."""

import logging
from collections.abc import Callable
from typing import Literal

import msgspec

from udrl.commands import Command
from udrl_proto.messages import CommandsRequest
from udrl_replay.arrival import Arrival
from udrl_replay.dispatching import MAX_ASSIGNED
from udrl_replay.quarantine import OFFENCES
from udrl_replay.run_state import RunState

log = logging.getLogger("udrl")


class Enforcement:
    """Audits and quarantines the actors of a run.

    Args:
        run: the run with its auditor and quarantine.
        remove_actor: removes an actor that has not vanished; its commands are assigned again.
    """

    def __init__(self, run: RunState, remove_actor: Callable[[str], None]) -> None:
        self._run = run
        self._remove_actor = remove_actor
        # By actor, the first iteration that has an episode of it.
        self._entered = run.store.fact("entered", dict[str, int], {})

    def assign(self, request: CommandsRequest) -> tuple[list[Command], CommandsRequest]:
        """Return commands to audit, and the request reduced by their number."""
        actor = self._run.dispatcher.actors[request.actor]
        again = self._run.auditor.assign(
            actor.join.id, actor.join.numerics_class, request.running,
            min(request.wanted, MAX_ASSIGNED),
        )  # fmt: skip
        actor.reruns += len(again)
        return again, msgspec.structs.replace(request, wanted=request.wanted - len(again))

    def record_delivery(self, command: Command, arrival: Arrival) -> None:
        """Record an actor's first delivery, and choose whether to audit the episode."""
        run, name = self._run, arrival.actor
        if name not in self._entered:
            self._entered[name] = command.iteration
            run.store.set_fact("entered", self._entered)
        if name in run.dispatcher.actors:
            numerics_class = run.dispatcher.actors[name].join.numerics_class
            run.auditor.maybe_audit(command, name, numerics_class, arrival.digest)

    def compare(self, arrival: Arrival) -> Literal["duplicate"]:
        """Compare an audit's episode with those of the other actors, and act on the verdict."""
        run, command_id = self._run, arrival.entry.id
        run.progress.duplicate += 1
        verdict = run.auditor.compare(arrival.actor, command_id, arrival.digest)
        if verdict is None and command_id in run.auditor.open:
            log.warning(
                "two actors differ on command %d; a third run decides which is wrong", command_id
            )
            if run.progress.state == "ended":
                self.mark_undecided()
        elif verdict is None:
            run.progress.agreed += 1
        elif verdict.wrong_actor is None:
            run.auditor.stop()
            run.progress.audit = 0.0
            run.mark_inexact(
                f"three actors ran command {command_id} and all their episodes differ; the "
                f"environment {run.config.environment} or their machines are not deterministic; "
                f"audits are stopped"
            )
        else:
            self._quarantine_wrong_actor(verdict.wrong_actor, command_id)
        return "duplicate"

    def _quarantine_wrong_actor(self, actor: str, command_id: int) -> None:
        """Quarantine an actor that delivered a false episode; the run may have learned from it."""
        why = f"its episode of command {command_id} differs from those of two other actors"
        self.quarantine(actor, why)
        progress = self._run.progress
        if actor not in self._entered or progress.deceived:
            return
        found = (
            f"actor {actor} delivered a false episode: {why}. Since iteration "
            f"{self._entered[actor]} the run has learned from its episodes"
        )
        if progress.state == "ended":
            self._run.mark_inexact(found)
            return
        # Also if the run has failed for another reason: otherwise it could be resumed.
        progress.state = "failed"
        progress.deceived = True
        progress.problem = f"{found}; start a new run without it, in another --run-dir"
        log.error("%s", progress.problem)

    def mark_undecided(self, *, stops: bool = False) -> None:
        """Mark the run inexact if two actors differ on a command and no third will decide.

        Args:
            stops: whether the replay service stops, so that not even an actor that is running the
                command now can decide.
        """
        for command_id, audit in self._run.auditor.open.items():
            if audit.is_disputed and (stops or not audit.at):
                self._run.mark_inexact(
                    f"two actors ran command {command_id} and their episodes differ; no third "
                    f"actor decided which is wrong"
                )

    def count_offence(self, actor: str, what: str) -> None:
        """Count an invalid delivery; quarantine the actor after too many."""
        if self._run.quarantined.count(actor):
            self.quarantine(actor, f"it delivered {OFFENCES} invalid episodes, the last: {what}")

    def quarantine(self, actor: str, why: str) -> None:
        """Quarantine an actor; its commands are assigned again."""
        self._run.quarantined.add(actor, why)
        self._remove_actor(actor)
