"""The waits of a run's services, for its status."""

from udrl_proto.reports import Waiting

#: Maximum number of waits to remember.
_MOST_WAITS = 10_000


class Waits:
    """The services that wait: for what, why, and since when."""

    def __init__(self) -> None:
        self._waits: dict[str, tuple[str, str, float]] = {}

    def begin(self, who: str, on: str, why: str, now: float) -> None:
        """Note that a service waits; its wait continues if it is for the same reason."""
        held = self._waits.get(who)
        if held is None or held[:2] != (on, why):
            self._waits[who] = on, why, now
            if len(self._waits) > _MOST_WAITS:
                del self._waits[next(iter(self._waits))]

    def end(self, who: str) -> None:
        """Note that a service no longer waits."""
        self._waits.pop(who, None)

    def list(self, now: float) -> tuple[Waiting, ...]:
        """Return all waits."""
        return tuple(
            Waiting(who=who, on=on, why=why, seconds=round(now - since, 3))
            for who, (on, why, since) in sorted(self._waits.items())
        )
