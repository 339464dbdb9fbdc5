"""Opening Zenoh sessions with the settings that all services share, and finding runs."""

import ipaddress
import json
import logging
import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import zenoh

from udrl.errors import ConfigError, Interrupted, Unreachable
from udrl_proto import PROTOCOL, key_expressions
from udrl_proto.access import access_control
from udrl_proto.codec import decode, encode
from udrl_proto.credentials import Credentials
from udrl_proto.messages import Hello, HelloRequest
from udrl_proto.text import printable

log = logging.getLogger("udrl")

_ENDPOINT = re.compile(
    r"(?P<protocol>tcp|tls)/(?P<host>\[[0-9a-fA-F:]+\]|[^:/\s\[\]]+):(?P<port>\d+)"
)

#: Seconds without a router after which a warning is logged; it may still be starting up.
QUIET_S = 15.0
#: First pause between two attempts to connect, seconds.
_FIRST_PAUSE_S = 0.05

#: Milliseconds after which a service that hangs or is cut off is noticed.
LEASE_MS = 2000

#: Maximum number of clients of a router; Zenoh's default is 1,000.
MAX_SESSIONS = 11_000


def check_endpoint(endpoint: str, *, secure: bool = False) -> str:
    """Return an endpoint unchanged if it is valid.

    Args:
        endpoint: ``tcp/HOST:PORT`` or ``tls/HOST:PORT``.
        secure: whether keys were given.

    Raises:
        ConfigError: the endpoint is malformed, or its protocol does not fit ``secure``.
    """
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or not 0 < int(match["port"]) < 65536 or not _can_be_resolved(match["host"]):
        raise ConfigError(
            f"endpoint {endpoint!r}: expected tcp/HOST:PORT, e.g. tcp/127.0.0.1:7447, or with "
            f"--keys tls/HOST:PORT"
        )
    if match["protocol"] == "tls" and not secure:
        raise ConfigError(
            f"endpoint {endpoint!r} needs keys; add --keys DIR (`udrl keys create DIR` creates "
            f"them), or use tcp/ if no authentication is needed"
        )
    if match["protocol"] == "tcp" and secure:
        raise ConfigError(
            f"endpoint {endpoint!r} would ignore --keys and not be encrypted; use "
            f"tls/{endpoint.removeprefix('tcp/')}"
        )
    return endpoint


def _can_be_resolved(host: str) -> bool:
    """Return whether the resolver accepts a name: the parts have 1 to 63 characters."""
    try:
        host.encode("idna")
    except UnicodeError:
        return False
    return True


def _host_and_port(endpoint: str) -> tuple[str, int]:
    match = _ENDPOINT.fullmatch(endpoint)
    assert match is not None
    return match["host"].strip("[]"), int(match["port"])


def _is_loopback(endpoint: str) -> bool:
    host, _ = _host_and_port(endpoint)
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _config(mode: str, credentials: Credentials | None) -> zenoh.Config:
    config = zenoh.Config()
    tls = {} if credentials is None else credentials.settings()
    for path, value in {
        "mode": mode,
        # Endpoints are always given: scouting costs 0.5 s and crosses site borders.
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        # By default a client that lost its router retries after 1, 3, 7, 11 s.
        "connect/retry": {
            "period_init_ms": 100,
            "period_max_ms": 500,
            "period_increase_factor": 1.5,
        },
        # Shared memory is reported to lose messages silently when a receiver is descheduled.
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": LEASE_MS,
        "transport/unicast/max_sessions": MAX_SESSIONS,
        **tls,
    }.items():
        config.insert_json5(path, json.dumps(value))
    return config


def check_listening(endpoint: str, *, insecure: bool = False, secure: bool = False) -> None:
    """Check that this machine can listen on an endpoint, before a run is created for it.

    Args:
        endpoint: where clients would connect.
        insecure: allow an endpoint beyond loopback without authentication.
        secure: whether keys were given.

    Raises:
        ConfigError: the endpoint is malformed, in use, not on this machine, or reachable without
            authentication.
    """
    _check_audience(endpoint, insecure=insecure, secure=secure)
    host, port = _host_and_port(endpoint)
    errors: list[OSError] = []
    try:
        for family, _, _, _, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
            with socket.socket(family) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                try:
                    probe.bind(address)
                except OSError as error:
                    errors.append(error)
                else:
                    return
    except OSError as error:  # the host has no address
        errors.append(error)
    raise _cannot_listen(endpoint, errors[0]) from errors[0]


def _check_audience(endpoint: str, *, insecure: bool, secure: bool) -> None:
    """Check an endpoint to listen on: only loopback may be without authentication."""
    check_endpoint(endpoint, secure=secure)
    if not secure and not insecure and not _is_loopback(endpoint):
        raise ConfigError(
            f"endpoint {endpoint!r} can be reached from other machines without authentication; "
            f"create keys (`udrl keys create DIR`) and give --keys DIR with tls/HOST:PORT, listen "
            f"on tcp/127.0.0.1:PORT, or add --insecure on a network you trust"
        )


def _cannot_listen(endpoint: str, error: Exception) -> ConfigError:
    return ConfigError(
        f"cannot listen on {endpoint!r}: {error}; free the port, or choose another endpoint"
    )


