"""Assigning commands: evenly among actors, and again if an actor is gone or too slow.

This state is only in memory. Every request for commands lists those that the actor holds, so a
restarted replay service knows them again after one request of each actor.

An environment that hangs or crashes ends its actor without a report of the command that caused it.
So a command that several actors held when they vanished is run alone; an actor that vanishes then
identifies the command, which counts as a failure.
"""

import heapq
import math
import random
from collections import Counter
from collections.abc import Container, Iterable
from dataclasses import dataclass, field

from msgspec.structs import replace

from udrl.acting import MAX_FAILURES
from udrl.commands import Command
from udrl_proto.messages import CommandsRequest, JoinRequest

#: Multiple of the expected duration after which a command is a straggler.
STRAGGLER = 3.0
#: Maximum number of commands in one reply, to keep the message small.
MAX_ASSIGNED = 4096
#: Seconds of silence after which an actor without a liveliness token is forgotten.
SILENCE_S = 30.0
#: Maximum number of actors that have joined; each costs a little memory.
MOST_ACTORS = 10_000
#: Number of actors that vanished while they held a command, after which it is run alone.
SUSPICIOUS = 3


@dataclass
class Outstanding:
    """A command without an episode.

    Attributes:
        holders: names of the actors that hold it, and the time it was assigned to each, seconds.
        was_assigned: whether it was ever assigned to an actor.
        failures: names of the actors that reported a failure, one entry per failure.
        vanished: names of the actors that vanished while they held it, and whether it was run
            alone then.
    """

    command: Command
    holders: dict[str, float] = field(default_factory=dict)
    was_assigned: bool = False
    failures: list[str] = field(default_factory=list)
    vanished: dict[str, bool] = field(default_factory=dict)

    @property
    def is_suspect(self) -> bool:
        """Whether it must be run alone, because too many actors vanished with it."""
        return len(self.vanished) >= SUSPICIOUS

    @property
    def ended(self) -> list[str]:
        """Names of the actors that vanished while they ran it alone; each counts as a failure."""
        return [name for name, alone in self.vanished.items() if alone]


@dataclass
class Actor:
    """An actor that has joined.

    Attributes:
        join: its request to join.
        last_seen: time of its last message, seconds.
        request: its last request for commands, without those that it was running.
        holds: ids of the commands that it holds.
        reruns: number of commands assigned to it that had been assigned before, to any actor.
        failures: number of commands that failed in its environments.
    """

    join: JoinRequest
    last_seen: float
    request: CommandsRequest
    holds: set[int] = field(default_factory=set)
    reruns: int = 0
    failures: int = 0


