"""Answering queries: the replay service's side of the contract.

Queries arrive on Zenoh's threads, are decoded there, and wait in one bounded queue for the one
thread that owns the run. A query that finds the inbox full gets no answer and is asked again.
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
from udrl_proto.transport import Answer, Declaration, Query, Transport
from udrl_proto.verbs import VERBS, AnyVerb


@dataclass(frozen=True)
class Question:
    """A query that has been decoded and waits for its answer.

    Attributes:
        verb: what is asked.
        request: its message, or the error that kept it from being one.
    """

    verb: AnyVerb
    request: Message | InvalidData
    _query: Query

    def answer(self, reply: Message) -> None:
        """Send the answer; a :class:`Problem` goes as an error reply."""
        self._query.reply(Answer(encode(reply), is_problem=isinstance(reply, Problem)))


def serve(
    transport: Transport,
    run_id: str,
    inbox: Inbox[Any],
    verbs: Iterable[AnyVerb] = VERBS,
    prepare: Mapping[str, Callable[[Any], Any]] = MappingProxyType({}),
) -> list[Declaration]:
    """Answer verbs; undeclare them to stop.

    Args:
        transport: where.
        run_id: whose.
        inbox: takes the questions.
        verbs: what is answered.
        prepare: by the verb's name, what turns a message into what the run wants, on the thread
            that received it.
    """

    def receiver(verb: AnyVerb) -> Callable[[Query], None]:
        prepared = prepare.get(verb.name, lambda request: request)

        def receive(query: Query) -> None:
            request: Any
            data = query.data
            if not inbox.has_room(len(data), bulk=verb.is_bulk):  # before the work of reading it
                query.drop()
                return
            try:
                request = prepared(decode(data, verb.request, verb.limit))
            except InvalidData as error:
                request = error
            if not inbox.put(Question(verb, request, query), len(data), bulk=verb.is_bulk):
                query.drop()

        return receive

    return [
        transport.answer(key_expressions.key(run_id, verb.name), receiver(verb)) for verb in verbs
    ]
