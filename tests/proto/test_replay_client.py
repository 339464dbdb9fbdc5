"""Requests and replies: at-least-once delivery, with deadlines."""

import dataclasses
import logging
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any, cast

import pytest
import zenoh

from udrl.errors import Interrupted, InvalidMessage, Refused, Unreachable
from udrl_proto import key_expressions, replay_client, verbs
from udrl_proto.codec import SMALL, encode
from udrl_proto.inbox import Inbox
from udrl_proto.messages import (
    Acknowledged,
    FailureMessage,
    Problem,
    StateReply,
    StateRequest,
)
from udrl_proto.replay_client import ReplayClient
from udrl_proto.serving import ReceivedRequest, serve
from udrl_proto.session import connect
from udrl_proto.transport import EncodedReply, Transport
from udrl_proto.zenoh_transport import ZenohTransport

RUN = "run"
REQUEST = StateRequest(learner="l")
ANSWER = StateReply(version=3, weights=b"w", optimizer=b"o")
WAIT_S = 10.0
STATE = dataclasses.replace(verbs.STATE, limit=100)

Received = Inbox[ReceivedRequest]
Ask = Callable[..., Future[StateReply]]


@pytest.fixture
def inbox(router: zenoh.Session) -> Received:
    """Requests that arrive at a service on the router."""
    inbox: Received = Inbox(100, 1000)
    serve(ZenohTransport(router), RUN, inbox, [STATE])
    return inbox


@pytest.fixture
def learner(client: zenoh.Session) -> ReplayClient:
    return ReplayClient(ZenohTransport(client), RUN, "learner l", patience_s=WAIT_S)


@pytest.fixture
def ask(learner: ReplayClient) -> Iterator[Ask]:
    """Sends a request from another thread."""
    with ThreadPoolExecutor(1) as thread:

        def submit(request: Any = REQUEST, limit: int = SMALL) -> Future[StateReply]:
            return thread.submit(
                lambda: learner.request(
                    dataclasses.replace(verbs.STATE, reply_limit=limit), request
                )
            )

        yield submit


def first(inbox: Inbox[Any]) -> Any:
    (received,) = inbox.take(1, 1, WAIT_S)
    return received


def answer_each(session: zenoh.Session, *answers: Callable[[zenoh.Query], None]) -> None:
    """Reply to each query with the next function."""
    remaining = iter(answers)
    session.declare_queryable(
        key_expressions.key(RUN, "state"), lambda query: next(remaining)(query)
    )


def answer(query: zenoh.Query) -> None:
    with query:
        query.reply(key_expressions.key(RUN, "state"), encode(ANSWER))


def test_reply_is_returned(inbox: Received, ask: Ask) -> None:
    future = ask()
    received = first(inbox)
    assert (received.verb, received.request) == (STATE, REQUEST)
    received.reply(ANSWER)
    assert future.result(WAIT_S) == ANSWER


def test_request_may_be_encoded_in_advance(inbox: Received, ask: Ask) -> None:
    future = ask(encode(REQUEST))
    received = first(inbox)
    assert received.request == REQUEST
    received.reply(ANSWER)
    assert future.result(WAIT_S) == ANSWER


def test_problem_is_raised_with_its_code(inbox: Received, ask: Ask) -> None:
    future = ask()
    first(inbox).reply(Problem(code="rewind", message="version 3 is next"))
    with pytest.raises(Refused, match="version 3 is next") as caught:
        future.result(WAIT_S)
    assert caught.value.code == "rewind"


def test_unanswered_request_is_retried(router: zenoh.Session, learner: ReplayClient) -> None:
    answer_each(router, zenoh.Query.drop, zenoh.Query.drop, answer)
    assert learner.request(verbs.STATE, REQUEST) == ANSWER


def test_timed_out_request_is_retried(
    router: zenoh.Session, learner: ReplayClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replay_client, "ATTEMPT_S", 0.1)
    hanging: list[zenoh.Query] = []
    answer_each(router, hanging.append, answer)
    assert learner.request(verbs.STATE, REQUEST) == ANSWER
    hanging.pop().drop()


