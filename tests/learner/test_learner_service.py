"""The learner service with a scripted replay service."""

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.proto.scripted import Scripted
from udrl.actions import Categorical
from udrl.checkpoint import encode_optimizer
from udrl.config import Config, build, flat
from udrl.environments import EnvironmentSpec
from udrl.episode import Episode
from udrl.errors import InvalidMessage, Refused
from udrl.experience import Experience
from udrl.graph import acting_graph
from udrl.spaces import Vector
from udrl.training import train, untrained
from udrl.weights import encode_weights
from udrl_learner import learner_service
from udrl_learner.learner_service import LearnerService
from udrl_proto import PROTOCOL, verbs
from udrl_proto.codec import encode_episode
from udrl_proto.messages import (
    ChangesReply,
    ChangesRequest,
    EpisodesReply,
    EpisodesRequest,
    Hello,
    JoinReply,
    Message,
    Problem,
    StateReply,
    VersionMessage,
    VersionReply,
    Wait,
)

CONFIG = build(
    Config,
    {
        "environment": "Synthetic-v0", "batch_size": 4, "hidden": [4, 4], "n_updates_per_iter": 2,
        "replay_size": 4, "last_few": 1,
    },
)  # fmt: skip
SPEC = EnvironmentSpec(
    observation_space=Vector(size=2), action_space=Categorical(n=3), max_episode_steps=4
)
HELLO = Hello(
    protocol=PROTOCOL, software="0", run_id="scripted", settings=flat(CONFIG), environment=SPEC,
    graph=acting_graph(CONFIG.network, SPEC),
)  # fmt: skip


def episode(number: int) -> Episode:
    rng = np.random.default_rng(number)
    return Episode(
        command_id=number,
        observations=rng.standard_normal((3, 2), np.float32),
        actions=rng.integers(3, size=3).astype(np.uint8),
        rewards=rng.standard_normal(3, np.float32),
        terminated=True,
        truncated=False,
    )


def weights_after(*buffers: list[int]) -> bytes:
    """Train a version on each buffer, one after another."""
    state, experience = untrained(CONFIG, SPEC), Experience(CONFIG, SPEC)
    for ids in buffers:
        for gone in experience.ids() - set(ids):
            experience.remove(gone)
        for new in set(ids) - experience.ids():
            experience.add(episode(new))
        train(state, experience.by_rank(ids), CONFIG)
    return encode_weights(state.weights)


#: The buffer for each version; then the run has ended.
BUFFERS = {1: [1, 2], 2: [2, 3], 3: [3, 4, 2]}


@pytest.fixture
def replay() -> Scripted:
    scripted = Scripted(HELLO.run_id)

    def changes(request: ChangesRequest) -> ChangesReply:
        if request.version not in BUFFERS:
            return ChangesReply(ended=True)
        return ChangesReply(ids=tuple(BUFFERS[request.version]))

    def episodes(request: EpisodesRequest) -> EpisodesReply:
        # One per page, so that the learner has to request several pages.
        return EpisodesReply(episodes=(encode_episode(episode(request.ids[0]), "a"),))

    scripted.answers(verbs.JOIN, lambda _: JoinReply())
    scripted.answers(verbs.STATE, lambda _: StateReply(version=0))
    scripted.answers(verbs.CHANGES, changes)
    scripted.answers(verbs.EPISODES, episodes)
    scripted.answers(verbs.VERSION, lambda _: VersionReply(result="accepted"))
    return scripted


@pytest.fixture
def run(replay: Scripted) -> Callable[[], None]:
    return LearnerService(replay.transport, HELLO, "l", threading.Event()).run


def delivered(replay: Scripted) -> list[tuple[int, bytes]]:
    versions: list[VersionMessage] = replay.requests(verbs.VERSION)
    return [(message.version, message.weights) for message in versions]


def test_versions_equal_training_on_each_buffer(replay: Scripted, run: Callable[[], None]) -> None:
    run()
    buffers = list(BUFFERS.values())
    assert delivered(replay) == [(v, weights_after(*buffers[:v])) for v in (1, 2, 3)]


def test_only_new_episodes_are_fetched(replay: Scripted, run: Callable[[], None]) -> None:
    run()
    first = [request.ids[0] for request in replay.requests(verbs.EPISODES)]
    assert first == [1, 2, 3, 4]


def invalid(number: int) -> bytes:
    valid = episode(number)
    return encode_episode(replace(valid, rewards=np.full(3, np.nan, np.float32)), "a")


@pytest.mark.parametrize(
    ("reply", "message"),
    [
        (lambda ids: [], r"EpisodesReply: .* length >= 1"),
        (
            lambda ids: [encode_episode(episode(ids[-1]), "a")],
            "replied with episode 2, expected episode 1; stop it",
        ),
        (
            lambda ids: [encode_episode(episode(i), "a") for i in (*ids, 3)],
            "replied with 3 episodes, expected at most 2",
        ),
        (lambda ids: [invalid(ids[0])], r"invalid episode 1 \(rewards are not all finite"),
    ],
    ids=["none", "another", "too many", "invalid"],
)
def test_reply_without_the_requested_episodes_is_an_error(
    reply: Callable[[tuple[int, ...]], list[bytes]],
    message: str,
    replay: Scripted,
    run: Callable[[], None],
) -> None:
    """An empty page would be requested again and again, and another episode trained on."""
    replay.answers(verbs.EPISODES, lambda r: EpisodesReply(episodes=tuple(reply(r.ids))))
    with pytest.raises(InvalidMessage, match=message):
        run()


