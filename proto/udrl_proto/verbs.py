"""The verbs of a run's replay service, each with its messages, limits and permitted roles."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from udrl_proto.codec import LARGEST, PAGE, REPORT, SMALL
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
    WeightsMessage,
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

#: Largest message with only a few numbers and names, bytes.
FEW = 4096


@dataclass(frozen=True)
class Verb(Generic[Request, Reply]):
    """A kind of request.

    Attributes:
        name: the verb in keys.
        request: message type of the request.
        reply: message type of the reply; a refusal is a :class:`udrl_proto.messages.Problem`.
        senders: roles that may send it (:mod:`udrl_proto.access`).
        limit: largest request, bytes; for episodes each run computes its own limit.
        reply_limit: largest reply, bytes.
        is_bulk: whether its requests are many and large, and have low priority.
    """

    name: str
    request: type[Request]
    reply: type[Reply]
    senders: tuple[str, ...]
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
WEIGHTS = Verb("weights", WeightsRequest, WeightsMessage, _ACTOR + _OBSERVER, reply_limit=LARGEST)
STATUS = Verb("status", StatusRequest, Status, _OBSERVER, reply_limit=REPORT)
HISTORY = Verb("history", HistoryRequest, History, _OBSERVER)
CONTENTS = Verb("contents", ContentsRequest, Contents, _OBSERVER)

AnyVerb = Verb[Any, Any]

VERBS: tuple[AnyVerb, ...] = (
    HELLO, JOIN, COMMANDS, EPISODE, FAILURE, CHANGES, EPISODES, VERSION, STATE, WEIGHTS, STATUS,
    HISTORY, CONTENTS,
)  # fmt: skip


def sent_by(role: str) -> Iterable[str]:
    """Return the names of the verbs that a role may send."""
    return [verb.name for verb in VERBS if role in verb.senders]
