"""What services need from a network: queries and replies, publications, and presence.

Runs use :class:`udrl_proto.zenoh_transport.ZenohTransport`;
:class:`udrl_proto.memory_transport.MemoryTransport` needs no network.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol


class EncodedReply(NamedTuple):
    """A reply to a query.

    Attributes:
        data: an encoded message.
        is_problem: whether it is a :class:`udrl_proto.messages.Problem`.
    """

    data: bytes
    is_problem: bool


class Presence(NamedTuple):
    """A service appeared or disappeared.

    Attributes:
        key: key of the service's liveliness token.
        here: whether the service is present now.
    """

    key: str
    here: bool


class Query(Protocol):
    """A received query; reply to it or drop it once, on any thread."""

    @property
    def data(self) -> bytes:
        """The request."""
        ...

    def reply(self, reply: EncodedReply) -> None:
        """Send the reply. It may be lost; the sender of the query then retries."""
        ...

    def drop(self) -> None:
        """Send no reply; the sender retries."""
        ...


class Declaration(Protocol):
    """A declared queryable, subscriber or liveliness token."""

    def undeclare(self) -> None:
        """Withdraw the declaration."""
        ...


class Transport(Protocol):
    """One service's access to the keys of a run (:mod:`udrl_proto.key_expressions`)."""

    def query(self, key: str, data: bytes, timeout_s: float) -> Iterator[EncodedReply]:
        """Yield the replies to a query that arrive within ``timeout_s`` seconds."""
        ...

    def declare_queryable(self, key: str, receive: Callable[[Query], None]) -> Declaration:
        """Call ``receive`` for each query on a key, on the transport's threads."""
        ...

    def publish(self, key: str, data: bytes) -> None:
        """Send to all subscribers; it may be lost."""
        ...

    def subscribe(self, key: str, receive: Callable[[bytes], None]) -> Declaration:
        """Call ``receive`` for each publication on a key, on the transport's threads."""
        ...

    def declare_presence(self, key: str) -> Declaration:
        """Announce a service, until this is undeclared or the process ends."""
        ...

    def present(self, key: str, timeout_s: float) -> list[str]:
        """Return the keys of the services that are present; ``$*`` matches the end of a part."""
        ...

    def watch(self, key: str, receive: Callable[[Presence], None]) -> Declaration:
        """Call ``receive`` for each service that is present, appears or disappears.

        Args:
            key: pattern for the keys of services; ``*`` matches any part.
            receive: called on the transport's threads.
        """
        ...
