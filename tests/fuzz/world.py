"""A run that is given arbitrary bytes as requests, without a network, and its invariants.

Each input must lead to one reply, which is a message of the protocol; the ledgers must balance;
nothing raises; and nothing is accepted that is invalid by ``proto/README.md``.
"""

import tempfile
from copy import deepcopy
from pathlib import Path
from typing import cast

import msgpack
import numpy as np

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.checkpoint import encode_optimizer
from udrl.commands import Command
from udrl.config import Budget, Config, build
from udrl.errors import InvalidData
from udrl.experience import Experience
from udrl.graph import acting_graph
from udrl.inference import ActingFunction
from udrl.training import TrainingState, train, untrained
from udrl.weights import encode_weights
from udrl_proto import key_expressions, verbs
from udrl_proto.codec import decode, decode_episode, encode, encode_episode
from udrl_proto.memory_transport import Exchange, MemoryTransport
from udrl_proto.messages import (
    ChangesReply,
    ChangesRequest,
    CommandsReply,
    CommandsRequest,
    EpisodeMessage,
    EpisodesRequest,
    FailureMessage,
    HelloRequest,
    JoinRequest,
    Message,
    Problem,
    StateRequest,
    VersionMessage,
    WeightsRequest,
)
from udrl_proto.reports import ContentsRequest, HistoryRequest, StatusRequest
from udrl_proto.transport import EncodedReply
from udrl_replay.creation import create_run
from udrl_replay.replay_service import ReplayService

CONFIG = build(
    Config,
    {
        "environment": "Figure2-v0", "lead": 2, "batch_size": 4, "hidden": [2, 2],
        "n_warm_up_episodes": 3, "n_episodes_per_iter": 3, "n_updates_per_iter": 2,
        "replay_size": 6, "last_few": 2, "eval_every": 20, "eval_episodes": 2, "segments": "all",
    },
)  # fmt: skip

BY_NAME = {verb.name: verb for verb in verbs.VERBS}
NAMES = list(BY_NAME)

#: A file system that syncs at once.
_MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None


class Query:
    """A query without a sender."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.replies: list[EncodedReply] = []
        self.dropped = False

    @property
    def data(self) -> bytes:
        return self._data

    def reply(self, reply: EncodedReply) -> None:
        self.replies.append(reply)

    def drop(self) -> None:
        self.dropped = True


class World:
    """A run that accepts requests as bytes."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(dir=_MEMORY)
        run_dir = Path(self._folder.name)
        self._store = create_run(run_dir, CONFIG)
        self._exchange = Exchange()
        transport = MemoryTransport(self._exchange)
        budget = Budget(max_env_steps=2**53)
        self.service = ReplayService(transport, self._store, budget, run_dir, audit=0.2)
        self._run_id, self.spec = self.service.run.hello.run_id, self.service.run.hello.environment
        self.service.open()

    def close(self) -> None:
        """Close and delete the run."""
        self.service.close()
        self._store.close()
        self._folder.cleanup()

    @property
    def is_over(self) -> bool:
        """Whether the run has failed, and refuses most requests."""
        return self.service.run.progress.state != "running"

    def send_raw(self, verb: str, data: bytes) -> Message:
        """Send any bytes, check all invariants, and return the reply."""
        query = Query(data)
        accepted = self.service.run.progress.accepted
        self._exchange.queryables[key_expressions.key(self._run_id, verb)](query)
        self.service.answer_waiting(0.0)
        assert not query.dropped
        (sent,) = query.replies
        self._check_ledgers()
        if sent.is_problem:
            return decode(sent.data, Problem)
        if self.service.run.progress.accepted > accepted:
            self._check_accepted(data)
        reply: type[Message] = BY_NAME[verb].reply
        return decode(sent.data, reply, 1 << 30)

    def _check_ledgers(self) -> None:
        progress, outstanding = self.service.run.progress, self.service.run.dispatcher.outstanding
        assert progress.issued == progress.accepted + progress.cancelled + len(outstanding)
        assert progress.delivered == progress.accepted + progress.duplicate + progress.rejected

    def _check_accepted(self, data: bytes) -> None:
        """Decode an accepted episode by the documentation alone."""
        fields = msgpack.unpackb(data, strict_map_key=True)
        length = fields["rewards"]["shape"][0]
        assert 1 <= length <= self.spec.max_episode_steps
        assert fields["observations"]["shape"] == [length, *self.spec.observation_space.shape]
        assert fields["actions"]["shape"] == [length]
        seen = self.spec.observation_space.dtype.str
        for name, dtype in (("observations", seen), ("actions", "|u1"), ("rewards", "<f4")):
            array = fields[name]
            assert array["dtype"] == dtype
            values = np.frombuffer(array["data"], dtype)
            assert len(values) == np.prod(array["shape"])
            assert np.isfinite(values).all()
        actions = np.frombuffer(fields["actions"]["data"], "|u1")
        assert actions.max() < self.spec.action_space.n_parameters
        assert fields["terminated"] or fields["truncated"]