class Dispatcher:
    """Assigns outstanding commands to the actors that have joined."""

    def __init__(self) -> None:
        self.outstanding: dict[int, Outstanding] = {}
        self.actors: dict[str, Actor] = {}
        self._unassigned: list[int] = []  # a heap; may hold ids that are no longer unassigned
        self._of_iteration: Counter[int] = Counter()
        self._of_version: Counter[int] = Counter()
        self._duration_s = 0.0

    def add(self, commands: Iterable[Command]) -> None:
        """Add outstanding commands."""
        for command in commands:
            self.outstanding[command.id] = Outstanding(command)
            self._of_iteration[command.iteration] += 1
            self._of_version[command.weights_version] += 1
            heapq.heappush(self._unassigned, command.id)

    def remove_command(self, command_id: int, now: float | None = None) -> None:
        """Remove an outstanding command; if it is done, ``now`` serves to measure its duration."""
        item = self.outstanding.pop(command_id)
        command = item.command
        for counter, key in (
            (self._of_iteration, command.iteration),
            (self._of_version, command.weights_version),
        ):
            counter[key] -= 1
            if not counter[key]:
                del counter[key]
        for name in item.holders:
            if name in self.actors:
                self.actors[name].holds.discard(command_id)
        if now is not None and item.holders:
            took = now - min(item.holders.values())
            self._duration_s += (took - self._duration_s) * (0.05 if self._duration_s else 1.0)

    def outstanding_in(self, iteration: int) -> int:
        """Return the number of outstanding commands of an iteration."""
        return self._of_iteration[iteration]

    def join(self, request: JoinRequest, now: float) -> None:
        """Add an actor; one that rejoins loses the commands that it held."""
        self.remove_actor(request.id)
        nothing = CommandsRequest(actor=request.id, wanted=0)
        self.actors[request.id] = Actor(request, now, nothing)

    def remove_actor(self, name: str, *, vanished: bool = True) -> list[Outstanding]:
        """Remove an actor, whose commands are assigned again; return those that it vanished with.

        Args:
            name: the actor.
            vanished: whether a command may be the cause. False: the actor was refused.
        """
        actor = self.actors.pop(name, None)
        held = [] if actor is None else [self.outstanding[i] for i in sorted(actor.holds)]
        for item in held:
            if vanished:
                item.vanished[name] = len(held) == 1 and item.is_suspect
            self._put_back(item.command.id, name)
        return held if vanished else []

    def silent_actors(self, here: Container[str], now: float) -> list[str]:
        """Return the actors that have been silent for too long, except those that are ``here``."""
        quiet = [n for n, a in self.actors.items() if now - a.last_seen > SILENCE_S]
        return [name for name in quiet if name not in here]

    def is_hopeless(self, command_id: int) -> bool:
        """Return whether a command failed so often that the run must stop.

        A single actor may be at fault itself, so another must have tried the command, too, unless
        there is none.
        """
        item = self.outstanding[command_id]
        failures = [*item.failures, *item.ended]
        untried = self.actors.keys() - {*item.failures, *item.vanished}
        return len(failures) >= MAX_FAILURES and (len(set(failures)) >= 2 or not untried)

    def _put_back(self, command_id: int, name: str) -> None:
        """Note that an actor no longer holds a command; without holders, it is unassigned again."""
        item = self.outstanding.get(command_id)
        if item is not None and item.holders.pop(name, None) is not None and not item.holders:
            heapq.heappush(self._unassigned, command_id)

    def assign(self, request: CommandsRequest, latest_version: int, now: float) -> list[Command]:
        """Assign commands to an actor that has joined, at most what it wants and its fair share."""
        actor = self.actors[request.actor]
        # Without the commands that it lists: 65,536 of them take 2 MB.
        actor.last_seen, actor.request = now, replace(request, running=())
        running = {i for i in request.running if i in self.outstanding}
        for lost in actor.holds - running:
            self._put_back(lost, request.actor)
        for known in running - actor.holds:
            self.outstanding[known].holders.setdefault(request.actor, now)
            self.outstanding[known].was_assigned = True
            self.outstanding[known].vanished.pop(request.actor, None)  # it was only cut off
        actor.holds = running
        if any(self.outstanding[i].is_suspect for i in running):
            return []
        if request.wanted and not running:
            suspect = self._suspect(latest_version)
            if suspect is not None:
                return [self._give(suspect, actor, now)]

        in_play = sum(n for v, n in self._of_version.items() if v <= latest_version)
        share = math.ceil(in_play / len(self.actors)) - len(running)
        assigned: list[Command] = []
        while self._unassigned and len(assigned) < min(request.wanted, share, MAX_ASSIGNED):
            item = self.outstanding.get(self._unassigned[0])
            if item is not None and item.command.weights_version > latest_version:
                break
            heapq.heappop(self._unassigned)
            if item is not None and not item.holders and not item.is_suspect:
                assigned.append(self._give(item, actor, now))
        if not assigned and request.wanted and not running and request.spare_cores >= 1:
            assigned.extend(self._straggler(actor, latest_version, now))
        return assigned

    def _suspect(self, latest_version: int) -> Outstanding | None:
        """Return a command that must be run alone; None: there is none."""
        suspects = (i for i in self.outstanding.values() if i.is_suspect and not i.holders)
        ready = (i for i in suspects if i.command.weights_version <= latest_version)
        return next(ready, None)

    def _give(self, item: Outstanding, actor: Actor, now: float) -> Command:
        """Assign an outstanding command to an actor, and return it."""
        actor.reruns += item.was_assigned
        item.was_assigned = True
        item.holders[actor.join.id] = now
        actor.holds.add(item.command.id)
        return item.command

    def _straggler(self, actor: Actor, latest_version: int, now: float) -> Iterable[Command]:
        """Yield the most overdue command of another actor, for an idle actor."""
        overdue = [
            (min(item.holders.values()), i)
            for i, item in self.outstanding.items()
            if len(item.holders) == 1 and item.command.weights_version <= latest_version
        ]
        if overdue and self._duration_s:
            since, command_id = min(overdue)
            if now - since > STRAGGLER * self._duration_s:
                yield self._give(self.outstanding[command_id], actor, now)

    def holds(self, name: str, command_id: int) -> bool:
        """Return whether an actor holds a command."""
        item = self.outstanding.get(command_id)
        return item is not None and name in item.holders

    def note_seen(self, name: str, now: float) -> None:
        """Note the time of a message from an actor, if it has joined."""
        if name in self.actors:
            self.actors[name].last_seen = now

    def note_failure(self, command_id: int, name: str) -> None:
        """Note that a command failed in an actor's environment."""
        item = self.outstanding[command_id]
        item.failures.append(name)
        if name in self.actors:
            self.actors[name].holds.discard(command_id)
            self.actors[name].failures += 1
        self._put_back(command_id, name)

    def retry_after_s(self) -> float:
        """Return the pause before an actor's next request: longer in a large fleet, with jitter."""
        return (0.25 + 0.02 * len(self.actors)) * random.uniform(0.75, 1.25)  # noqa: S311
