"""Quarantine: actors excluded from a run, and the reasons."""

import logging
from collections import Counter

from udrl.errors import Refused
from udrl_proto.text import printable
from udrl_replay.store import Store

log = logging.getLogger("udrl")

#: Invalid deliveries after which an actor is quarantined.
OFFENCES = 10
#: Maximum number of actors whose offences are counted.
_MOST_COUNTED = 1000
#: Maximum number of quarantined actors to remember; the oldest is forgotten first.
_MOST_REMEMBERED = 1000


class Quarantine:
    """The quarantined actors of a run, kept in its store; counts of offences are only in memory.

    Attributes:
        reasons: reason for the quarantine, by actor.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._offences: Counter[str] = Counter()
        self.reasons = store.fact("quarantined", dict[str, str], {})

    def __contains__(self, actor: str) -> bool:
        return actor in self.reasons

    def add(self, actor: str, why: str) -> None:
        """Quarantine an actor."""
        why = printable(why)
        log.warning("actor %s is quarantined: %s", actor, why)
        self.reasons[actor] = why[:1000]
        if len(self.reasons) > _MOST_REMEMBERED:
            del self.reasons[next(iter(self.reasons))]
        self._store.set_fact("quarantined", self.reasons)

    def count(self, actor: str) -> bool:
        """Count an offence; return whether the actor must be quarantined."""
        if actor in self.reasons:
            return False
        counts = self._offences
        if actor not in counts and len(counts) >= _MOST_COUNTED:
            del counts[min(counts, key=counts.__getitem__)]
        counts[actor] += 1
        return counts[actor] >= OFFENCES

    def refusal(self, actor: str) -> Refused:
        """Return the refusal for a quarantined actor."""
        return Refused(
            "quarantined",
            f"actor {actor} is quarantined: {self.reasons[actor]}; repair or remove it, then "
            f"restart it",
        )
