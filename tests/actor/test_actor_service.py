"""The actor service with a scripted replay service."""

import threading

import pytest

from tests.proto.scripted import Scripted
from udrl.acting import EpisodeGenerator
from udrl.config import Config, flat
from udrl.graph import acting_graph
from udrl_actor import actor_service
from udrl_actor.actor_service import ActorService
from udrl_actor.command_fetcher import CommandFetcher
from udrl_proto import PROTOCOL, verbs
from udrl_proto.messages import CommandsReply, CommandsRequest, Hello, JoinReply, JoinRequest

CONFIG = Config(environment="Figure2-v0", max_return=2.0)
SPEC = EpisodeGenerator(CONFIG, 1).spec
HELLO = Hello(
    protocol=PROTOCOL, software="0", run_id="scripted", settings=flat(CONFIG), environment=SPEC,
    graph=acting_graph(CONFIG.network, SPEC),
)  # fmt: skip


class Watchdog:
    """Stands for :mod:`faulthandler`, and ends no process."""

    def __init__(self) -> None:
        self.is_armed = False

    def dump_traceback_later(self, seconds: float, *, exit: bool) -> None:  # noqa: A002
        self.is_armed = True

    def cancel_dump_traceback_later(self) -> None:
        self.is_armed = False


def test_watchdog_is_armed_only_while_environments_are_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    replay, stop, watchdog = Scripted(HELLO.run_id), threading.Event(), Watchdog()
    armed: list[tuple[str, bool]] = []

    def note(what: str) -> None:
        armed.append((what, watchdog.is_armed))

    def probe(generator: EpisodeGenerator) -> str:
        note("probe")
        return ""

    def join(request: JoinRequest) -> JoinReply:
        note("join")
        return JoinReply()

    def commands(request: CommandsRequest) -> CommandsReply:
        note("act")
        return CommandsReply(ended=True)

    replay.answers(verbs.JOIN, join)
    replay.answers(verbs.COMMANDS, commands)
    monkeypatch.setattr(actor_service, "faulthandler", watchdog)
    monkeypatch.setattr(actor_service, "environment_digest", probe)
    monkeypatch.setattr(CommandFetcher, "join", lambda fetcher, timeout: note("end"))
    ActorService(replay.transport, HELLO, "a", 1, stop, hang_s=1.0).run()
    assert armed == [("probe", True), ("join", False), ("act", True), ("end", False)]
    assert not watchdog.is_armed
