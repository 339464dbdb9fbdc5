"""The replay service: its replies to services that wait."""

from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest

from tests.replay.synthetic import create, join, work
from udrl.config import Budget
from udrl_proto import verbs
from udrl_proto.memory_transport import Exchange, MemoryTransport
from udrl_proto.messages import CommandsReply, CommandsRequest
from udrl_replay.replay_service import ReplayService


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
