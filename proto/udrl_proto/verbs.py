"""What can be asked of a run's replay service: each verb with its messages, limits and askers."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from udrl_proto.codec import LARGEST, PAGE, SMALL
from udrl_proto.messages import (
    Acknowledged,
    ChangesReply,
    ChangesRequest,
    CommandsReply,
    CommandsRequest,
    EpisodeMessage,
    EpisodeReply,
    EpisodesReply,
    EpisodesRequest,
    FailureMessage,
    Hello,
    HelloRequest,
    JoinReply,
    JoinRequest,
    Message,
    StateReply,
    StateRequest,
    VersionMessage,
    VersionReply,
    Weights,
    WeightsRequest,
)
from udrl_proto.reports import (
    Contents,
    ContentsRequest,
    History,
    HistoryRequest,
    Status,
    StatusRequest,
)

Request = TypeVar("Request", bound=Message)
Reply = TypeVar("Reply", bound=Message)

#: Bytes of a message that holds a few numbers and names.
FEW = 4096


@dataclass(frozen=True)
class Verb(Generic[Request, Reply]):
    """A kind of question.

    Attributes:
        name: as it stands in keys.
        request: its message.
        reply: the answer's message; a :class:`udrl_proto.messages.Problem` says no instead.
        askers: the roles that may ask it (:mod:`udrl_proto.access`).
        limit: the most bytes that a request may have; of an episode the run knows better.
        reply_limit: the most bytes that a reply may have.
        is_bulk: its questions are many and large, and wait for all others.
    """

    name: str
    request: type[Request]
    reply: type[Reply]
    askers: tuple[str, ...]
    limit: int = FEW
    reply_limit: int = SMALL
    is_bulk: bool = False


_ACTOR, _LEARNER, _OBSERVER = ("actor",), ("learner",), ("observer",)
_SERVICES = _ACTOR + _LEARNER

HELLO = Verb("hello", HelloRequest, Hello, _SERVICES + _OBSERVER)
JOIN = Verb("join", JoinRequest, JoinReply, _SERVICES, 1 << 16)
COMMANDS = Verb("commands", CommandsRequest, CommandsReply, _ACTOR, SMALL)
EPISODE = Verb("episode", EpisodeMessage, EpisodeReply, _ACTOR, LARGEST, is_bulk=True)
FAILURE = Verb("failure", FailureMessage, Acknowledged, _ACTOR, 1 << 16)
CHANGES = Verb("changes", ChangesRequest, ChangesReply, _LEARNER, reply_limit=LARGEST)
EPISODES = Verb("episodes", EpisodesRequest, EpisodesReply, _LEARNER, PAGE, LARGEST)
VERSION = Verb("version", VersionMessage, VersionReply, _LEARNER, LARGEST)
STATE = Verb("state", StateRequest, StateReply, _LEARNER, reply_limit=LARGEST)
WEIGHTS = Verb("weights", WeightsRequest, Weights, _ACTOR + _OBSERVER, reply_limit=LARGEST)
STATUS = Verb("status", StatusRequest, Status, _OBSERVER)
HISTORY = Verb("history", HistoryRequest, History, _OBSERVER)
CONTENTS = Verb("contents", ContentsRequest, Contents, _OBSERVER)

AnyVerb = Verb[Any, Any]

VERBS: tuple[AnyVerb, ...] = (
    HELLO, JOIN, COMMANDS, EPISODE, FAILURE, CHANGES, EPISODES, VERSION, STATE, WEIGHTS, STATUS,
    HISTORY, CONTENTS,
)  # fmt: skip

BY_NAME = {verb.name: verb for verb in VERBS}


def asked_by(role: str) -> Iterable[str]:
    """Return the names of the verbs that a role may ask."""
    return [verb.name for verb in VERBS if role in verb.askers]
