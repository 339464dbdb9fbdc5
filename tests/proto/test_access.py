"""Access control: no access without a key, and with a key only what the role permits."""

import json
import queue
import re
import runpy
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh

from tests.markdown import ROOT, section
from udrl.errors import ConfigError, Unreachable
from udrl_launch import authority
from udrl_proto import key_expressions, verbs
from udrl_proto import session as sessions
from udrl_proto.access import RIGHTS, ROLES
from udrl_proto.credentials import load_credentials
from whole_run import configured_router, wait_for

DEADLINE_S = 10.0

#: Repeated here on purpose: a mistake in the table of the code must not go unnoticed.
MAY_ASK = {
    "learner": {"hello", "join", "changes", "episodes", "version", "state"},
    "actor": {"hello", "join", "commands", "episode", "failure", "weights"},
    "observer": {"hello", "status", "weights", "history", "contents"},
    "replay": set(),
}

Connect = Callable[..., zenoh.Session]


@pytest.fixture
def secure_endpoint(endpoint: str) -> str:
    return endpoint.replace("tcp", "tls")


class Replay:
    """A stand-in for the replay service: replies to every verb."""

    def __init__(self, session: zenoh.Session, *, hosts_router: bool) -> None:
        self.session = session
        self.hosts_router = hosts_router
        self.received: list[str] = []
        self.tokens: queue.Queue[str] = queue.Queue()
        for verb in verbs.VERBS:
            key = key_expressions.key("run", verb.name)
            self.session.declare_queryable(key, partial(self._answer, key), complete=True)
        self.heard = RecordingSubscriber(session, "**")
        self.session.liveliness().declare_subscriber(
            key_expressions.alive("run", "*", "*"), self._note
        )

    def _answer(self, key: str, query: zenoh.Query) -> None:
        with query:
            self.received.append(key)
            query.reply(key, b"replay")

    def _note(self, token: zenoh.Sample) -> None:
        if token.kind == zenoh.SampleKind.PUT:
            self.tokens.put(str(token.key_expr))


@pytest.fixture(params=["hosts the router", "connects to a router"])
def replay(request: pytest.FixtureRequest, endpoint: str, keys_dir: Path) -> Iterator[Replay]:
    secure, credentials = endpoint.replace("tcp", "tls"), load_credentials(keys_dir, "replay")
    hosts_router = request.param == "hosts the router"
    with ExitStack() as stack:
        if hosts_router:
            session = sessions.listen(secure, credentials=credentials)
        else:
            stack.enter_context(configured_router(secure, keys_dir))
            session = sessions.connect(secure, DEADLINE_S, credentials=credentials)
        yield Replay(stack.enter_context(session), hosts_router=hosts_router)


@pytest.fixture
def connect(replay: Replay, secure_endpoint: str, keys_dir: Path) -> Iterator[Connect]:
    """Connect with the key of a role."""
    with ExitStack() as stack:

        def client(role: str) -> zenoh.Session:
            credentials = load_credentials(keys_dir, role)
            session = sessions.connect(secure_endpoint, DEADLINE_S, credentials=credentials)
            return stack.enter_context(session)

        yield client


def ask(session: zenoh.Session, verb: str) -> list[str]:
    """Return all replies to a request."""
    replies = session.get(
        key_expressions.key("run", verb),
        timeout=DEADLINE_S,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
    )
    return [reply.ok.payload.to_string() for reply in replies if reply.ok is not None]


class RecordingSubscriber:
    """Messages of a subscriber; ``wait_for`` waits for one of them."""

    def __init__(self, session: zenoh.Session, *expressions: str) -> None:
        self.messages: list[tuple[str, str]] = []
        self._changed = threading.Condition()
        for expression in expressions:
            session.declare_subscriber(expression, self._note)

    def _note(self, sample: zenoh.Sample) -> None:
        with self._changed:
            self.messages.append((str(sample.key_expr), sample.payload.to_string()))
            self._changed.notify_all()

    def wait_for(self, text: str) -> None:
        with self._changed:
            visible_tokens = self._changed.wait_for(
                lambda: any(text == message for _, message in self.messages), DEADLINE_S
            )
        assert visible_tokens, f"{text!r} not received; received: {self.messages}"


# Connecting.


