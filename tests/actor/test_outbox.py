"""The outbox: concurrent deliveries, large ones alone, and errors."""

import logging
import queue
import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from tests.proto.scripted import Scripted
from udrl.acting import Failure
from udrl.commands import Command
from udrl.episode import Episode
from udrl.errors import EnvironmentFault, Refused
from udrl_actor import outbox as outboxes
from udrl_actor.outbox import Outbox, deliver
from udrl_proto import verbs
from udrl_proto.messages import (
    Acknowledged,
    EpisodeMessage,
    EpisodeReply,
    JoinReply,
    JoinRequest,
    Message,
    Problem,
)
from udrl_proto.replay_client import ReplayClient
from whole_run import wait_for

DEADLINE_S = 10.0
JOIN = JoinRequest(role="actor", id="a", host="h", pid=1, software="0", numerics_class="c")


def episode(command_id: int, n_bytes: int = 100) -> Episode:
    return Episode(
        command_id=command_id,
        observations=np.zeros((1, n_bytes), dtype=np.uint8),
        actions=np.zeros(1, dtype=np.uint8),
        rewards=np.zeros(1, dtype=np.float32),
        terminated=True,
        truncated=False,
    )


class ReplayService:
    """Acknowledges on demand."""

    def __init__(self) -> None:
        self.came: queue.Queue[int] = queue.Queue()
        self.may_answer = threading.Semaphore(0)
        self.errors: queue.Queue[Exception] = queue.Queue()
        self.problem: Exception | None = None

    def deliver(self, outcome: Episode | Failure) -> None:
        assert isinstance(outcome, Episode)
        self.came.put(outcome.command_id)
        assert self.may_answer.acquire(timeout=DEADLINE_S)
        if self.problem is not None:
            raise self.problem

    def next(self, count: int) -> set[int]:
        return {self.came.get(timeout=DEADLINE_S) for _ in range(count)}


@pytest.fixture
def replay() -> ReplayService:
    return ReplayService()


@pytest.fixture
def outbox(replay: ReplayService) -> Iterator[Outbox]:
    one = Outbox("test", replay.deliver, replay.errors.put)
    yield one
    one.close()
    replay.may_answer.release(100)


def emptied(outbox: Outbox) -> Callable[[], bool]:
    return lambda: len(outbox) == 0


def test_small_episodes_are_delivered_concurrently_and_exactly_once(
    replay: ReplayService, outbox: Outbox
) -> None:
    outbox.put(episode(i) for i in range(20))
    at_once = replay.next(outboxes._THREADS)
    assert at_once == set(range(outboxes._THREADS))
    assert replay.came.empty()
    assert len(outbox) == 20
    replay.may_answer.release(20)
    assert replay.next(20 - outboxes._THREADS) == set(range(20)) - at_once
    wait_for(emptied(outbox), "the last acknowledgement")
    assert replay.came.empty()


def test_large_episodes_are_delivered_one_by_one(replay: ReplayService, outbox: Outbox) -> None:
    large = outboxes._BYTES_IN_TRANSIT + 1
    outbox.put([episode(0, large), episode(1, large), episode(2)])
    for expected in range(3):
        assert replay.next(1) == {expected}
        assert replay.came.empty()
        replay.may_answer.release()
    wait_for(emptied(outbox), "the last acknowledgement")


def test_small_episode_is_delivered_beside_one_that_leaves_room(
    replay: ReplayService, outbox: Outbox
) -> None:
    outbox.put([episode(0, outboxes._BYTES_IN_TRANSIT - 100), episode(1), episode(2)])
    assert replay.next(2) == {0, 1}
    assert replay.came.empty()
    replay.may_answer.release()
    assert replay.next(1) == {2}


def test_error_of_a_delivery_is_reported(replay: ReplayService, outbox: Outbox) -> None:
    replay.problem = ValueError("no")
    outbox.put([episode(0)])
    replay.may_answer.release()
    assert replay.errors.get(timeout=DEADLINE_S) is replay.problem
    # There was no acknowledgement.
    assert len(outbox) == 1


def test_closed_outbox_begins_no_delivery(replay: ReplayService, outbox: Outbox) -> None:
    outbox.put([episode(0, outboxes._BYTES_IN_TRANSIT), episode(1)])
    assert replay.next(1) == {0}
    outbox.close()
    replay.may_answer.release()
    wait_for(lambda: len(outbox) == 1, "the end of the first delivery")
    assert replay.came.empty()


# A single delivery.


@pytest.fixture
def scripted() -> Scripted:
    return Scripted("scripted")


@pytest.fixture
def client(scripted: Scripted) -> ReplayClient:
    return ReplayClient(scripted.transport, "scripted", "actor a", threading.Event())


def test_episode_is_delivered(scripted: Scripted, client: ReplayClient) -> None:
    scripted.answers(verbs.EPISODE, lambda _: EpisodeReply(result="accepted"))
    assert deliver(client, JOIN, episode(7)) == 7
    (message,) = scripted.requests(verbs.EPISODE)
    assert (message.actor, message.command_id) == ("a", 7)


def test_episode_is_redelivered_to_a_restarted_service(
    scripted: Scripted, client: ReplayClient
) -> None:
    known = False

    def join(_: JoinRequest) -> Message:
        nonlocal known
        known = True
        return JoinReply()

    def accept(_: EpisodeMessage) -> Message:
        unknown = Problem(code="join_first", message="who is that?")
        return EpisodeReply(result="accepted") if known else unknown

    scripted.answers(verbs.JOIN, join)
    scripted.answers(verbs.EPISODE, accept)
    assert deliver(client, JOIN, episode(7)) == 7
    assert [name for name, _ in scripted.received] == ["episode", "join", "episode"]


def test_delivery_gives_up_after_repeated_join_first(
    scripted: Scripted, client: ReplayClient
) -> None:
    scripted.answers(verbs.JOIN, lambda _: JoinReply())
    scripted.answers(verbs.EPISODE, lambda _: Problem(code="join_first", message="who is that?"))
    with pytest.raises(Refused, match="who is that"):
        deliver(client, JOIN, episode(7))
    assert len(scripted.requests(verbs.JOIN)) == 5


def test_failure_is_delivered(scripted: Scripted, client: ReplayClient) -> None:
    scripted.answers(verbs.FAILURE, lambda _: Acknowledged())
    command = Command(
        id=8, kind="warm_up", desired_return=0.0, desired_horizon=1, environment_seed=1,
        stream_key=bytes(16), weights_version=0, max_steps=1,
    )  # fmt: skip
    assert deliver(client, JOIN, Failure(command, EnvironmentFault("it broke"))) == 8
    (message,) = scripted.requests(verbs.FAILURE)
    assert (message.actor, message.command_id, message.error) == ("a", 8, "it broke")


def test_rejected_episode_is_discarded(
    scripted: Scripted, client: ReplayClient, caplog: pytest.LogCaptureFixture
) -> None:
    scripted.answers(verbs.EPISODE, lambda _: Problem(code="rejected", message="the run has ended"))
    with caplog.at_level(logging.INFO, "udrl"):
        assert deliver(client, JOIN, episode(7)) == 7
    assert "the run has ended" in caplog.text


def test_other_refusals_are_raised(scripted: Scripted, client: ReplayClient) -> None:
    scripted.answers(
        verbs.EPISODE, lambda _: Problem(code="quarantined", message="a false episode")
    )
    with pytest.raises(Refused, match="a false episode"):
        deliver(client, JOIN, episode(7))
