"""Answering queries: the replay service's side of the contract.

Queries arrive on Zenoh's threads, are decoded there, and wait in one bounded queue for the one
thread that owns the run. A query that finds the inbox full gets no answer and is asked again.
"""

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import zenoh

from udrl.errors import InvalidData
from udrl_proto import keys
from udrl_proto.codec import decode, encode
from udrl_proto.inbox import Inbox
from udrl_proto.messages import Message, Problem
from udrl_proto.verbs import VERBS, Verb

log = logging.getLogger("udrl")

AnyVerb = Verb[Any, Any]


@dataclass(frozen=True)
class Question:
    """A query that has been decoded and waits for its answer.

    Attributes:
        verb: what is asked.
        request: its message, or the error that kept it from being one.
    """

    verb: AnyVerb
    request: Message | InvalidData
    _query: zenoh.Query
    _key: str

    def answer(self, reply: Message) -> None:
        """Send the answer; a :class:`Problem` goes as an error reply."""
        try:
            with self._query:
                if isinstance(reply, Problem):
                    self._query.reply_err(
                        encode(reply), encoding=zenoh.Encoding.APPLICATION_OCTET_STREAM
                    )
                else:
                    self._query.reply(self._key, encode(reply))
        except zenoh.ZError as error:
            # Who asked is gone; it will ask again when it is back.
            log.debug("answer to %s could not be sent: %s", self.verb.name, error)


def serve(
    session: zenoh.Session,
    run_id: str,
    inbox: Inbox[Any],
    verbs: Iterable[AnyVerb] = VERBS,
    prepare: Mapping[str, Callable[[Any], Any]] = MappingProxyType({}),
) -> list[zenoh.Queryable[None]]:
    """Declare a queryable for each verb; undeclare them to stop.

    Args:
        session: where.
        run_id: whose.
        inbox: takes the questions.
        verbs: what is answered.
        prepare: by the verb's name, what turns a message into what the run wants, on the thread
            that received it.
    """

    def receiver(verb: AnyVerb) -> Callable[[zenoh.Query], None]:
        key = keys.key(run_id, verb.name)
        prepared = prepare.get(verb.name, lambda request: request)

        def receive(query: zenoh.Query) -> None:
            request: Any
            payload = query.payload
            data = b"" if payload is None else payload.to_bytes()
            if not inbox.has_room(len(data), bulk=verb.is_bulk):  # before the work of reading it
                query.drop()
                return
            try:
                request = prepared(decode(data, verb.request, verb.limit))
            except InvalidData as error:
                request = error
            if not inbox.put(Question(verb, request, query, key), len(data), bulk=verb.is_bulk):
                query.drop()

        return receive

    return [
        session.declare_queryable(keys.key(run_id, verb.name), receiver(verb), complete=True)
        for verb in verbs
    ]