def test_timeout_doubles_while_there_is_no_reply(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    attempts: list[float] = []

    class SilentTransport:
        def query(self, key: str, data: bytes, timeout_s: float) -> list[EncodedReply]:
            nonlocal now
            now += timeout_s
            attempts.append(timeout_s)
            return []

    class NoPause(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            return False

    monkeypatch.setattr(replay_client, "time", SimpleNamespace(monotonic=lambda: now))
    learner = ReplayClient(
        cast(Transport, SilentTransport()), RUN, "learner l", NoPause(), patience_s=100.0
    )
    with pytest.raises(Unreachable):
        learner.request(verbs.STATE, REQUEST)
    assert attempts == [3.0, 6.0, 12.0, 24.0, 30.0, 30.0]


def test_foreign_error_reply_is_ignored(router: zenoh.Session, learner: ReplayClient) -> None:
    answer_each(router, lambda query: query.reply_err(b"router is busy"), answer)
    assert learner.request(verbs.STATE, REQUEST) == ANSWER


def test_service_that_starts_later_is_found(
    router: zenoh.Session, learner: ReplayClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    class FirstPause(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            answer_each(router, answer)
            return False

    monkeypatch.setattr(learner, "_stop", FirstPause())
    assert learner.request(verbs.STATE, REQUEST) == ANSWER


def test_request_without_reply_raises_unreachable(client: zenoh.Session) -> None:
    learner = ReplayClient(ZenohTransport(client), RUN, "learner l", patience_s=0.05)
    with pytest.raises(Unreachable, match=r"^learner l got no reply to 'state' from .* of run in"):
        learner.request(verbs.STATE, REQUEST)


def test_long_wait_is_logged_with_service_and_verb(
    client: zenoh.Session, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class NoPause(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            return False

    seconds = iter(range(100))
    clock = SimpleNamespace(
        monotonic=lambda: next(seconds)
    )  # every reading advances the clock by a second
    monkeypatch.setattr(replay_client, "time", clock)
    learner = ReplayClient(ZenohTransport(client), RUN, "learner l", NoPause(), patience_s=5.0)
    with caplog.at_level(logging.WARNING, "udrl"), pytest.raises(Unreachable):
        learner.request(verbs.STATE, REQUEST)
    assert [record.getMessage() for record in caplog.records] == [
        "learner l has been waiting 2 s for the replay service to reply to 'state'",
        "learner l has been waiting 4 s for the replay service to reply to 'state'",
    ]


def test_request_can_be_interrupted(client: zenoh.Session) -> None:
    stop = threading.Event()
    learner = ReplayClient(ZenohTransport(client), RUN, "learner l", stop)
    with ThreadPoolExecutor(1) as thread:
        future = thread.submit(lambda: learner.request(verbs.STATE, REQUEST))
        stop.set()
        with pytest.raises(Interrupted, match="learner l was stopped while waiting for 'state'"):
            future.result(WAIT_S)


def test_reply_of_another_type_is_rejected(inbox: Received, ask: Ask) -> None:
    future = ask()
    first(inbox).reply(Acknowledged())
    with pytest.raises(InvalidMessage, match=r"StateReply: .* `version`"):
        future.result(WAIT_S)


def test_reply_above_its_size_limit_is_rejected(inbox: Received, ask: Ask) -> None:
    future = ask(limit=10)
    first(inbox).reply(ANSWER)
    with pytest.raises(InvalidMessage, match="expected at most 10"):
        future.result(WAIT_S)


# The service.


@pytest.mark.parametrize(
    ("payload", "complaint"),
    [
        (b"", "incomplete input"),
        (encode(FailureMessage(actor="a", command_id=1, error="")), "StateRequest"),
        (bytes(101), "101 bytes, expected at most 100"),
    ],
)
def test_invalid_request_reaches_the_service_as_an_error(
    payload: bytes, complaint: str, inbox: Received, ask: Ask
) -> None:
    future = ask(payload)
    received = first(inbox)
    assert isinstance(received.request, InvalidMessage)
    assert complaint in str(received.request)
    received.reply(Problem(code="invalid", message=str(received.request)))
    with pytest.raises(Refused, match=complaint):
        future.result(WAIT_S)


def test_request_is_prepared_before_it_is_queued(router: zenoh.Session, ask: Ask) -> None:
    inbox: Inbox[Any] = Inbox(100, 1000)
    prepare = {"state": lambda request: request.learner.upper()}
    serve(ZenohTransport(router), RUN, inbox, [STATE], prepare)
    future = ask()
    received = first(inbox)
    assert received.request == "L"
    received.reply(ANSWER)
    assert future.result(WAIT_S) == ANSWER


def test_request_to_a_full_inbox_is_retried(router: zenoh.Session, ask: Ask) -> None:
    class FullAtFirst(Inbox[Any]):
        refused = 0

        def put(self, item: Any, size: int, *, bulk: bool = False) -> bool:
            if not self.refused:
                self.refused += 1
                return False
            return super().put(item, size, bulk=bulk)

    inbox = FullAtFirst(100, 1000)
    serve(ZenohTransport(router), RUN, inbox, [STATE])
    future = ask()
    first(inbox).reply(ANSWER)
    assert future.result(WAIT_S) == ANSWER
    assert inbox.refused == 1


def test_reply_to_a_closed_client_is_discarded(
    inbox: Received, router: zenoh.Session, endpoint: str
) -> None:
    with connect(endpoint, patience_s=5.0) as client:
        client.get(key_expressions.key(RUN, "state"), payload=encode(REQUEST))
        received = first(inbox)
    received.reply(ANSWER)
    assert inbox.take(1, 1, 0.0) == []


def test_undeclared_service_receives_no_requests(
    router: zenoh.Session, client: zenoh.Session
) -> None:
    inbox: Inbox[Any] = Inbox(100, 1000)
    for queryable in serve(ZenohTransport(router), RUN, inbox, [STATE]):
        queryable.undeclare()
    learner = ReplayClient(ZenohTransport(client), RUN, "learner l", patience_s=0.05)
    with pytest.raises(Unreachable):
        learner.request(verbs.STATE, REQUEST)
    assert inbox.take(1, 1, 0.0) == []
