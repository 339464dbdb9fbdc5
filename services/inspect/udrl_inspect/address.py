"""Where a run is, how to get there, and what its services are called there.

It imports no torch, for commands that look in for a moment.
"""

import hashlib
import json
import logging
import os
import platform
import re
import threading
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from udrl_proto import session as sessions
from udrl_proto.credentials import load
from udrl_proto.messages import Hello
from udrl_proto.transport import Transport
from udrl_proto.zenoh_transport import ZenohTransport
from udrl_replay.database import is_locked
from udrl_replay.remedies import unwritable

log = logging.getLogger("udrl")

#: The file in a run's directory that says where it is served, while it is.
ENDPOINT_FILE = "endpoint.json"

#: Characters of a machine's name in the names of its services, which are keys.
_LONGEST_HOST = 30


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
) -> Iterator[tuple[Transport, Hello]]:
    """Connect to a run in a role, and find it.

    Raises:
        ConfigError: the endpoint or the keys cannot be used, or the run must be named.
        Unreachable: nobody, or no such run, answers in time.
        Interrupted: ``stop`` was set meanwhile.
    """
    endpoint, run_id, patience_s, keys = address
    credentials = load(keys, role) if keys else None
    session = sessions.connect(endpoint, patience_s, stop, credentials)
    with sessions.closed_at_the_end(session):
        yield ZenohTransport(session), sessions.find_run(session, run_id, patience_s, stop)


@contextmanager
def announced(run_dir: Path, endpoint: str) -> Iterator[None]:
    """Say in a run's directory that this process serves it at an endpoint.

    Raises:
        StoreError: it cannot be written there.
    """
    file = run_dir / ENDPOINT_FILE
    where = {"endpoint": endpoint, "host": platform.node(), "pid": os.getpid()}
    try:
        file.write_text(json.dumps(where), encoding="utf-8")
    except OSError as error:
        raise unwritable(file, error) from error
    try:
        yield
    finally:
        file.unlink(missing_ok=True)


def served_at(run_dir: Path) -> str | None:
    """Return the endpoint at which a run is served; None: nobody works on it.

    Whoever serves a run holds its lock. A process id would say nothing of other machines and
    containers, nor of other users' processes.
    """
    try:
        where = json.loads((run_dir / ENDPOINT_FILE).read_text(encoding="utf-8"))
        endpoint = str(where["endpoint"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        log.debug("%s is not served: %s", run_dir, error)
        return None
    return endpoint if is_locked(run_dir) else None


def unique_name(role: str) -> str:
    """Return a name for a service that no other has; it begins with :func:`host_name`."""
    return f"{host_name(role)}-{os.getpid()}-{uuid.uuid4().hex[:6]}"


def host_name(role: str) -> str:
    """Return what the names of all services of a role on this machine begin with."""
    host = re.sub(r"[^A-Za-z0-9]+", "-", platform.node()) or "host"
    if len(host) > _LONGEST_HOST:
        # Names of pods and of nodes differ at their ends.
        digest = hashlib.sha256(host.encode()).hexdigest()[:8]
        host = f"{host[: _LONGEST_HOST - 9]}-{digest}"
    return f"{role}-{host}"


def is_of_this_machine(name: str, role: str) -> bool:
    """Say whether a name is :func:`unique_name`'s, of a service of this role on this machine."""
    return re.fullmatch(rf"{re.escape(host_name(role))}-\d+-[0-9a-f]{{6}}", name) is not None
