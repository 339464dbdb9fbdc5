"""Sessions: endpoints, routers, and finding a run."""

import logging
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
import zenoh

from udrl.actions import Categorical
from udrl.config import Config, flat
from udrl.environments import EnvironmentSpec
from udrl.errors import ConfigError, Interrupted, InvalidMessage, Unreachable
from udrl.spaces import Vector
from udrl_proto import PROTOCOL, verbs
from udrl_proto import session as sessions
from udrl_proto.codec import encode
from udrl_proto.inbox import Inbox
from udrl_proto.messages import Hello
from udrl_proto.serving import ReceivedRequest
from udrl_proto.serving import serve as serve_verbs
from udrl_proto.zenoh_transport import ZenohTransport


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp/127.0.0.1:7447",
        "tcp/localhost:1",
        "tcp/replay.example.org:65535",
        "tcp/[::1]:7447",
        "tcp/0.0.0.0:7447",
    ],
)
def test_valid_endpoint_is_returned_unchanged(endpoint: str) -> None:
    assert sessions.check_endpoint(endpoint) == endpoint
    secured = endpoint.replace("tcp", "tls")
    assert sessions.check_endpoint(secured, secure=True) == secured


def test_endpoint_that_does_not_match_the_keys_is_rejected_with_the_remedy() -> None:
    with pytest.raises(ConfigError, match=r"'tls/a:1' needs keys; add --keys DIR"):
        sessions.check_endpoint("tls/a:1")
    with pytest.raises(ConfigError, match=r"'tcp/a:1' would ignore .* use tls/a:1$"):
        sessions.check_endpoint("tcp/a:1", secure=True)


@pytest.mark.parametrize(
    "endpoint",
    [
        "",
        "127.0.0.1:7447",
        "tcp/127.0.0.1",
        "tcp/127.0.0.1:",
        "tcp/127.0.0.1:0",
        "tcp/127.0.0.1:65536",
        "tcp/127.0.0.1:-1",
        "tcp/:7447",
        "tcp/::1:7447",
        "tcp/a b:7447",
        "tcp/a..b:7447",
        f"tcp/{64 * 'a'}.org:7447",
        "udp/127.0.0.1:7447",
        "tcp/127.0.0.1:7447?x=1",
        "tcp/127.0.0.1:7447\n",
        "http://127.0.0.1:7447",
    ],
)
def test_malformed_endpoint_is_rejected_with_the_expected_form(endpoint: str) -> None:
    with pytest.raises(ConfigError) as caught:
        sessions.check_endpoint(endpoint)
    assert f"endpoint {endpoint!r}: expected tcp/HOST:PORT" in str(caught.value)


@pytest.mark.parametrize(
    "endpoint", ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "tcp/10.0.0.1:7447", "tcp/localhost.org:7447"]
)
def test_listening_beyond_loopback_requires_the_insecure_option(endpoint: str) -> None:
    with pytest.raises(ConfigError, match=r"other machines .* --insecure"):
        sessions.listen(endpoint)
    with pytest.raises(ConfigError, match=r"other machines .* --insecure"):
        sessions.check_listening(endpoint)


def test_listening_beyond_loopback_by_name_is_possible(endpoint: str) -> None:
    everywhere = endpoint.replace("127.0.0.1", "0.0.0.0")
    with (
        sessions.listen(everywhere, insecure=True),
        sessions.connect(endpoint, patience_s=5.0) as client,
    ):
        assert list(client.info.routers_zid())


def test_port_in_use_is_reported(endpoint: str) -> None:
    host, port = endpoint.removeprefix("tcp/").split(":")
    with (
        socket.create_server((host, int(port))),
        pytest.raises(ConfigError, match=rf"{endpoint}.*in use.*; free the port"),
    ):
        sessions.listen(endpoint)
    sessions.check_listening(endpoint)
    with (
        socket.create_server((host, int(port))),
        pytest.raises(ConfigError, match=rf"{endpoint}.*in use.*; free the port"),
    ):
        sessions.check_listening(endpoint)
    with (
        sessions.listen(endpoint),
        pytest.raises(ConfigError, match=rf"{endpoint}.*in use.*; free the port"),
    ):
        sessions.check_listening(endpoint)
    sessions.check_listening(endpoint)


@pytest.mark.parametrize("host", ["192.0.2.7", "nowhere.invalid"])
def test_address_of_another_machine_is_reported(host: str) -> None:
    with pytest.raises(ConfigError, match=rf"cannot listen on 'tcp/{host}:7447': "):
        sessions.check_listening(f"tcp/{host}:7447", insecure=True)


def test_connecting_without_router_times_out(endpoint: str) -> None:
    began = time.monotonic()
    with pytest.raises(Unreachable, match=rf"no reply from '{endpoint}'.*--listen {endpoint}"):
        sessions.connect(endpoint, patience_s=0.2)
    assert time.monotonic() - began < 3.0


def test_connecting_can_be_interrupted(endpoint: str) -> None:
    stop = threading.Event()
    stop.set()
    with pytest.raises(Interrupted, match=endpoint):
        sessions.connect(endpoint, patience_s=60.0, stop=stop)


def test_client_connects_to_a_router_that_starts_later(endpoint: str) -> None:
    with ExitStack() as stack:

        class FirstPause(threading.Event):
            def wait(self, timeout: float | None = None) -> bool:
                stack.enter_context(sessions.listen(endpoint))
                return False

        client = sessions.connect(endpoint, patience_s=20.0, stop=FirstPause())
        stack.enter_context(client)
        assert list(client.info.routers_zid())


