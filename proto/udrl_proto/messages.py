"""The messages between services, as types; :mod:`udrl_proto.codec` encodes and decodes them.

Messages that report the state of a run are in :mod:`udrl_proto.reports`.

A field that is unknown, missing or out of range makes the whole message invalid.
"""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from udrl.commands import Command
from udrl.config import Configured, FlatSettings
from udrl.environments import EnvironmentSpec

Name = Annotated[str, Meta(min_length=1, max_length=100, pattern=r"^[A-Za-z0-9._-]+\Z")]
#: Maximum number of characters of a text.
MAX_TEXT = 4000
#: Largest integer; the store's integers have 64 bits.
MAX_NUMBER = 2**62
Text = Annotated[str, Meta(max_length=MAX_TEXT)]
Number = Annotated[int, Meta(ge=0, le=MAX_NUMBER)]
Positive = Annotated[int, Meta(ge=1, le=MAX_NUMBER)]
Finite = Annotated[float, Meta(ge=-1e300, le=1e300)]
Role = Literal["actor", "learner"]

#: Maximum number of episodes in one request of a learner.
MAX_EPISODES = 100_000


class Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of all messages."""


class ArrayMessage(Message, frozen=True, kw_only=True):
    """An array: C order, little-endian.

    Attributes:
        dtype: numpy's type string: ``<f4``, ``|u1`` or ``<i4``; for records ``|V`` and the number
            of bytes.
        shape: sizes of the dimensions, none of them 0.
        data: the elements' bytes.
    """

    dtype: Annotated[str, Meta(pattern=r"^(<f4|\|u1|<i4|\|V[1-9][0-9]{0,8})$")]
    shape: Annotated[tuple[Positive, ...], Meta(max_length=4)]
    data: bytes


class Wait(Message, frozen=True, kw_only=True):
    """There is nothing to do now.

    Attributes:
        on: description of what is being waited for.
        retry_after_s: seconds until the request should be repeated, unless a publication arrives
            earlier.
    """

    on: Text
    retry_after_s: Annotated[float, Meta(gt=0, le=3600)]


class Problem(Message, frozen=True, kw_only=True):
    """The payload of an error reply: the request is refused.

    Attributes:
        code: machine-readable name of the reason (``docs/protocol.md``).
        message: the value, what was expected, the remedy.
    """

    code: Name
    message: Text


class HelloRequest(Message, frozen=True, kw_only=True):
    """Request for the run specification; with a wildcard key it finds every run on a router."""


class Hello(Configured, Message, frozen=True, kw_only=True):
    """The run specification: all that a joining service needs to know.

    Attributes:
        protocol: version of this contract.
        software: version of the package that the replay service runs.
        run_id: the run's name in key expressions.
        settings: the settings of the run, without groups.
        environment: spaces and limits of the environment.
        environment_digest: digest of a short episode; empty if episodes do not repeat.
        graph: the acting graph, an ONNX model without values of the weights (:mod:`udrl.graph`).
        acting_class: numerics class of the actors, set by the first that delivers an episode
            (``docs/protocol.md``).
        training_class: numerics class of the learner, set by the first that delivers a version.
        allow_inexact: accept services of other numerics classes.
        exact: whether the run's result still depends only on its configuration.
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
    """Request of an actor or learner to join the run.

    Attributes:
        role: the role that it joins in.
        id: unique to this process.
        host: name of its machine.
        pid: id of its process.
        software: version of its package.
        environments: number of environments that an actor steps; 0 for a learner.
        numerics_class: digest of the service's numerics probe.
        environment: specification of the service's own environment; None if it has none.
        environment_digest: digest of a short episode in that environment.
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
    """The service has joined."""


class CommandsRequest(Message, frozen=True, kw_only=True):
    """An actor's request for commands.

    Attributes:
        wanted: number of commands that the actor can start now.
        running: ids of all commands that the actor holds and has not delivered. A command that was
            assigned to it and is missing here is considered lost and assigned again.
        spare_cores: estimated number of idle cores of its machine.
        env_steps_per_s: rate over the last seconds.
        weights_version: newest weights version that the actor has.
    """

    actor: Name
    wanted: Annotated[int, Meta(ge=0, le=65_536)]
    running: Annotated[tuple[Number, ...], Meta(max_length=65_536)] = ()
    spare_cores: Finite = 0.0
    env_steps_per_s: Finite = 0.0
    weights_version: Number = 0


class CommandsReply(Message, frozen=True, kw_only=True):
    """Commands to run; or, if there are none, the reason to wait; or the end of the run."""

    commands: tuple[Command, ...] = ()
    wait: Wait | None = None
    ended: bool = False


class EpisodeMessage(Message, frozen=True, kw_only=True):
    """A completed episode; arrays as in :class:`udrl.episode.Episode`."""

    actor: Name
    command_id: Number
    observations: ArrayMessage
    actions: ArrayMessage
    rewards: ArrayMessage
    terminated: bool
    truncated: bool


class EpisodeReply(Message, frozen=True, kw_only=True):
    """Receipt for an episode, sent when it is on disk. A rejection is a :class:`Problem`."""

    result: Literal["accepted", "duplicate"]


class FailureMessage(Message, frozen=True, kw_only=True):
    """Report that an actor could not run a command because its environment failed."""

    actor: Name
    command_id: Number
    error: Text


class Acknowledged(Message, frozen=True, kw_only=True):
    """Receipt for a message without any other reply."""


class ChangesRequest(Message, frozen=True, kw_only=True):
    """A learner's request for the buffer of a version: the one after iteration version - 1."""

    learner: Name
    version: Positive


class ChangesReply(Message, frozen=True, kw_only=True):
    """The buffer's episodes by rank, lowest return first; or the reason to wait; or the end."""

    ids: tuple[Number, ...] = ()
    wait: Wait | None = None
    ended: bool = False


class EpisodesRequest(Message, frozen=True, kw_only=True):
    """A learner's request for episodes that it does not have."""

    ids: Annotated[tuple[Number, ...], Meta(min_length=1, max_length=MAX_EPISODES)]


class EpisodesReply(Message, frozen=True, kw_only=True):
    """The first requested episodes, up to 4 MiB but at least one; request the rest again."""

    episodes: Annotated[tuple[bytes, ...], Meta(min_length=1, max_length=MAX_EPISODES)]


class VersionMessage(Message, frozen=True, kw_only=True):
    """Delivery of a weights version by a learner.

    Attributes:
        version: its number v.
        weights: safetensors (:mod:`udrl.weights`).
        optimizer: Adam's state, safetensors.
        loss: mean cross-entropy, nats.
        train_s: training time, seconds.
    """

    learner: Name
    version: Positive
    weights: bytes
    optimizer: bytes
    loss: float
    train_s: Finite


class VersionReply(Message, frozen=True, kw_only=True):
    """Receipt for a version, sent when it is on disk."""

    result: Literal["accepted", "duplicate"]


class StateRequest(Message, frozen=True, kw_only=True):
    """A learner's request for the state to continue from."""

    learner: Name


class StateReply(Message, frozen=True, kw_only=True):
    """The latest version with its optimizer state; version 0: start untrained."""

    version: Number
    weights: bytes = b""
    optimizer: bytes = b""


class WeightsRequest(Message, frozen=True, kw_only=True):
    """Request for the weights of a version that is kept."""

    version: Number | Literal["latest", "best"]


class WeightsMessage(Message, frozen=True, kw_only=True):
    """A version's weights, as a reply and as the learner's publication."""

    version: Number
    weights: bytes


class Progress(Message, frozen=True, kw_only=True):
    """Published by the replay service when an iteration is complete."""

    iteration: Number
