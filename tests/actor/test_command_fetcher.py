"""The fetcher with a scripted replay service."""

import threading
from collections.abc import Callable, Iterator

import pytest

from tests.proto.scripted import Scripted
from udrl.actions import Categorical
from udrl.commands import Command
from udrl.config import Config, build, flat
from udrl.environments import EnvironmentSpec
from udrl.errors import Refused
from udrl.graph import acting_graph
from udrl.inference import probe_weights
from udrl.spaces import Vector
from udrl.streams import Purpose, stream_key
from udrl.weights import encode_weights
from udrl_actor.command_fetcher import Assignment, CommandFetcher
from udrl_proto import PROTOCOL, key_expressions, verbs
from udrl_proto.messages import (
    CommandsReply,
    CommandsRequest,
    Hello,
    JoinReply,
    JoinRequest,
    Message,
    Problem,
    Wait,
    WeightsMessage,
)
from udrl_proto.replay_client import ReplayClient
from udrl_proto.transport import Declaration
from whole_run import wait_for

CONFIG = build(Config, {"environment": "Synthetic-v0", "hidden": [4, 4]})
SPEC = EnvironmentSpec(
    observation_space=Vector(size=2), action_space=Categorical(n=3), max_episode_steps=4
)
GRAPH = acting_graph(CONFIG.network, SPEC)
HELLO = Hello(
    protocol=PROTOCOL, software="0", run_id="scripted", settings=flat(CONFIG), environment=SPEC,
    graph=GRAPH,
)  # fmt: skip
JOIN = JoinRequest(
    role="actor", id="a", host="h", pid=1, software="0", environments=2, numerics_class="c",
    environment=SPEC,
)  # fmt: skip
WEIGHTS = encode_weights(probe_weights(GRAPH))
DEADLINE_S = 10.0


def command(number: int, version: int = 0) -> Command:
    return Command(
        id=number,
        kind="explore",
        desired_return=1.0,
        desired_horizon=4,
        environment_seed=1_000_000,
        stream_key=stream_key(1, Purpose.EPISODE, 1, number),
        weights_version=version,
        max_steps=4,
    )


class Assigns:
    """Assigns commands in reply to one request after another; then there are none."""

    def __init__(self, *answers: Message) -> None:
        self._answers = list(answers)

    def __call__(self, request: CommandsRequest) -> Message:
        if self._answers:
            return self._answers.pop(0)
        return CommandsReply(wait=Wait(on="nothing", retry_after_s=0.05))


@pytest.fixture
def replay() -> Scripted:
    scripted = Scripted(HELLO.run_id)
    scripted.answers(verbs.JOIN, lambda _: JoinReply())
    scripted.answers(verbs.WEIGHTS, lambda r: WeightsMessage(version=r.version, weights=WEIGHTS))
    return scripted


@pytest.fixture
def start(replay: Scripted) -> Iterator[Callable[..., CommandFetcher]]:
    stop = threading.Event()
    started: list[CommandFetcher] = []

    def begin(*answers: Message) -> CommandFetcher:
        replay.answers(verbs.COMMANDS, Assigns(*answers))
        client = ReplayClient(replay.transport, HELLO.run_id, "actor a", stop)
        fetcher = CommandFetcher(replay.transport, HELLO, JOIN, client, stop)
        fetcher.start()
        started.append(fetcher)
        return fetcher

    yield begin
    stop.set()
    for fetcher in started:
        fetcher.join(DEADLINE_S)
        assert not fetcher.is_alive()


def take(fetcher: CommandFetcher, n: int) -> list[Assignment]:
    """Take until ``n`` assignments have arrived."""
    assignments: list[Assignment] = []

    def more() -> bool:
        assignments.extend(fetcher.take(n - len(assignments), 0, wait_s=0.5))
        return len(assignments) == n

    wait_for(more, "assignments", DEADLINE_S)
    return assignments


def test_commands_are_assigned_with_their_weights(
    replay: Scripted, start: Callable[..., CommandFetcher]
) -> None:
    fetcher = start(CommandsReply(commands=(command(1), command(2, version=3))))
    random, acting = take(fetcher, 2)
    assert (random.command, random.behavior) == (command(1), None)
    assert acting.command == command(2, version=3)
    assert acting.behavior is not None
    assert encode_weights(acting.behavior.weights) == WEIGHTS
    assert [request.version for request in replay.requests(verbs.WEIGHTS)] == [3]


