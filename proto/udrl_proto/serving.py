"""Replying to queries: the replay service's side of the contract.

Queries arrive on Zenoh's threads, are decoded there, and wait in a bounded inbox for the single
thread that owns the run. If the inbox is full, a query gets no reply, and its sender retries. Only
``hello`` is refused: a client must know of every run on its router.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from udrl.errors import InvalidData
from udrl_proto import key_expressions
from udrl_proto.codec import decode, encode
from udrl_proto.inbox import Inbox
from udrl_proto.messages import Message, Problem
from udrl_proto.transport import Declaration, EncodedReply, Query, Transport
from udrl_proto.verbs import HELLO, VERBS, AnyVerb


@dataclass(frozen=True)
class ReceivedRequest:
    """A decoded query that waits for its reply.

    Attributes:
        verb: the verb of its key.
        request: the decoded message, or the error if decoding failed.
    """

    verb: AnyVerb
    request: Message | InvalidData
    _query: Query

    def reply(self, message: Message) -> None:
        """Send the reply; a :class:`Problem` is sent as an error reply."""
        is_problem = isinstance(message, Problem)
        self._query.reply(EncodedReply(encode(message), is_problem=is_problem))


def serve(
    transport: Transport,
    run_id: str,
    inbox: Inbox[Any],
    verbs: Iterable[AnyVerb] = VERBS,
    prepare: Mapping[str, Callable[[Any], Any]] = MappingProxyType({}),
) -> list[Declaration]:
    """Declare a queryable for each verb; undeclare them to stop.

    Args:
        transport: receives the queries.
        run_id: the run in the keys.
        inbox: receives the decoded queries.
        verbs: the verbs to serve.
        prepare: by name of a verb, a function that converts its message for the run; called on the
            thread that received it.
    """

    def receiver(verb: AnyVerb) -> Callable[[Query], None]:
        prepared = prepare.get(verb.name, lambda request: request)

        def receive(query: Query) -> None:
            request: Any
            data = query.data
            if not inbox.has_room(len(data), bulk=verb.is_bulk):  # before decoding it
                _turn_away(verb, query)
                return
            try:
                request = prepared(decode(data, verb.request, verb.limit))
            except InvalidData as error:
                request = error
            if not inbox.put(ReceivedRequest(verb, request, query), len(data), bulk=verb.is_bulk):
                _turn_away(verb, query)

        return receive

    return [
        transport.declare_queryable(key_expressions.key(run_id, verb.name), receiver(verb))
        for verb in verbs
    ]


def _turn_away(verb: AnyVerb, query: Query) -> None:
    """End a query for which the inbox has no room."""
    if verb.name == HELLO.name:
        busy = Problem(code="busy", message="too many requests are waiting; send this one again")
        query.reply(EncodedReply(encode(busy), is_problem=True))
    else:
        query.drop()