def listen(
    endpoint: str, *, insecure: bool = False, credentials: Credentials | None = None
) -> zenoh.Session:
    """Open a session that is the router of a run.

    Args:
        endpoint: where clients connect.
        insecure: allow an endpoint beyond loopback without authentication.
        credentials: accept only clients with a certificate of the same authority, and limit each to
            the permissions of its role (:mod:`udrl_proto.access`).

    Raises:
        ConfigError: the endpoint is malformed, in use, or reachable without authentication.
    """
    _check_audience(endpoint, insecure=insecure, secure=credentials is not None)
    config = _config("router", credentials)
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    if credentials is not None:
        config.insert_json5("access_control", json.dumps(access_control()))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise _cannot_listen(endpoint, error) from error


def connect(
    endpoint: str,
    patience_s: float,
    stop: threading.Event | None = None,
    credentials: Credentials | None = None,
) -> zenoh.Session:
    """Open a session with the router at an endpoint, retrying until it is reachable.

    Args:
        endpoint: where the router listens.
        patience_s: seconds to retry.
        stop: ends the wait.
        credentials: proof of a role, for a ``tls/`` endpoint.

    Raises:
        ConfigError: the endpoint is malformed, or one side does not trust the other's keys.
        Unreachable: there is no reply within ``patience_s`` seconds.
        Interrupted: ``stop`` was set.
    """
    check_endpoint(endpoint, secure=credentials is not None)
    config = _config("client", credentials)
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("connect/timeout_ms", "1000")
    began = time.monotonic()
    stop = stop or threading.Event()
    pause, warn_at = _FIRST_PAUSE_S, QUIET_S
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            if credentials is not None:
                credentials.examine(*_host_and_port(endpoint))
            waited = time.monotonic() - began
            if waited >= patience_s:
                raise Unreachable(
                    f"no reply from {endpoint!r} after {waited:.0f} s; start `udrl replay ENV "
                    f"--listen {endpoint}` or a Zenoh router there, or correct the endpoint"
                ) from error
        if waited >= warn_at:
            log.warning(
                "waiting for a replay service or router at %s, for %.0f s now", endpoint, waited
            )
            warn_at *= 2
        elif pause == _FIRST_PAUSE_S:
            log.info("waiting for a replay service or router at %s", endpoint)
        if stop.wait(pause):
            raise Interrupted(f"stopped while connecting to {endpoint}")
        pause = min(2 * pause, 1.0)


@contextmanager
def closed_at_the_end(session: zenoh.Session) -> Iterator[None]:
    """Close a session at the end; one that cannot be closed ends with the process.

    An error in closing must not hide an earlier one, such as too many open files.
    """
    try:
        yield
    finally:
        try:
            session.close()
        except zenoh.ZError as error:
            log.info("the session with the router could not be closed: %s", error)


def find_run(
    session: zenoh.Session,
    run_id: str | None,
    patience_s: float,
    stop: threading.Event | None = None,
) -> Hello:
    """Return the specification of the run that a router carries.

    Args:
        session: connected to the router.
        run_id: the run's name; None: the only run.
        patience_s: seconds to wait for it to appear.
        stop: ends the wait.

    Raises:
        Unreachable: no such run replies, or ``run_id`` is None and another run does not reply.
        ConfigError: there are several runs and ``run_id`` is None, or the run has another protocol.
        Interrupted: ``stop`` was set.
    """
    deadline = time.monotonic() + patience_s
    stop = stop or threading.Event()
    pause = 0.05
    while True:
        found, is_complete = _hellos(session)
        if run_id is not None:
            found, is_complete = {n: hello for n, hello in found.items() if n == run_id}, True
        if len(found) > 1:
            raise ConfigError(
                f"found several runs: {printable(', '.join(sorted(found)))}; choose one with "
                f"--run RUN_ID"
            )
        if found and is_complete:
            ((protocol, payload),) = found.values()
            if protocol != str(PROTOCOL):
                raise ConfigError(
                    f"the run speaks protocol {printable(protocol)}, this program speaks "
                    f"{PROTOCOL}; install the same version of udrl on both sides"
                )
            return decode(payload, Hello)
        if time.monotonic() >= deadline:
            if found:
                raise Unreachable(
                    f"besides {printable(', '.join(found))} there is a run that did not reply in "
                    f"{patience_s:.0f} s; choose one with --run RUN_ID"
                )
            named, otherwise = ("", "") if run_id is None else (f" {run_id!r}", ", or check --run")
            raise Unreachable(
                f"no run{named} replied in {patience_s:.0f} s; start `udrl replay ENV`{otherwise}"
            )
        if stop.wait(pause):
            raise Interrupted("stopped while looking for a run")
        pause = min(2 * pause, 1.0)


def _hellos(session: zenoh.Session) -> tuple[dict[str, tuple[str, bytes]], bool]:
    """Return protocol and payload of every run's reply, by run id, and whether all replied."""
    found, is_complete = {}, True
    for reply in session.get(
        key_expressions.every_hello(),
        payload=encode(HelloRequest()),
        timeout=1.0,
        consolidation=zenoh.ConsolidationMode.NONE,
    ):
        if reply.ok is None:  # a run is busy, and Zenoh does not say which
            is_complete = False
        else:
            protocol, run_id, _ = key_expressions.parse(str(reply.ok.key_expr))
            found[run_id] = protocol, reply.ok.payload.to_bytes()
    return found, is_complete