def test_published_weights_are_not_requested(
    replay: Scripted, start: Callable[..., CommandFetcher]
) -> None:
    fetcher = start()
    fetcher.take(1, 0, wait_s=0.0)
    wait_for(lambda: replay.requests(verbs.COMMANDS), "a request", DEADLINE_S)
    replay.publish(key_expressions.NEW_WEIGHTS, WeightsMessage(version=3, weights=WEIGHTS))
    replay.answers(verbs.COMMANDS, Assigns(CommandsReply(commands=(command(1, version=3),))))
    (assignment,) = take(fetcher, 1)
    assert assignment.behavior is not None
    assert replay.requests(verbs.WEIGHTS) == []


def test_invalid_published_weights_are_ignored(
    replay: Scripted, start: Callable[..., CommandFetcher]
) -> None:
    fetcher = start()
    fetcher.take(1, 0, wait_s=0.0)
    wait_for(lambda: replay.requests(verbs.COMMANDS), "a request", DEADLINE_S)
    replay.publish(key_expressions.NEW_WEIGHTS, WeightsMessage(version=3, weights=b"damaged"))
    replay.answers(verbs.COMMANDS, Assigns(CommandsReply(commands=(command(1, version=3),))))
    (assignment,) = take(fetcher, 1)
    assert assignment.behavior is not None
    assert encode_weights(assignment.behavior.weights) == WEIGHTS


def test_actor_joins_a_restarted_service_again(
    replay: Scripted, start: Callable[..., CommandFetcher]
) -> None:
    unknown = Problem(code="join_first", message="who is that?")
    fetcher = start(unknown, CommandsReply(commands=(command(1),)))
    assert [assignment.command.id for assignment in take(fetcher, 1)] == [1]
    assert replay.requests(verbs.JOIN) == [JOIN]


def test_command_with_deleted_weights_is_dropped(
    replay: Scripted, start: Callable[..., CommandFetcher]
) -> None:
    gone = Problem(code="unknown_version", message="weights version 3 is not kept")
    replay.answers(verbs.WEIGHTS, lambda _: gone)
    fetcher = start(CommandsReply(commands=(command(1, version=3), command(2))))
    assert [assignment.command.id for assignment in take(fetcher, 1)] == [2]
    # The next request no longer lists it as running.
    fetcher.take(1, 0, wait_s=0.0)
    wait_for(
        lambda: replay.requests(verbs.COMMANDS)[-1].running == (2,), "the next request", DEADLINE_S
    )


def test_acknowledged_command_is_no_longer_running(
    replay: Scripted, start: Callable[..., CommandFetcher]
) -> None:
    fetcher = start(CommandsReply(commands=(command(1), command(2))))
    take(fetcher, 2)
    fetcher.take(1, 1, wait_s=0.0)
    fetcher.note_acknowledged(1)
    wait_for(
        lambda: replay.requests(verbs.COMMANDS)[-1].running == (2,), "the next request", DEADLINE_S
    )


def test_refusal_is_raised_in_the_acting_loop(
    replay: Scripted, start: Callable[..., CommandFetcher]
) -> None:
    fetcher = start(Problem(code="quarantined", message="a false episode"))
    fetcher.take(1, 0, wait_s=0.0)
    wait_for(lambda: fetcher.error, "the error", DEADLINE_S)
    assert isinstance(fetcher.error, Refused)
    assert fetcher.error.code == "quarantined"


def test_failed_subscription_is_raised_in_the_acting_loop(
    replay: Scripted, start: Callable[..., CommandFetcher], monkeypatch: pytest.MonkeyPatch
) -> None:
    def subscribe(key: str, receive: Callable[[bytes], None]) -> Declaration:
        raise RuntimeError("the session is closed")

    monkeypatch.setattr(replay.transport, "subscribe", subscribe)
    fetcher = start()
    fetcher.join(DEADLINE_S)
    assert str(fetcher.error) == "the session is closed"


def test_error_of_the_outbox_ends_the_fetcher(start: Callable[..., CommandFetcher]) -> None:
    fetcher, error = start(), Refused("quarantined", "a false episode")
    fetcher.fail(error)
    fetcher.join(DEADLINE_S)
    assert fetcher.error is error


def test_end_of_the_run_ends_the_fetcher(start: Callable[..., CommandFetcher]) -> None:
    fetcher = start(CommandsReply(ended=True))
    fetcher.take(1, 0, wait_s=DEADLINE_S)
    fetcher.join(DEADLINE_S)
    assert fetcher.ended
    assert fetcher.error is None
