"""A replay service that replies from a script, without a network."""

from collections.abc import Callable
from typing import Any

from udrl_proto import key_expressions
from udrl_proto.codec import decode, encode
from udrl_proto.memory_transport import Exchange, MemoryTransport
from udrl_proto.messages import Message, Problem
from udrl_proto.transport import EncodedReply, Query
from udrl_proto.verbs import Verb


class Scripted:
    """Replies as scripted, and records the requests.

    Args:
        run_id: id of the run that it serves.

    Attributes:
        transport: connects to it.
        received: verb and message of each request, in order.
    """

    def __init__(self, run_id: str) -> None:
        self._run_id = run_id
        self.transport = MemoryTransport(Exchange())
        self.received: list[tuple[str, Any]] = []

    def answers(self, verb: Verb[Any, Any], script: Callable[[Any], Message]) -> None:
        """Reply to a verb's requests by a function of the request."""

        def receive(query: Query) -> None:
            request = decode(query.data, verb.request, verb.limit)
            self.received.append((verb.name, request))
            answer = script(request)
            query.reply(EncodedReply(encode(answer), is_problem=isinstance(answer, Problem)))

        self.transport.declare_queryable(key_expressions.key(self._run_id, verb.name), receive)

    def publish(self, name: str, message: Message) -> None:
        """Publish a message."""
        self.transport.publish(key_expressions.key(self._run_id, name), encode(message))

    def requests(self, verb: Verb[Any, Any]) -> list[Any]:
        """Return the requests of a verb."""
        return [request for name, request in self.received if name == verb.name]