def test_starting_router_causes_no_warning(
    endpoint: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    class StopsAtFirstWait(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            return True

    caplog.set_level(logging.INFO, "udrl")
    with pytest.raises(Interrupted):
        sessions.connect(endpoint, patience_s=60.0, stop=StopsAtFirstWait())
    assert [(r.levelname, r.message) for r in caplog.records] == [
        ("INFO", f"waiting for a replay service or router at {endpoint}")
    ]
    monkeypatch.setattr(sessions, "QUIET_S", 0.0)
    with pytest.raises(Interrupted):
        sessions.connect(endpoint, patience_s=60.0, stop=StopsAtFirstWait())
    assert caplog.records[-1].levelname == "WARNING"
    assert f"router at {endpoint}, for " in caplog.text


# Finding a run.


def hello(run_id: str) -> Hello:
    return Hello(
        protocol=PROTOCOL,
        software="0",
        run_id=run_id,
        settings=flat(Config(environment="Figure2-v0")),
        environment=EnvironmentSpec(
            observation_space=Vector(size=4), action_space=Categorical(n=3), max_episode_steps=2
        ),
        graph=b"",
    )


def serve(session: zenoh.Session, run_id: str, payload: bytes, protocol: int = PROTOCOL) -> None:
    key = f"udrl/{protocol}/{run_id}/{verbs.HELLO.name}"
    session.declare_queryable(key, lambda query: query.reply(key, payload))


@pytest.fixture
def served(router: zenoh.Session) -> zenoh.Session:
    serve(router, "one", encode(hello("one")))
    return router


def test_only_run_is_found_without_its_name(served: zenoh.Session, client: zenoh.Session) -> None:
    assert sessions.find_run(client, None, patience_s=5.0) == hello("one")


def test_one_of_several_runs_is_found_by_name(served: zenoh.Session, client: zenoh.Session) -> None:
    serve(served, "two", encode(hello("two")))
    assert sessions.find_run(client, "two", patience_s=5.0) == hello("two")


def test_several_runs_are_listed_if_no_name_is_given(
    served: zenoh.Session, client: zenoh.Session
) -> None:
    serve(served, "two", encode(hello("two")))
    with pytest.raises(ConfigError, match=r"one, two; choose one.*--run"):
        sessions.find_run(client, None, patience_s=5.0)


@pytest.fixture
def unanswered(router: zenoh.Session) -> Iterator[list[zenoh.Query]]:
    """The requests that a busy run, ``two``, has received and not answered."""
    queries: list[zenoh.Query] = []
    key = f"udrl/{PROTOCOL}/two/{verbs.HELLO.name}"
    router.declare_queryable(key, queries.append, complete=True)
    yield queries
    for query in queries:
        query.drop()


def test_run_is_not_taken_for_the_only_one_while_another_is_busy(
    served: zenoh.Session, client: zenoh.Session, unanswered: list[zenoh.Query]
) -> None:
    with pytest.raises(Unreachable, match=r"besides one there is a run that did not .*; .*--run"):
        sessions.find_run(client, None, patience_s=0.1)
    assert unanswered
    assert sessions.find_run(client, "one", patience_s=0.1) == hello("one")


def test_run_with_a_full_inbox_is_not_overlooked(
    served: zenoh.Session, client: zenoh.Session
) -> None:
    full: Inbox[ReceivedRequest] = Inbox(max_items=0, max_bytes=0)
    serve_verbs(ZenohTransport(served), "two", full, [verbs.HELLO])
    with pytest.raises(Unreachable, match=r"besides one there is a run that did not .*; .*--run"):
        sessions.find_run(client, None, patience_s=0.1)


def test_several_runs_are_listed_once_the_busy_one_replies(
    served: zenoh.Session, client: zenoh.Session, unanswered: list[zenoh.Query]
) -> None:
    class FirstPause(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            serve(served, "two", encode(hello("two")))
            return False

    with pytest.raises(ConfigError, match=r"one, two; choose one.*--run"):
        sessions.find_run(client, None, patience_s=60.0, stop=FirstPause())


@pytest.mark.parametrize(
    ("run_id", "message"),
    [
        (None, "no run replied in .*; start `udrl replay ENV`"),
        ("two", "no run 'two' replied in .*, or check --run"),
    ],
)
def test_missing_run_times_out(
    run_id: str | None, message: str, router: zenoh.Session, client: zenoh.Session
) -> None:
    if run_id:
        serve(router, "one", encode(hello("one")))
    began = time.monotonic()
    with pytest.raises(Unreachable, match=f"^{message}$"):
        sessions.find_run(client, run_id, patience_s=0.1)
    assert time.monotonic() - began < 3.0


def test_run_of_another_protocol_is_rejected_with_both_versions(
    router: zenoh.Session, client: zenoh.Session
) -> None:
    serve(router, "one", b"whatever it says then", protocol=PROTOCOL + 1)
    expected = rf"speaks protocol {PROTOCOL + 1}, this program speaks {PROTOCOL}; install the same"
    with pytest.raises(ConfigError, match=expected):
        sessions.find_run(client, None, patience_s=5.0)


def test_invalid_hello_is_rejected(router: zenoh.Session, client: zenoh.Session) -> None:
    serve(router, "one", b"\xc1")
    with pytest.raises(InvalidMessage, match=r"^Hello: "):
        sessions.find_run(client, None, patience_s=5.0)


def test_finding_a_run_can_be_interrupted(router: zenoh.Session, client: zenoh.Session) -> None:
    stop = threading.Event()
    stop.set()
    with pytest.raises(Interrupted, match="looking for a run"):
        sessions.find_run(client, None, patience_s=60.0, stop=stop)
