"""Whom to believe: spot checks of what actors deliver.

An episode is a pure function of its command, so another actor of the same numerics class must
deliver the same bytes. A random share of commands is carried out again by a second actor; where the
two differ, a third decides. Which commands these are is drawn from the machine's entropy, not from
the run's streams: who lies must not be able to tell when it is safe. Nothing here changes a result.
"""

import random
from collections import Counter
from collections.abc import Callable, Container
from dataclasses import dataclass, field
from typing import NamedTuple

from udrl.commands import Command

#: Audits that are open at once; while there are so many no new ones begin.
MOST_OPEN = 256


@dataclass
class Audit:
    """A command that several actors carry out.

    Attributes:
        numerics_class: of the actor that delivered it first; the others are of the same.
        digests: what actors delivered.
        at: the actor that carries it out now; empty: nobody does.
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
    """What three actors' episodes of one command say.

    Attributes:
        liar: the one that differs from two that agree; None: all three differ.
    """

    liar: str | None


@dataclass
class Auditor:
    """Chooses commands to be carried out again, hands them out, and compares.

    All of this is memory: audits that are open when the replay service ends are given up.

    Attributes:
        rate: share of the accepted episodes that are checked, 0 to 1.
        draw: returns uniform numbers in [0, 1).
        open: those that are not decided, by command id.
    """

    rate: float = 0.0
    draw: Callable[[], float] = field(default=random.SystemRandom().random)
    open: dict[int, Audit] = field(default_factory=dict)

    def maybe_audit(self, command: Command, actor: str, numerics_class: str, digest: bytes) -> None:
        """Audit an accepted episode, with the probability ``rate``."""
        if len(self.open) < MOST_OPEN and self.draw() < self.rate:
            self.open[command.id] = Audit(command, numerics_class, {actor: digest})

    def assign(
        self, actor: str, numerics_class: str, running: Container[int], wanted: int
    ) -> list[Command]:
        """Return commands for an actor to carry out again, at most ``wanted``.

        Args:
            actor: who asks.
            numerics_class: its own.
            running: ids of the commands that it holds.
            wanted: how many it could start.
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
        """Give to others what an actor that is gone was to carry out."""
        for audit in self.open.values():
            if audit.at == actor:
                audit.at = ""

    def is_assigned(self, actor: str, command_id: int) -> bool:
        """Say whether an actor is to carry out a command again."""
        return command_id in self.open and self.open[command_id].at == actor

    def compare(self, actor: str, command_id: int, digest: bytes) -> Verdict | None:
        """Take in what an actor delivered that it was assigned; return the verdict if three differ.

        An audit in which the first two agree is over: it is no longer open.
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
        """Audit no more."""
        self.rate = 0.0
        self.open.clear()

    @property
    def versions(self) -> set[int]:
        """Weights versions that open audits need."""
        return {audit.command.weights_version for audit in self.open.values()}