def valid_requests() -> list[tuple[str, bytes]]:
    """Return the requests of a learner and an actor in a run's first iterations, encoded.

    A new world accepts them all in this order.
    """
    world, requests = World(), []
    generator = EpisodeGenerator(CONFIG, 4)
    states: list[TrainingState] = [untrained(CONFIG, generator.spec)]
    graph = acting_graph(CONFIG.network, generator.spec)

    def ask(verb: str, request: Message | bytes) -> Message:
        data = request if isinstance(request, bytes) else encode(request)
        requests.append((verb, data))
        reply = world.send_raw(verb, data)
        assert not isinstance(reply, Problem), reply
        return reply

    def act() -> None:
        request = CommandsRequest(actor="actor-1", wanted=4)
        commands = cast(CommandsReply, ask(verbs.COMMANDS.name, request)).commands
        by_version: dict[int, list[Command]] = {}
        for command in commands:
            by_version.setdefault(command.weights_version, []).append(command)
        for version, together in by_version.items():
            weights = states[version].weights
            behavior = ActingFunction(graph, weights) if version else None
            for episode in generate_episodes(generator, together, behavior):
                ask(verbs.EPISODE.name, encode_episode(episode, "actor-1"))

    ask(verbs.HELLO.name, HelloRequest())
    ask(
        verbs.JOIN.name,
        JoinRequest(
            role="actor",
            id="actor-1",
            host="h",
            pid=1,
            software="0",
            environments=4,
            numerics_class="c",
            environment=world.spec,
            environment_digest=world.service.run.hello.environment_digest,
        ),
    )
    ask(verbs.JOIN.name, JoinRequest(role="learner", id="learner-1", host="h", pid=1, software="0",
                               numerics_class="c"))  # fmt: skip
    act()
    for version in (1, 2):
        ids = cast(
            ChangesReply,
            ask(verbs.CHANGES.name, ChangesRequest(learner="learner-1", version=version)),
        ).ids
        ask(verbs.EPISODES.name, EpisodesRequest(ids=ids))
        ask(verbs.STATE.name, StateRequest(learner="learner-1"))
        states.append(_train(world, version, states))
        state = states[version]
        ask(verbs.VERSION.name, VersionMessage(
            learner="learner-1", version=version, weights=encode_weights(state.weights),
            optimizer=encode_optimizer(state), loss=state.loss, train_s=0.1))  # fmt: skip
        ask(verbs.WEIGHTS.name, WeightsRequest(version="latest"))
        act()
        act()
    held = next(iter(world.service.run.dispatcher.outstanding))
    ask(verbs.FAILURE.name, FailureMessage(actor="actor-1", command_id=held, error="no fuel"))
    ask(verbs.STATUS.name, StatusRequest())
    ask(verbs.HISTORY.name, HistoryRequest(after=-1))
    ask(verbs.CONTENTS.name, ContentsRequest())
    generator.close()
    world.close()
    return requests


def _train(world: World, version: int, states: list[TrainingState]) -> TrainingState:
    experience = Experience(CONFIG, world.spec)
    ids = [p.entry.id for p in world._store.buffer(version - 1)]
    for body in world._store.episode_bodies(ids, 1 << 30):
        experience.add(decode_episode(decode(body, EpisodeMessage), world.spec.observation_space))
    state = deepcopy(states[-1])
    train(state, experience.by_rank(ids), CONFIG)
    return state


class Target:
    """The function that a fuzzer calls with one input after another."""

    #: Inputs after which a new run is created, so that no state is unreachable for long.
    PERIOD = 5000

    def __init__(self, requests: list[tuple[str, bytes]]) -> None:
        self._requests = requests
        self._world: World | None = None
        self._left = 0
        self.accepted = self.refused = 0

    def seeds(self) -> list[bytes]:
        """Return initial inputs: a byte for the verb, then the payload."""
        return [bytes([NAMES.index(verb)]) + data for verb, data in self._requests]

    def __call__(self, data: bytes) -> None:
        """Send one input."""
        if self._left == 0 or self._world is None or self._world.is_over:
            self._begin()
        self._left -= 1
        assert self._world is not None
        verb = NAMES[(data[0] if data else 0) % len(NAMES)]
        reply = self._world.send_raw(verb, data[1:])
        if isinstance(reply, Problem):
            self.refused += 1
        else:
            self.accepted += 1

    def _begin(self) -> None:
        if self._world is not None:
            self._world.close()
        self._world = World()
        self._left = self.PERIOD
        # Runs start at the beginning and at three later states, in turn.
        skip = (self.accepted + self.refused) // self.PERIOD % 4
        for verb, data in self._requests[: len(self._requests) * skip // 4]:
            self._world.send_raw(verb, data)

    def close(self) -> None:
        """Close the run."""
        if self._world is not None:
            self._world.close()


def decode_as_every_message(data: bytes) -> None:
    """Decode bytes as every message type: each result must round-trip, or the bytes be rejected."""
    for kind in Message.__subclasses__():
        try:
            message = decode(data, kind)
        except InvalidData:
            continue
        assert encode(decode(encode(message), kind)) == encode(message)