def test_next_buffer_is_requested_during_training(
    replay: Scripted, run: Callable[[], None]
) -> None:
    is_requested = threading.Event()

    def changes(request: ChangesRequest) -> ChangesReply:
        if request.version == 2:
            is_requested.set()
        return ChangesReply(ids=(1, 2)) if request.version == 1 else ChangesReply(ended=True)

    def version(message: VersionMessage) -> VersionReply:
        assert is_requested.wait(10.0), (
            "version 1 was delivered before the next buffer was requested"
        )
        return VersionReply(result="accepted")

    replay.answers(verbs.CHANGES, changes)
    replay.answers(verbs.VERSION, version)
    run()
    assert [v for v, _ in delivered(replay)] == [1]


@pytest.mark.parametrize(
    "verb", [verbs.CHANGES, verbs.EPISODES, verbs.VERSION], ids=lambda v: v.name
)
def test_rewound_learner_restarts_from_the_state(
    verb: verbs.Verb[Any, Any], replay: Scripted, run: Callable[[], None]
) -> None:
    """The trained versions are the same."""
    code = "unknown_episode" if verb is verbs.EPISODES else "rewind"
    answers: dict[str, Callable[[Any], Message]] = {
        "changes": lambda r: (
            ChangesReply(ids=tuple(BUFFERS[r.version]))
            if r.version in BUFFERS
            else ChangesReply(ended=True)
        ),
        "episodes": lambda r: EpisodesReply(episodes=(encode_episode(episode(r.ids[0]), "a"),)),
        "version": lambda _: VersionReply(result="accepted"),
    }
    refused = False

    def once(request: Any) -> Message:
        nonlocal refused
        if not refused:
            refused = True
            return Problem(code=code, message="no")
        return answers[verb.name](request)

    replay.answers(verb, once)
    run()
    assert len(replay.requests(verbs.STATE)) == 2
    assert delivered(replay)[-1] == (3, weights_after(*BUFFERS.values()))


class NoPause(threading.Event):
    """Records the durations of its waits."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: list[float | None] = []

    def wait(self, timeout: float | None = None) -> bool:
        self.waits.append(timeout)
        return self.is_set()


def test_learner_gives_up_after_repeated_rewinds(replay: Scripted) -> None:
    never = NoPause()
    replay.answers(verbs.CHANGES, lambda _: Problem(code="rewind", message="version 7 is next"))
    with pytest.raises(
        Refused, match=r"failed 7 times to train the version after 0: version 7 is next; the"
    ):
        LearnerService(replay.transport, HELLO, "l", never).run()
    assert len(replay.requests(verbs.STATE)) == 7
    assert never.waits == [0.1, 0.2, 0.4, 0.8, 1.6, 3.2]


def test_rewound_learner_continues_while_another_makes_progress(replay: Scripted) -> None:
    """It is always slower, and therefore delivers nothing."""
    there, state = 0, untrained(CONFIG, SPEC)
    states: list[StateReply] = [StateReply(version=0)]
    experience = Experience(CONFIG, SPEC)
    for number in (1, 2):
        experience.add(episode(number))
    for version in range(1, 21):
        train(state, experience.by_rank([1, 2]), CONFIG)
        weights, optimizer = encode_weights(state.weights), encode_optimizer(state)
        states.append(StateReply(version=version, weights=weights, optimizer=optimizer))

    def changes(request: ChangesRequest) -> Message:
        nonlocal there
        if there == 20:
            return ChangesReply(ended=True)
        there += 1
        return Problem(code="rewind", message="another was faster")

    replay.answers(verbs.STATE, lambda _: states[there])
    replay.answers(verbs.CHANGES, changes)
    LearnerService(replay.transport, HELLO, "l", NoPause()).run()
    assert there == 20


def test_refusal_that_persists_after_a_rewind_is_raised(
    replay: Scripted, run: Callable[[], None]
) -> None:
    replay.answers(verbs.VERSION, lambda _: Problem(code="unequal_version", message="differs"))
    with pytest.raises(Refused, match="differs"):
        run()


def test_failed_delivery_is_noticed_while_the_next_buffer_is_awaited(
    replay: Scripted, run: Callable[[], None]
) -> None:
    """The replay service has no next buffer until it gets the version."""

    def changes(request: ChangesRequest) -> ChangesReply:
        if request.version == 1:
            return ChangesReply(ids=(1, 2))
        return ChangesReply(wait=Wait(on="actors", retry_after_s=0.05))

    replay.answers(verbs.CHANGES, changes)
    replay.answers(verbs.VERSION, lambda _: Problem(code="invalid", message="diverged"))
    with pytest.raises(Refused, match="diverged"):
        run()


def test_wait_for_the_buffer_is_short_however_many_actors_there_are(
    replay: Scripted, run: Callable[[], None]
) -> None:
    """The publication of progress is lost."""
    requested = 0

    def changes(request: ChangesRequest) -> ChangesReply:
        nonlocal requested
        requested += 1
        if requested == 1:
            return ChangesReply(wait=Wait(on="actors", retry_after_s=3600.0))
        return ChangesReply(ended=True)

    replay.answers(verbs.CHANGES, changes)
    run()
    assert requested == 2


def test_stopped_learner_does_not_wait_for_the_buffer(
    replay: Scripted, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learner_service, "_LONGEST_WAIT_S", 3600.0)
    stop = threading.Event()

    def changes(request: ChangesRequest) -> ChangesReply:
        stop.set()
        return ChangesReply(wait=Wait(on="actors", retry_after_s=3600.0))

    replay.answers(verbs.CHANGES, changes)
    LearnerService(replay.transport, HELLO, "l", stop).run()
    assert len(replay.requests(verbs.CHANGES)) == 1
