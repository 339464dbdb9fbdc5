"""A router and a client on loopback."""

import socket
from collections.abc import Iterator

import pytest
import zenoh

from udrl_proto import session as sessions


@pytest.fixture
def endpoint() -> str:
    """An endpoint that no process listens on."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{free.getsockname()[1]}"


@pytest.fixture
def router(endpoint: str) -> Iterator[zenoh.Session]:
    with sessions.listen(endpoint) as session:
        yield session


@pytest.fixture
def client(router: zenoh.Session, endpoint: str) -> Iterator[zenoh.Session]:
    with sessions.connect(endpoint, patience_s=5.0) as session:
        yield session
