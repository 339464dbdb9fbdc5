"""Zenoh as a transport; :mod:`udrl_proto.session` opens its sessions."""

import logging
from collections.abc import Callable, Iterator
from typing import Any

import zenoh

from udrl_proto.transport import Declaration, EncodedReply, Presence, Query

log = logging.getLogger("udrl")

#: Encoding of our own error replies, to distinguish them from Zenoh's, such as a timeout.
_OURS = zenoh.Encoding.APPLICATION_OCTET_STREAM


class ZenohTransport:
    """A transport over a Zenoh session.

    Args:
        session: an open session; the caller closes it.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session

    def query(self, key: str, data: bytes, timeout_s: float) -> Iterator[EncodedReply]:
        """Yield the replies to a query; Zenoh's own errors are ignored."""
        for reply in self._session.get(
            key,
            payload=data,
            timeout=timeout_s,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.BLOCK,
        ):
            if reply.ok is not None:
                yield EncodedReply(reply.ok.payload.to_bytes(), is_problem=False)
            elif reply.err is not None and reply.err.encoding == _OURS:
                found = reply.err.payload.to_bytes()
                if found != b"Timeout":
                    yield EncodedReply(found, is_problem=True)

    def declare_queryable(self, key: str, receive: Callable[[Query], None]) -> Declaration:
        """Declare a queryable."""
        return self._session.declare_queryable(
            key, lambda query: receive(_ZenohQuery(key, query)), complete=True
        )

    def publish(self, key: str, data: bytes) -> None:
        """Put a sample; it is dropped under congestion, Zenoh's default."""
        self._session.put(key, data)

    def subscribe(self, key: str, receive: Callable[[bytes], None]) -> Declaration:
        """Declare a subscriber."""
        return self._session.declare_subscriber(
            key, lambda sample: receive(sample.payload.to_bytes())
        )

    def declare_presence(self, key: str) -> Declaration:
        """Declare a liveliness token, which ends with the process."""
        return self._session.liveliness().declare_token(key)

    def present(self, key: str, timeout_s: float) -> list[str]:
        """Query liveliness tokens."""
        replies = self._session.liveliness().get(key, timeout=timeout_s)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def watch(self, key: str, receive: Callable[[Presence], None]) -> Declaration:
        """Declare a liveliness subscriber."""

        def note(sample: zenoh.Sample) -> None:
            receive(Presence(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))

        return self._session.liveliness().declare_subscriber(key, note, history=True)


class _ZenohQuery:
    def __init__(self, key: str, query: zenoh.Query) -> None:
        self._key = key
        self._query = query

    @property
    def data(self) -> bytes:
        payload: Any = self._query.payload
        return b"" if payload is None else bytes(payload.to_bytes())

    def reply(self, reply: EncodedReply) -> None:
        try:
            with self._query:
                if reply.is_problem:
                    self._query.reply_err(reply.data, encoding=_OURS)
                else:
                    self._query.reply(self._key, reply.data)
        except zenoh.ZError as error:
            log.debug("a reply on %s could not be sent: %s", self._key, error)

    def drop(self) -> None:
        self._query.drop()
