"""Requests that would break the run are refused with the reason, and the run continues."""

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
import pytest
import zenoh

import udrl_actor.actor_service
from udrl.config import Budget
from udrl.errors import ConfigError, Refused
from udrl_actor.actor_service import ActorService
from udrl_inspect.address import Address
from udrl_launch import roles
from udrl_proto import PROTOCOL, verbs
from udrl_proto.codec import encode, encode_array
from udrl_proto.messages import CommandsRequest, EpisodeMessage, Hello, JoinRequest, VersionMessage
from udrl_proto.replay_client import ReplayClient
from udrl_proto.reports import Status, StatusRequest
from udrl_proto.session import connect, find_run
from udrl_proto.zenoh_transport import ZenohTransport
from udrl_replay.creation import create_run
from whole_run import assert_conserved, digests, free_port, reference, toy

BUDGET = 300


class Hosted:
    """A replay service in this process, and a connection to it."""

    def __init__(self, run_dir: Path) -> None:
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.stop = threading.Event()
        store = create_run(run_dir, toy(lead=0))
        self._thread = threading.Thread(
            target=roles.replay,
            args=(run_dir, store, Budget(max_env_steps=BUDGET), self.stop),
            kwargs={"listen": self.endpoint},
        )
        self._thread.start()
        self.session: zenoh.Session = connect(self.endpoint, 10)
        self.transport = ZenohTransport(self.session)
        self.hello: Hello = find_run(self.session, None, 10)
        self.client = ReplayClient(self.transport, self.hello.run_id, "the test", patience_s=10)

    def status(self) -> Status:
        return self.client.request(verbs.STATUS, StatusRequest())

    def join(self, role: Literal["actor", "learner"], name: str, numerics_class: str = "c") -> None:
        request = JoinRequest(
            role=role, id=name, host="here", pid=1, software="0", numerics_class=numerics_class,
            environment_digest=self.hello.environment_digest,
        )  # fmt: skip
        self.client.request(verbs.JOIN, request)

    def finish(self) -> Status:
        """Let a valid actor and learner end the run; return its last status."""
        address = Address(self.endpoint, patience_s=10)
        peers = [
            threading.Thread(target=roles.learner, args=(address, self.stop)),
            threading.Thread(target=roles.actor, args=(address, 4, self.stop)),
        ]
        for peer in peers:
            peer.start()
        status = self.status()
        while status.state != "ended":
            assert all(peer.is_alive() for peer in peers) or self.status().state == "ended"
            status = self.status()
        for peer in peers:
            peer.join()
        return status

    def close(self) -> None:
        self.stop.set()
        self.session.close()
        self._thread.join()


@pytest.fixture
def hosted(tmp_path: Path) -> Iterator[Hosted]:
    one = Hosted(tmp_path / "run")
    yield one
    one.close()


#: For command 3, and valid for any command of the warm-up, which is random.
EPISODE = EpisodeMessage(
    actor="one",
    command_id=3,
    observations=encode_array(np.zeros(1, np.int32)),
    actions=encode_array(np.zeros(1, np.uint8)),
    rewards=encode_array(np.zeros(1, np.float32)),
    terminated=True,
    truncated=False,
)


def test_actor_with_another_environment_is_refused(hosted: Hosted) -> None:
    other = hosted.hello.settings | {"max_episode_steps": 1}
    hello = msgspec.structs.replace(hosted.hello, settings=other)
    with pytest.raises(Refused, match=r"max_episode_steps=2.*yours is.*max_episode_steps=1") as no:
        ActorService(hosted.transport, hello, "other", 1, hosted.stop).run()
    assert no.value.code == "other_environment"


def test_actor_with_another_environment_digest_is_refused(
    hosted: Hosted, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        udrl_actor.actor_service, "environment_digest", lambda _: "0123456789abcdef"
    )
    with pytest.raises(Refused, match=r"gives different observations.*0123456789abc") as no:
        ActorService(hosted.transport, hosted.hello, "other", 1, hosted.stop).run()
    assert no.value.code == "other_environment"


