"""Addresses of runs, connections to them, and the names of their services.

Imports no torch, so that short commands start fast.
"""

import hashlib
import ipaddress
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
from udrl_proto.credentials import load_credentials
from udrl_proto.messages import Hello
from udrl_proto.transport import Transport
from udrl_proto.zenoh_transport import ZenohTransport
from udrl_replay.database import is_locked
from udrl_replay.remedies import unwritable

log = logging.getLogger("udrl")

#: Seconds to wait for a reply of a replay service.
REPLY_S = 3.0

#: File in a run directory with the endpoint, while the run is served.
ENDPOINT_FILE = "endpoint.json"

#: Maximum number of characters of a machine's name in the names of its services, which are used in
#: keys.
_MAX_HOST = 30


class Address(NamedTuple):
    """Address of a run.

    Attributes:
        endpoint: endpoint of the replay service or router.
        run_id: id of the run, if a router carries several.
        patience_s: seconds to wait for the first reply.
        keys: folder with keys. None: no authentication.
    """

    endpoint: str
    run_id: str | None = None
    patience_s: float = REPLY_S
    keys: Path | None = None


@contextmanager
def connected(
    role: str, address: Address, stop: threading.Event | None = None
) -> Iterator[tuple[Transport, Hello]]:
    """Connect to a run in a role.

    Raises:
        ConfigError: the endpoint or the keys cannot be used, or a run id is needed.
        Unreachable: no service, or no such run, replied in time.
        Interrupted: ``stop`` was set.
    """
    endpoint, run_id, patience_s, keys = address
    credentials = load_credentials(keys, role) if keys else None
    session = sessions.connect(endpoint, patience_s, stop, credentials)
    with sessions.closed_at_the_end(session):
        yield ZenohTransport(session), sessions.find_run(session, run_id, patience_s, stop)


@contextmanager
def announced(run_dir: Path, endpoint: str) -> Iterator[None]:
    """Write the endpoint of the run that this process serves to the run directory.

    Raises:
        StoreError: the file cannot be written.
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
    """Return the endpoint at which this machine reaches a run; None if no service serves it.

    A service is recognised by the lock of the run directory, not by its process id, which means
    nothing on other machines and in containers.
    """
    try:
        where = json.loads((run_dir / ENDPOINT_FILE).read_text(encoding="utf-8"))
        endpoint = str(where["endpoint"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        log.debug("%s is not served: %s", run_dir, error)
        return None
    return from_this_machine(endpoint) if is_locked(run_dir) else None


def from_this_machine(endpoint: str) -> str:
    """Return an endpoint with the loopback address in place of a wildcard.

    A service that listens on all interfaces listens on loopback too. No certificate is valid for
    a wildcard, and all are valid for loopback.
    """
    protocol, _, place = endpoint.partition("/")
    host, _, port = place.rpartition(":")
    try:
        address = ipaddress.ip_address(host.strip("[]"))
    except ValueError:  # a name
        return endpoint
    if not address.is_unspecified:
        return endpoint
    return f"{protocol}/{'127.0.0.1' if address.version == 4 else '[::1]'}:{port}"


def unique_name(role: str) -> str:
    """Return a unique name for a service; it begins with :func:`host_name`."""
    return f"{host_name(role)}-{os.getpid()}-{uuid.uuid4().hex[:6]}"


def host_name(role: str) -> str:
    """Return the prefix of the names of a role's services on this machine."""
    host = re.sub(r"[^A-Za-z0-9]+", "-", platform.node()) or "host"
    if len(host) > _MAX_HOST:
        # Names of pods and of nodes differ at their ends.
        digest = hashlib.sha256(host.encode()).hexdigest()[:8]
        host = f"{host[: _MAX_HOST - 9]}-{digest}"
    return f"{role}-{host}"


def is_of_this_machine(name: str, role: str) -> bool:
    """Return whether a name is that of a service of this role on this machine."""
    return re.fullmatch(rf"{re.escape(host_name(role))}-\d+-[0-9a-f]{{6}}", name) is not None
