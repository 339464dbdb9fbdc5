"""Answering queries: the replay service's side of the contract.

Queries arrive on Zenoh's threads, are decoded there, and wait in one bounded queue for the one
thread that owns the run. A query that finds the inbox full gets no answer and is asked again.
"""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import zenoh

from udrl.errors import InvalidData
from udrl_proto import keys
from udrl_proto.codec import decode, encode
from udrl_proto.inbox import Inbox
from udrl_proto.messages import Message, Problem

log = logging.getLogger("udrl")


@dataclass(frozen=True)
class Question:
    """A query that has been decoded and waits for its answer.

    Attributes:
        verb: from :mod:`udrl_proto.keys`.
        request: its message, or the error that kept it from being one.
    """

    verb: str
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
            log.debug("answer to %s could not be sent: %s", self.verb, error)


@dataclass(frozen=True)
class Verb:
    """How a verb's requests are read.

    Attributes:
        kind: the message.
        limit: the most bytes it may have.
        bulk: its questions are many and large, and wait for all others.
        prepare: turns the message into what the run wants, on the thread that received it.
    """

    kind: type[Message]
    limit: int
    bulk: bool = False
    prepare: Callable[[Any], Any] = lambda request: request


def serve(
    session: zenoh.Session, run_id: str, verbs: Mapping[str, Verb], inbox: Inbox[Any]
) -> list[zenoh.Queryable[None]]:
    """Declare a queryable for every verb; questions go to ``inbox``. Undeclare them to stop."""

    def receiver(name: str, verb: Verb) -> Callable[[zenoh.Query], None]:
        key = keys.key(run_id, name)

        def receive(query: zenoh.Query) -> None:
            request: Any
            payload = query.payload
            data = b"" if payload is None else payload.to_bytes()
            if not inbox.has_room(len(data), bulk=verb.bulk):  # before the work of reading it
                query.drop()
                return
            try:
                request = verb.prepare(decode(data, verb.kind, verb.limit))
            except InvalidData as error:
                request = error
            if not inbox.put(Question(name, request, query, key), len(data), bulk=verb.bulk):
                query.drop()

        return receive

    return [
        session.declare_queryable(keys.key(run_id, name), receiver(name, verb), complete=True)
        for name, verb in verbs.items()
    ]
