"""Both transports provide the same guarantees."""

import queue
import threading
from collections.abc import Iterator

import pytest
import zenoh

from udrl_proto.memory_transport import Exchange, MemoryTransport
from udrl_proto.transport import EncodedReply, Presence, Query, Transport
from udrl_proto.zenoh_transport import ZenohTransport
from whole_run import wait_for

KEY = "udrl/5/run/status"
ALIVE = "udrl/5/run/alive/actor"
WAIT_S = 10.0

Ends = tuple[Transport, Transport]


@pytest.fixture(params=["memory", "zenoh"])
def ends(request: pytest.FixtureRequest) -> Iterator[Ends]:
    """The transports of a replay service and of a client."""
    if request.param == "memory":
        exchange = Exchange()
        yield MemoryTransport(exchange), MemoryTransport(exchange)
    else:
        router: zenoh.Session = request.getfixturevalue("router")
        client: zenoh.Session = request.getfixturevalue("client")
        yield ZenohTransport(router), ZenohTransport(client)


def ask(client: Transport, data: bytes = b"?", timeout_s: float = WAIT_S) -> list[EncodedReply]:
    return list(client.query(KEY, data, timeout_s))


@pytest.mark.parametrize("is_problem", [False, True])
def test_request_is_answered(ends: Ends, is_problem: bool) -> None:
    service, client = ends
    service.declare_queryable(
        KEY, lambda query: query.reply(EncodedReply(query.data + b"!", is_problem))
    )
    wait_for(lambda: ask(client) == [EncodedReply(b"?!", is_problem)], "the reply")


def test_request_may_be_answered_from_another_thread(ends: Ends) -> None:
    service, client = ends
    waiting: queue.Queue[Query] = queue.Queue()
    service.declare_queryable(KEY, waiting.put)

    def answer() -> None:
        waiting.get(timeout=WAIT_S).reply(EncodedReply(b"late", is_problem=False))

    threading.Thread(target=answer, daemon=True).start()
    wait_for(lambda: ask(client) == [EncodedReply(b"late", is_problem=False)], "the reply")


def test_undeclared_key_and_dropped_query_get_no_reply(ends: Ends) -> None:
    service, client = ends
    assert ask(client) == []
    dropping = service.declare_queryable(KEY, lambda query: query.drop())
    assert ask(client) == []
    dropping.undeclare()
    declared = service.declare_queryable(
        KEY, lambda query: query.reply(EncodedReply(b"!", is_problem=False))
    )
    wait_for(lambda: ask(client) == [EncodedReply(b"!", is_problem=False)], "the reply")
    declared.undeclare()
    wait_for(lambda: ask(client) == [], "the end of the replies", WAIT_S)


def test_unanswered_request_times_out(ends: Ends) -> None:
    service, client = ends
    hanging: list[Query] = []
    service.declare_queryable(KEY, hanging.append)
    wait_for(lambda: ask(client, timeout_s=0.1) == [] and hanging, "the request")
    hanging[0].drop()


def test_publication_reaches_subscribers_until_they_undeclare(ends: Ends) -> None:
    service, client = ends
    heard: queue.Queue[bytes] = queue.Queue()
    subscription = client.subscribe(KEY, heard.put)

    def is_heard() -> bool:
        service.publish(KEY, b"news")
        return not heard.empty()

    wait_for(is_heard, "the publication")
    assert heard.get() == b"news"
    subscription.undeclare()
    later: queue.Queue[bytes] = queue.Queue()
    again = client.subscribe(KEY, later.put)

    def is_heard_again() -> bool:
        service.publish(KEY, b"more")
        return b"more" in later.queue

    wait_for(is_heard_again, "the publication")
    again.undeclare()
    assert b"more" not in heard.queue


def test_presence_changes_are_reported(ends: Ends) -> None:
    service, client = ends
    early = client.declare_presence(f"{ALIVE}/early")
    wait_for(lambda: service.present(f"{ALIVE}/*", WAIT_S), "the first token")
    seen: queue.Queue[Presence] = queue.Queue()
    watching = service.watch("udrl/5/run/alive/*/*", seen.put)
    assert seen.get(timeout=WAIT_S) == Presence(f"{ALIVE}/early", here=True)
    late = client.declare_presence(f"{ALIVE}/late")
    assert seen.get(timeout=WAIT_S) == Presence(f"{ALIVE}/late", here=True)
    assert service.present(f"{ALIVE}/ea$*", WAIT_S) == [f"{ALIVE}/early"]
    early.undeclare()
    assert seen.get(timeout=WAIT_S) == Presence(f"{ALIVE}/early", here=False)
    watching.undeclare()
    rest: queue.Queue[Presence] = queue.Queue()
    other = service.watch("udrl/5/run/alive/*/*", rest.put)
    late.undeclare()
    assert rest.get(timeout=WAIT_S) == Presence(f"{ALIVE}/late", here=True)
    assert rest.get(timeout=WAIT_S) == Presence(f"{ALIVE}/late", here=False)
    other.undeclare()
    assert seen.empty()
