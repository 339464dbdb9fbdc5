"""Audits: spot checks of the episodes that actors deliver.

An episode is a pure function of its command, so another actor of the same numerics class must
deliver the same bytes. A random share of commands is run again by a second actor; if the two
episodes differ, a third actor decides. The commands are chosen with the machine's entropy, not the
run's streams, so that an actor cannot predict them. Audits never change a result.
"""

import random
from collections import Counter
from collections.abc import Callable, Container
from dataclasses import dataclass, field
from typing import NamedTuple

from udrl.commands import Command

#: Maximum number of open audits.
MOST_OPEN = 256


@dataclass
class Audit:
    """A command that is run by several actors.

    Attributes:
        numerics_class: numerics class of the first actor; the others must have the same.
        digests: digests of the delivered episodes, by actor.
        at: name of the actor that runs the command now; empty: none.
    """

    command: Command
    numerics_class: str
    digests: dict[str, bytes]
    at: str = ""

    @property
    def is_disputed(self) -> bool:
        """Whether two actors differ and a third must decide."""
        return len(set(self.digests.values())) > 1


class Verdict(NamedTuple):
    """The result of an audit with three actors.

    Attributes:
        wrong_actor: the actor whose episode differs from the two that agree; None: all three
            differ.
    """

    wrong_actor: str | None


@dataclass
class Auditor:
    """Chooses commands to be run again, assigns them to actors, and compares the episodes.

    Open audits are only kept in memory, and dropped when the replay service ends.

    Attributes:
        rate: share of the accepted episodes that are audited, 0 to 1.
        draw: returns uniform numbers in [0, 1).
        open: undecided audits, by command id.
    """

    rate: float = 0.0
    draw: Callable[[], float] = field(default=random.SystemRandom().random)
    open: dict[int, Audit] = field(default_factory=dict)

    def maybe_audit(self, command: Command, actor: str, numerics_class: str, digest: bytes) -> None:
        """Audit an accepted episode with probability ``rate``."""
        if len(self.open) < MOST_OPEN and self.draw() < self.rate:
            self.open[command.id] = Audit(command, numerics_class, {actor: digest})

    def assign(
        self, actor: str, numerics_class: str, running: Container[int], wanted: int
    ) -> list[Command]:
        """Return commands for an actor to run again, at most ``wanted``.

        Args:
            actor: name of the actor.
            numerics_class: the actor's numerics class.
            running: ids of the commands that the actor holds.
            wanted: number of commands that it can start.
        """
        assigned: list[Command] = []
        for audit in self.open.values():
            if audit.at == actor and audit.command.id not in running:
                audit.at = ""  # it was lost
            fits = numerics_class == audit.numerics_class and actor not in audit.digests
            if len(assigned) < wanted and not audit.at and fits:
                audit.at = actor
                assigned.append(audit.command)
        return assigned

    def remove_actor(self, actor: str) -> None:
        """Take back the commands assigned to an actor that is gone."""
        for audit in self.open.values():
            if audit.at == actor:
                audit.at = ""

    def is_assigned(self, actor: str, command_id: int) -> bool:
        """Return whether an actor was assigned a command to run again."""
        return command_id in self.open and self.open[command_id].at == actor

    def compare(self, actor: str, command_id: int, digest: bytes) -> Verdict | None:
        """Compare an assigned actor's episode; return a verdict when there are three episodes.

        An audit whose first two episodes agree is closed.
        """
        audit = self.open[command_id]
        audit.at = ""
        audit.digests[actor] = digest
        if not audit.is_disputed:
            del self.open[command_id]
        if len(audit.digests) < 3:
            return None
        del self.open[command_id]
        count = Counter(audit.digests.values())
        odd = [name for name, held in audit.digests.items() if count[held] == 1]
        return Verdict(odd[0] if len(odd) == 1 else None)

    def stop(self) -> None:
        """Stop auditing."""
        self.rate = 0.0
        self.open.clear()

    @property
    def versions(self) -> set[int]:
        """Weights versions that open audits need."""
        return {audit.command.weights_version for audit in self.open.values()}
