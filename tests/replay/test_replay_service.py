"""The replay service: its replies to services that wait, and the lag of weights."""

from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from tests.replay.synthetic import (
    arrive,
    create,
    episode,
    join,
    train_next,
    weights_of,
    work,
)
from udrl.config import Budget
from udrl_proto import verbs
from udrl_proto.memory_transport import Exchange, MemoryTransport
from udrl_proto.messages import CommandsReply, CommandsRequest, VersionMessage
from udrl_proto.reports import StatusRequest
from udrl_replay.replay_service import ReplayService, _Delivery


@pytest.fixture
def service(tmp_path: Path, stack: ExitStack) -> Iterator[ReplayService]:
    """Serves a run with a small budget."""
    store = stack.enter_context(closing(create(tmp_path)))
    transport, budget = MemoryTransport(Exchange()), Budget(max_env_steps=20)
    with closing(ReplayService(transport, store, budget, tmp_path)) as one:
        yield one


def ask(service: ReplayService, verb: verbs.Verb[Any, Any], request: Any, now: float = 0.0) -> Any:
    """Return the reply to a request."""
    with service.run.store.transaction():
        return service._handlers[verb.name](request, now)


def test_idle_actors_wait_for_the_final_evaluation(service: ReplayService) -> None:
    run = service.run
    while run.progress.state == "running":
        work(run)
    for name in ("a", "b", "idle"):
        ask(service, verbs.JOIN, join(name))
        reply: CommandsReply = ask(service, verbs.COMMANDS, CommandsRequest(actor=name, wanted=4))
    assert reply.wait is not None
    assert reply.wait.on == "actors: the final evaluation"


def test_lag_of_a_version_is_the_time_to_its_first_command(
    tmp_path: Path, stack: ExitStack
) -> None:
    store = stack.enter_context(closing(create(tmp_path, lead=2)))
    service = ReplayService(MemoryTransport(Exchange()), store, Budget(), tmp_path)
    stack.enter_context(closing(service))
    run = service.run
    ask(service, verbs.JOIN, join("a"))
    ask(service, verbs.JOIN, replace(join("l"), role="learner", environment=None))
    # Version 1 is accepted at 10 s, version 2 at 20 s, version 3 at 30 s.
    for iteration in range(3):
        for item in list(run.dispatcher.outstanding.values()):
            if item.command.iteration == iteration:
                done = episode(item.command, weights_of(run, item.command))
                ask(service, verbs.EPISODE, arrive(done))
        version = train_next(run)
        message = VersionMessage(
            learner="l", version=version.version, weights=version.weights,
            optimizer=version.optimizer, loss=version.loss, train_s=0.0,
        )  # fmt: skip
        ask(service, verbs.VERSION, _Delivery(message, version), 10.0 * version.version)
    accepted_at: dict[int, float] = {}
    running: list[int] = []
    for now in range(40, 40 + len(run.dispatcher.outstanding)):
        request = CommandsRequest(actor="a", wanted=1, running=tuple(running))
        (command,) = ask(service, verbs.COMMANDS, request, now).commands
        running.append(command.id)
        lag_s = ask(service, verbs.STATUS, StatusRequest(), now).weights_lag_s
        accepted_at.setdefault(command.weights_version, now - lag_s)
    assert accepted_at == {1: 10.0, 2: 20.0, 3: 30.0}
