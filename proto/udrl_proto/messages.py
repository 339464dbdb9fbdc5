"""The messages that services do their work with, as types; ``codec`` makes bytes of them and back.

Those in which a run tells how it is doing are in :mod:`udrl_proto.reports`.

A field that is not listed, missing or out of range makes the whole message invalid.
"""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from udrl.commands import Command
from udrl.config import Configured, FlatSettings
from udrl.environments import EnvironmentSpec

Name = Annotated[str, Meta(min_length=1, max_length=100, pattern=r"^[A-Za-z0-9._-]+\Z")]
Text = Annotated[str, Meta(max_length=4000)]
Number = Annotated[int, Meta(ge=0, le=2**62)]
Positive = Annotated[int, Meta(ge=1, le=2**62)]
Finite = Annotated[float, Meta(ge=-1e300, le=1e300)]
Role = Literal["actor", "learner"]


class Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of all messages."""


class Array(Message, frozen=True, kw_only=True):
    """An array: C order, little-endian.

    Attributes:
        dtype: numpy's name of it: ``<f4``, ``|u1``, ``<i4``; or ``|V`` and a number of bytes, of
            the structures of a record.
        shape: its dimensions, none of them 0.
        data: its bytes.
    """

    dtype: Annotated[str, Meta(pattern=r"^(<f4|\|u1|<i4|\|V[1-9][0-9]{0,8})$")]
    shape: Annotated[tuple[Positive, ...], Meta(max_length=4)]
    data: bytes


class Wait(Message, frozen=True, kw_only=True):
    """There is nothing to do now.

    Attributes:
        on: who or what is being waited for, in words.
        retry_after_s: when to ask again if no publication tells sooner, seconds.
    """

    on: Text
    retry_after_s: Annotated[float, Meta(gt=0, le=3600)]


class Problem(Message, frozen=True, kw_only=True):
    """The payload of an error reply: the answer is no.

    Attributes:
        code: a name that programs can compare (``docs/protocol.md``).
        message: the value, what was expected, the remedy.
    """

    code: Name
    message: Text


class HelloRequest(Message, frozen=True, kw_only=True):
    """What run is this? Asked with a wildcard, it finds every run on a router."""


class Hello(Configured, Message, frozen=True, kw_only=True):
    """The run specification: all that a joining service needs to know.

    Attributes:
        protocol: version of this contract.
        software: version of the package that the replay service runs.
        run_id: the run's name in key expressions.
        settings: what the run is, flat.
        environment: what its environment looks like.
        environment_digest: of a short episode there; empty: it does not repeat itself.
        graph: the acting graph, an ONNX model whose weights have no values (:mod:`udrl.graph`).
        acting_class: numerics class of the actors, set by the first that delivers
            (``docs/protocol.md``).
        training_class: numerics class of the learner, likewise.
        allow_inexact: accept services of other numerics classes.
        exact: whether the run's result is still a function of its configuration.
    """

    protocol: Number
    software: Text
    run_id: Name
    settings: FlatSettings = msgspec.field(name="config")
    environment: EnvironmentSpec
    environment_digest: Text = ""
    graph: Annotated[bytes, Meta(max_length=2**19)]
    acting_class: Text = ""
    training_class: Text = ""
    allow_inexact: bool = False
    exact: bool = True


class JoinRequest(Message, frozen=True, kw_only=True):
    """An actor or learner asks to take part.

    Attributes:
        id: unique to this process.
        environments: how many an actor steps at once; 0 for a learner.
        numerics_class: digest of its probe.
        environment: what its own copy of the environment looks like; None: it has none.
        environment_digest: of a short episode there.
    """

    role: Role
    id: Name
    host: Text
    pid: Number
    software: Text
    environments: Annotated[int, Meta(ge=0, le=65_536)] = 0
    numerics_class: Text
    environment: EnvironmentSpec | None = None
    environment_digest: Text = ""


class JoinReply(Message, frozen=True, kw_only=True):
    """Welcome."""


class CommandsRequest(Message, frozen=True, kw_only=True):
    """An actor asks for work.

    Attributes:
        wanted: how many commands it could start now.
        running: ids of all commands that it holds and has not delivered. A command that was dealt
            to it and is not among them is taken to be lost, and dealt again.
        spare_cores: cores of its machine that are idle, as far as it knows.
        env_steps_per_s: of the last seconds.
        weights_version: the newest that it has.
    """

    actor: Name
    wanted: Annotated[int, Meta(ge=0, le=65_536)]
    running: Annotated[tuple[Number, ...], Meta(max_length=65_536)] = ()
    spare_cores: Finite = 0.0
    env_steps_per_s: Finite = 0.0
    weights_version: Number = 0


class CommandsReply(Message, frozen=True, kw_only=True):
    """Commands to carry out; or, when there are none, why; or the end of the run."""

    commands: tuple[Command, ...] = ()
    wait: Wait | None = None
    ended: bool = False


class EpisodeMessage(Message, frozen=True, kw_only=True):
    """A finished episode; arrays as in :class:`udrl.episode.Episode`."""

    actor: Name
    command_id: Number
    observations: Array
    actions: Array
    rewards: Array
    terminated: bool
    truncated: bool


class EpisodeReply(Message, frozen=True, kw_only=True):
    """What became of an episode; sent after it is on disk. Rejection is a :class:`Problem`."""

    result: Literal["accepted", "duplicate"]


class FailureMessage(Message, frozen=True, kw_only=True):
    """An actor could not carry out a command, through its environment's fault."""

    actor: Name
    command_id: Number
    error: Text


