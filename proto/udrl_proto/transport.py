"""What services need of a network: questions and answers, news, and who is here.

:class:`udrl_proto.zenoh_transport.ZenohTransport` is the one that runs use,
:class:`udrl_proto.memory_transport.MemoryTransport` has no network.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol


class Answer(NamedTuple):
    """An answer to a question.

    Attributes:
        data: a message.
        is_problem: it is a :class:`udrl_proto.messages.Problem`.
    """

    data: bytes
    is_problem: bool


class Presence(NamedTuple):
    """A service came, or went.

    Attributes:
        key: the service's.
        here: whether it is here now.
    """

    key: str
    here: bool


class Query(Protocol):
    """A question that somebody waits to have answered; once, from any thread."""

    @property
    def data(self) -> bytes:
        """The request."""
        ...

    def reply(self, answer: Answer) -> None:
        """Send the answer; who asked may be gone, and will ask again."""
        ...

    def drop(self) -> None:
        """Give no answer; it will be asked again."""
        ...


class Declaration(Protocol):
    """Something that was declared."""

    def undeclare(self) -> None:
        """Take it back."""
        ...


class Transport(Protocol):
    """One service's access to the keys of a run (:mod:`udrl_proto.key_expressions`)."""

    def ask(self, key: str, data: bytes, timeout_s: float) -> Iterator[Answer]:
        """Yield the answers to a question; none where nobody answers in time."""
        ...

    def answer(self, key: str, receive: Callable[[Query], None]) -> Declaration:
        """Have the questions on a key received, on the transport's threads."""
        ...

    def publish(self, key: str, data: bytes) -> None:
        """Send to all subscribers; it may be lost."""
        ...

    def subscribe(self, key: str, receive: Callable[[bytes], None]) -> Declaration:
        """Have what is published on a key received, on the transport's threads."""
        ...

    def declare_presence(self, key: str) -> Declaration:
        """Say that a service is here, until it is undeclared or the service is gone."""
        ...

    def present(self, key: str, timeout_s: float) -> list[str]:
        """Return the keys of services that are here; ``$*`` stands for any end of a part."""
        ...

    def watch(self, key: str, receive: Callable[[Presence], None]) -> Declaration:
        """Have it received who comes and goes, those included that are here.

        Args:
            key: of services; ``*`` stands for any part.
            receive: is called on the transport's threads.
        """
        ...