def raw_config(endpoint: str, mode: str = "client", **tls: Any) -> zenoh.Config:
    """Return a raw Zenoh configuration."""
    config = zenoh.Config()
    given = {f"transport/link/tls/{name}": str(value) for name, value in tls.items()}
    for name, value in {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": 1000,
        "connect/exit_on_failure": True,
        "listen/endpoints": [],
        **given,
    }.items():
        config.insert_json5(name, json.dumps(value))
    return config


def test_connection_without_certificate_is_refused(
    replay: Replay, connect: Connect, secure_endpoint: str, keys_dir: Path
) -> None:
    with pytest.raises(zenoh.ZError):
        zenoh.open(raw_config(secure_endpoint, root_ca_certificate=keys_dir / "actor" / "ca.pem"))
    with pytest.raises(Unreachable, match="no reply from"):
        sessions.connect(secure_endpoint.replace("tls", "tcp"), patience_s=0.1)
    assert ask(connect("actor"), verbs.HELLO.name) == ["replay"]


def test_key_of_another_authority_is_refused_by_both_sides(
    replay: Replay, secure_endpoint: str, keys_dir: Path, foreign_keys_dir: Path
) -> None:
    foreign = load_credentials(foreign_keys_dir, "actor")
    with pytest.raises(ConfigError, match=r"not trusted.*same `udrl keys create`"):
        sessions.connect(secure_endpoint, DEADLINE_S, credentials=foreign)
    # A client that trusts this server is still not trusted by it.
    foreign = foreign._replace(ca=keys_dir / "actor" / "ca.pem")
    with pytest.raises(ConfigError, match=r"does not trust .*cert\.pem .*same `udrl keys create`"):
        sessions.connect(secure_endpoint, DEADLINE_S, credentials=foreign)


@pytest.mark.parametrize("role", list(RIGHTS))
def test_only_the_replay_service_can_be_a_server(
    role: str, secure_endpoint: str, keys_dir: Path
) -> None:
    with (
        sessions.listen(secure_endpoint, credentials=load_credentials(keys_dir, role)),
        pytest.raises(ConfigError, match="is not trusted"),
    ):
        sessions.connect(
            secure_endpoint, DEADLINE_S, credentials=load_credentials(keys_dir, "learner")
        )


def test_server_of_another_name_is_refused(secure_endpoint: str, keys_dir: Path) -> None:
    everywhere = secure_endpoint.replace("127.0.0.1", "0.0.0.0")
    other = secure_endpoint.replace("127.0.0.1", "127.0.0.2")
    with (
        sessions.listen(everywhere, credentials=load_credentials(keys_dir, "replay")),
        pytest.raises(ConfigError, match=r"not trusted.*mismatch.* --host 127\.0\.0\.2"),
    ):
        sessions.connect(other, DEADLINE_S, credentials=load_credentials(keys_dir, "actor"))


def test_connecting_to_a_secure_endpoint_without_router_times_out(
    secure_endpoint: str, keys_dir: Path
) -> None:
    with pytest.raises(Unreachable, match="no reply from"):
        sessions.connect(secure_endpoint, 0.1, credentials=load_credentials(keys_dir, "actor"))


def test_link_is_closed_when_the_keys_expire(secure_endpoint: str, tmp_path: Path) -> None:
    authority.create_keys(tmp_path, valid=timedelta(seconds=4))
    with (
        sessions.listen(secure_endpoint, credentials=load_credentials(tmp_path, "replay")),
        sessions.connect(
            secure_endpoint, 3, credentials=load_credentials(tmp_path, "actor")
        ) as client,
    ):
        assert list(client.info.routers_zid())
        wait_for(lambda: not list(client.info.routers_zid()), "the link to close")
    with pytest.raises(ConfigError, match="expired"):
        load_credentials(tmp_path, "actor")


# Requests and replies.


@pytest.mark.parametrize("role", MAY_ASK)
def test_role_gets_replies_to_its_own_verbs_only(
    role: str, replay: Replay, connect: Connect
) -> None:
    client = connect(role)
    names = [verb.name for verb in verbs.VERBS]
    assert {name for name in names if ask(client, name)} == MAY_ASK[role]
    assert replay.received == [
        key_expressions.key("run", name) for name in names if name in MAY_ASK[role]
    ]