class Acknowledged(Message, frozen=True, kw_only=True):
    """It is noted."""


class ChangesRequest(Message, frozen=True, kw_only=True):
    """A learner asks for the buffer that a version is trained on: as it is after version - 1."""

    learner: Name
    version: Positive


class ChangesReply(Message, frozen=True, kw_only=True):
    """The buffer's episodes by rank, least return first; or what it waits for; or the end."""

    ids: tuple[Number, ...] = ()
    wait: Wait | None = None
    ended: bool = False


class EpisodesRequest(Message, frozen=True, kw_only=True):
    """A learner asks for episodes that it does not hold."""

    ids: Annotated[tuple[Number, ...], Meta(min_length=1, max_length=100_000)]


class EpisodesReply(Message, frozen=True, kw_only=True):
    """The first of them, as many as fit a page of 4 MB, at least one; ask again for the others."""

    episodes: tuple[bytes, ...]


class VersionMessage(Message, frozen=True, kw_only=True):
    """A learner delivers a weights version.

    Attributes:
        version: v.
        weights: safetensors (:mod:`udrl.weights`).
        optimizer: safetensors, Adam's state.
        loss: mean cross-entropy, nats.
        train_s: seconds that training took.
    """

    learner: Name
    version: Positive
    weights: bytes
    optimizer: bytes
    loss: float
    train_s: Finite


class VersionReply(Message, frozen=True, kw_only=True):
    """What became of a version; sent after it is on disk."""

    result: Literal["accepted", "duplicate"]


class StateRequest(Message, frozen=True, kw_only=True):
    """A learner asks where to go on."""

    learner: Name


class StateReply(Message, frozen=True, kw_only=True):
    """The latest version with its optimizer; version 0 means: begin untrained."""

    version: Number
    weights: bytes = b""
    optimizer: bytes = b""


class WeightsRequest(Message, frozen=True, kw_only=True):
    """Anyone asks for a version that is kept."""

    version: Number | Literal["latest", "best"]


class Weights(Message, frozen=True, kw_only=True):
    """A version's weights: the answer to a request, and what the learner publishes."""

    version: Number
    weights: bytes


class Progress(Message, frozen=True, kw_only=True):
    """Published by the replay service when an iteration is complete."""

    iteration: Number