def test_first_delivery_sets_the_numerics_class(hosted: Hosted) -> None:
    hosted.join("actor", "two", "of two")
    hosted.join("actor", "one", "of one")
    assert hosted.client.request(verbs.EPISODE, EPISODE).result == "accepted"
    of_two = msgspec.structs.replace(EPISODE, actor="two", command_id=4)
    with pytest.raises(Refused, match=r"class of one, this machine has of two,") as no:
        hosted.client.request(verbs.EPISODE, of_two)
    assert no.value.code == "other_numerics"
    with pytest.raises(Refused, match="actor two has not joined"):
        hosted.client.request(verbs.EPISODE, of_two)
    with pytest.raises(Refused, match=r"class of one, this machine has [0-9a-f]{16},"):
        ActorService(hosted.transport, hosted.hello, "three", 1, hosted.stop).run()
    assert hosted.status().exact
    assert_conserved(hosted.status())


@pytest.mark.slow
def test_joining_without_delivery_sets_no_numerics_class(hosted: Hosted) -> None:
    hosted.join("actor", "idle", "of its own")
    hosted.join("learner", "idle", "of its own")
    assert hosted.client.request(verbs.COMMANDS, CommandsRequest(actor="idle", wanted=1)).commands
    assert digests(hosted.finish()) == digests(reference(hosted.hello.config, BUDGET))


def test_run_of_another_protocol_is_reported(hosted: Hosted) -> None:
    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply("udrl/999/future/hello", b"whatever that will be")

    queryable = hosted.session.declare_queryable("udrl/999/future/hello", answer)
    with pytest.raises(ConfigError, match=f"protocol 999, this program speaks {PROTOCOL}"):
        find_run(hosted.session, "future", 5)
    queryable.undeclare()


def test_bad_episodes_are_refused_and_the_run_continues(hosted: Hosted) -> None:
    hosted.join("actor", "mallory")
    good = msgspec.structs.replace(EPISODE, actor="mallory", command_id=0)
    nan = encode_array(np.full(1, np.nan, np.float32))
    bad = {
        "never issued|cancelled or unknown": msgspec.structs.replace(good, command_id=77),
        "rewards are not all finite": msgspec.structs.replace(good, rewards=nan),
        "observations are float32": msgspec.structs.replace(good, observations=nan),
        "actions are from 9 to 9, expected 0 to 2": msgspec.structs.replace(
            good, actions=encode_array(np.full(1, 9, np.uint8))
        ),
        "neither terminated": msgspec.structs.replace(good, terminated=False),
    }
    for reason, message in bad.items():
        with pytest.raises(Refused, match=reason):
            hosted.client.request(verbs.EPISODE, message)
    with pytest.raises(Refused, match="not MessagePack"):
        hosted.client.request(verbs.EPISODE, b"\xc1 garbage")
    with pytest.raises(Refused, match="at most"):
        hosted.client.request(verbs.EPISODE, bytes(1 << 20))
    status = hosted.status()
    assert status.episodes.rejected == len(bad) + 2
    assert_conserved(status)
    assert digests(hosted.finish()) == digests(reference(hosted.hello.config, BUDGET))


def test_bad_weights_are_refused(hosted: Hosted) -> None:
    message = VersionMessage(
        learner="mallory", version=1, weights=b"x", optimizer=b"y", loss=0.0, train_s=0.0
    )
    with pytest.raises(Refused, match="not safetensors"):
        hosted.client.request(verbs.VERSION, encode(message))
    assert hosted.status().weights_version == 0


def test_different_episode_for_a_command_marks_the_run_inexact(hosted: Hosted) -> None:
    status = hosted.status()
    assert status.exact
    hosted.join("actor", "one")
    assert hosted.client.request(verbs.EPISODE, EPISODE).result == "accepted"
    assert hosted.client.request(verbs.EPISODE, EPISODE).result == "duplicate"
    other = msgspec.structs.replace(EPISODE, actions=encode_array(np.ones(1, np.uint8)))
    assert hosted.client.request(verbs.EPISODE, other).result == "duplicate"
    status = hosted.status()
    assert not status.exact
    assert "command 3" in status.inexact_reason
    assert status.episodes.duplicate == 2