@pytest.mark.parametrize("expression", ["udrl/**", "udrl/1/run/*", "**", "udrl/*/*/st*"])
def test_wildcards_grant_no_additional_access(
    expression: str, replay: Replay, connect: Connect
) -> None:
    client = connect("actor")
    expression = expression.replace("st*", "st$*")
    assert list(client.get(expression, timeout=DEADLINE_S, target=zenoh.QueryTarget.ALL)) == []
    assert len(list(client.get(key_expressions.every_hello(), timeout=DEADLINE_S))) == 1
    assert replay.received == [key_expressions.key("run", verbs.HELLO.name)]


def impersonate_replay(thief: zenoh.Session) -> list[str]:
    """Declare every verb; return the list that receives the intercepted requests."""
    stolen: list[str] = []

    def answer(query: zenoh.Query) -> None:
        with query:
            stolen.append(str(query.key_expr))
            query.reply(query.key_expr, b"thief")

    for expression in [*(key_expressions.key("run", verb.name) for verb in verbs.VERBS), "udrl/**"]:
        thief.declare_queryable(expression, answer, complete=True)
    # The router processes declarations in order: once this token is visible, so are the queryables.
    thief.liveliness().declare_token(key_expressions.alive("run", "actor", "thief"))
    return stolen


def test_actor_cannot_impersonate_the_replay_service(replay: Replay, connect: Connect) -> None:
    stolen = impersonate_replay(connect("actor"))
    assert replay.tokens.get(timeout=DEADLINE_S) == key_expressions.alive("run", "actor", "thief")
    for role, allowed in MAY_ASK.items():
        victim = connect(role)
        for verb in allowed:
            assert ask(victim, verb) == ["replay"]
    assert stolen == []


def test_peer_with_an_actors_key_has_the_rights_of_a_client(
    replay: Replay, connect: Connect, secure_endpoint: str, keys_dir: Path
) -> None:
    own = load_credentials(keys_dir, "actor")
    tls = {
        "root_ca_certificate": own.ca,
        "connect_certificate": own.certificate,
        "connect_private_key": own.key,
    }
    config = raw_config(secure_endpoint, mode="peer", **tls)
    config.insert_json5("transport/link/tls/enable_mtls", "true")
    with zenoh.open(config) as thief:
        stolen = impersonate_replay(thief)
        assert replay.tokens.get(timeout=DEADLINE_S) == key_expressions.alive(
            "run", "actor", "thief"
        )
        assert ask(connect("learner"), verbs.STATE.name) == ["replay"]
        assert stolen == []


def test_impersonation_succeeds_without_access_control(endpoint: str) -> None:
    """The control for the tests above: without access control, the same attack works."""
    replay = Replay(sessions.listen(endpoint), hosts_router=True)
    with (
        replay.session,
        sessions.connect(endpoint, DEADLINE_S) as thief,
        sessions.connect(endpoint, DEADLINE_S) as victim,
    ):
        stolen = impersonate_replay(thief)
        replay.tokens.get(timeout=DEADLINE_S)
        assert "thief" in ask(victim, verbs.STATE.name)
        assert stolen


# Publications and presence.


@pytest.mark.parametrize("mallory", ["actor", "observer", "replay"])
def test_only_the_learner_can_publish_weights(
    mallory: str, replay: Replay, connect: Connect
) -> None:
    listener, thief = connect("actor"), connect(mallory)
    heard = RecordingSubscriber(listener, key_expressions.key("run", key_expressions.NEW_WEIGHTS))
    ask(listener, verbs.HELLO.name)  # once this returns, the router knows the subscription
    for name in (key_expressions.NEW_WEIGHTS, key_expressions.PROGRESS, verbs.EPISODE.name):
        thief.put(key_expressions.key("run", name), b"false")
    thief.delete(key_expressions.key("run", key_expressions.NEW_WEIGHTS))
    ask(thief, verbs.HELLO.name)  # once this returns, the router has seen the earlier publications
    connect("learner").put(key_expressions.key("run", key_expressions.NEW_WEIGHTS), b"true")
    heard.wait_for("true")
    expected = [(key_expressions.key("run", key_expressions.NEW_WEIGHTS), "true")]
    assert heard.messages == expected
    # The replay service subscribes to none of these; ``heard`` sees everything in its own session.
    if replay.hosts_router:
        replay.heard.wait_for("true")
    assert replay.heard.messages == (expected if replay.hosts_router else [])


