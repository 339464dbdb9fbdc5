"""Where a run is, how to get there, and what its services are called there.

It imports no torch, for commands that look in for a moment.
"""

import os
import platform
import re
import threading
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import zenoh

from udrl_proto import session as sessions
from udrl_proto.credentials import load
from udrl_proto.messages import Hello


class Address(NamedTuple):
    """Where a run is.

    Attributes:
        endpoint: of its router.
        run_id: which one, where the router carries several.
        patience_s: seconds to try until somebody answers.
        keys: folder with the keys that a service proves its role with; None: nobody is asked.
    """

    endpoint: str
    run_id: str | None = None
    patience_s: float = 3.0
    keys: Path | None = None


@contextmanager
def connected(
    role: str, address: Address, stop: threading.Event | None = None
) -> Iterator[tuple[zenoh.Session, Hello]]:
    """Connect to a run in a role, and find it.

    Raises:
        ConfigError: the endpoint or the keys cannot be used, or the run must be named.
        Unreachable: nobody, or no such run, answers in time.
        Interrupted: ``stop`` was set meanwhile.
    """
    endpoint, run_id, patience_s, keys = address
    credentials = load(keys, role) if keys else None
    with sessions.connect(endpoint, patience_s, stop, credentials) as session:
        yield session, sessions.find_run(session, run_id, patience_s, stop)


def unique_name(role: str) -> str:
    """Return a name for a service that no other has; it begins with :func:`host_name`."""
    return f"{host_name(role)}-{os.getpid()}-{uuid.uuid4().hex[:6]}"


def host_name(role: str) -> str:
    """Return what the names of all services of a role on this machine begin with."""
    host = re.sub(r"[^A-Za-z0-9]+", "-", platform.node())[:30] or "host"
    return f"{role}-{host}"