def test_each_role_receives_its_own_publications(replay: Replay, connect: Connect) -> None:
    progress, weights = (
        key_expressions.key("run", name)
        for name in (key_expressions.PROGRESS, key_expressions.NEW_WEIGHTS)
    )
    everything = ("udrl/**", progress, weights)
    learner, actor = connect("learner"), connect("actor")
    of_learner, of_actor = (
        RecordingSubscriber(learner, *everything),
        RecordingSubscriber(actor, *everything),
    )
    of_observer = RecordingSubscriber(connect("observer"), *everything)
    for client in (learner, actor):
        ask(client, verbs.HELLO.name)  # once this returns, the router knows the subscriptions
    connect("learner").put(weights, b"weights")
    replay.session.put(progress, b"progress")
    of_actor.wait_for("weights")
    of_learner.wait_for("progress")
    assert {key for key, _ in of_actor.messages} == {weights}
    assert {key for key, _ in of_learner.messages} == {progress}
    assert of_observer.messages == []


def test_learner_cannot_publish_progress(replay: Replay, connect: Connect) -> None:
    learner, listener = connect("learner"), connect("learner")
    heard = RecordingSubscriber(listener, key_expressions.key("run", key_expressions.PROGRESS))
    ask(listener, verbs.HELLO.name)  # once this returns, the router knows the subscription
    learner.put(key_expressions.key("run", key_expressions.PROGRESS), b"false")
    ask(learner, verbs.HELLO.name)
    replay.session.put(key_expressions.key("run", key_expressions.PROGRESS), b"true")
    heard.wait_for("true")
    assert heard.messages == [(key_expressions.key("run", key_expressions.PROGRESS), "true")]


def visible_tokens(client: zenoh.Session, role: str) -> list[str]:
    """Return the tokens of a role that a client can see."""
    replies = client.liveliness().get(key_expressions.alive("run", role, "t$*"), timeout=DEADLINE_S)
    return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]


@pytest.mark.parametrize(("role", "other"), [("actor", "learner"), ("learner", "actor")])
def test_role_declares_presence_under_its_own_name_only(
    role: str, other: str, replay: Replay, connect: Connect
) -> None:
    client = connect(role)
    declare = client.liveliness().declare_token
    _kept = (
        declare(key_expressions.alive("run", other, "one")),
        declare(key_expressions.alive("run", role, "two")),
    )
    assert replay.tokens.get(timeout=DEADLINE_S) == key_expressions.alive("run", role, "two")
    assert visible_tokens(connect(role), role) == [key_expressions.alive("run", role, "two")]
    # Nor can it see the tokens of another role.
    assert visible_tokens(connect(other), role) == []
    assert list(connect(other).liveliness().get("udrl/**", timeout=DEADLINE_S)) == []
    assert replay.tokens.empty()


# The table of rights.


def test_table_of_rights_is_documented() -> None:
    found = {}
    for line in section("docs/protocol.md", "## Permissions").splitlines():
        if line.startswith("| `"):
            cells = [re.findall(r"`([^`]+)`", cell) for cell in line.strip("|").split("|")]
            (role,), asks, hears, publishes, tokens = cells
            found[role] = set(asks), set(hears), set(publishes), tokens
    assert found == {
        role: (
            set(verbs.sent_by(role)),
            set(rights.subscribes),
            set(rights.publishes),
            [f"alive/{role}/*"] if rights.joins else [],
        )
        for role, rights in RIGHTS.items()
    }


def test_every_verb_belongs_to_a_role() -> None:
    sent = {name for role in RIGHTS for name in verbs.sent_by(role)}
    assert sent == {verb.name for verb in verbs.VERBS}
    assert set(ROLES) == set(MAY_ASK)


def test_router_configuration_is_current() -> None:
    path = ROOT / "deploy" / "make_zenohd.py"
    make_zenohd = runpy.run_path(str(path))
    written = (ROOT / "deploy" / "zenohd.json5").read_text(encoding="utf-8")
    assert written == make_zenohd["text"](), "run: .venv/bin/python deploy/make_zenohd.py"
