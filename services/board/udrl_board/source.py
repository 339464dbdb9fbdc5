"""Sources of the board: a replay service, or the file of a run without one."""

import logging
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Literal, Protocol, TypeVar

import msgspec

from udrl.errors import ConfigError, PeerError, Refused, Unreachable
from udrl_inspect.address import REPLY_S, Address, connected, served_at
from udrl_inspect.agents import load_agent
from udrl_inspect.inspection import read_run, read_status
from udrl_inspect.obedience_report import ObedienceReport, load_report
from udrl_proto import verbs
from udrl_proto.messages import Hello, WeightsMessage, WeightsRequest
from udrl_proto.replay_client import ReplayClient
from udrl_proto.reports import (
    Contents,
    ContentsRequest,
    History,
    HistoryRequest,
    Status,
    StatusRequest,
)
from udrl_replay.reporting import contents, history
from udrl_replay.store import Store

log = logging.getLogger("udrl")

Found = TypeVar("Found")
#: A weights version, by number or by name.
Wanted = int | Literal["latest", "best"]

#: Seconds for which a service that did not reply gets no further request.
_SILENT_S = 10.0


class RunLocation(msgspec.Struct, frozen=True):
    """The location of a run, for the shell commands that the page shows; empty: unknown.

    Attributes:
        run_dir: its directory on the board's machine.
        endpoint: endpoint to which the run's services connect.
    """

    run_dir: str = ""
    endpoint: str = ""


class Source(Protocol):
    """Provides the data of a run. Every method may raise :class:`~udrl.errors.UdrlError`."""

    def place(self) -> RunLocation:
        """Return the location of the run."""
        ...

    def doubt(self) -> str:
        """Return why the data may be out of date; empty: they are not."""
        ...

    def hello(self) -> Hello:
        """Return the run specification."""
        ...

    def status(self) -> Status:
        """Return the status of the run."""
        ...

    def history(self, after: int) -> History:
        """Return a page of the iterations after ``after``."""
        ...

    def contents(self) -> Contents:
        """Return the contents of the replay buffer."""
        ...

    def weights(self, version: Wanted) -> WeightsMessage:
        """Return a weights version that is kept."""
        ...

    def obedience(self) -> ObedienceReport | None:
        """Return the report of ``udrl obedience`` on the run, or None."""
        ...

    def close(self) -> None:
        """Release all resources."""
        ...


class Stored:
    """A run that is read from its directory.

    Args:
        run_dir: its directory.
    """

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir

    def place(self) -> RunLocation:
        """Return its directory."""
        return RunLocation(str(self._run_dir))

    def doubt(self) -> str:
        """Return nothing: the file is always up to date."""
        return ""

    def hello(self) -> Hello:
        """Return the run's specification."""
        with closing(Store(self._run_dir, read_only=True)) as store:
            return store.fact("hello", Hello)

    def status(self) -> Status:
        """Return the last status of the run."""
        return read_status(self._run_dir)

    def history(self, after: int) -> History:
        """Return a page of the iterations after ``after``."""
        with closing(Store(self._run_dir, read_only=True)) as store:
            return history(store, after)

    def contents(self) -> Contents:
        """Return the contents of the replay buffer."""
        with closing(Store(self._run_dir, read_only=True)) as store:
            return contents(read_run(self._run_dir, store))

    def weights(self, version: Wanted) -> WeightsMessage:
        """Return a weights version that is kept."""
        agent = load_agent(self._run_dir, version)
        return WeightsMessage(version=agent.version, weights=agent.weights)

    def obedience(self) -> ObedienceReport | None:
        """Return the report in the run's directory, or None."""
        return load_report(self._run_dir)

    def close(self) -> None:
        """Do nothing: no resources are held."""


class Served:
    """A run that is queried from its replay service; reconnects after a failure.

    Args:
        address: address of the run.
    """

    def __init__(self, address: Address) -> None:
        self._address = address
        self._stack = ExitStack()
        self._connection: tuple[ReplayClient, Hello] | None = None
        self._lock = threading.Lock()

    def place(self) -> RunLocation:
        """Return its endpoint."""
        return RunLocation("", self._address.endpoint)

    def doubt(self) -> str:
        """Return nothing: without a reply, methods raise."""
        return ""

    def hello(self) -> Hello:
        """Return the run's specification."""
        with self._lock:
            return self._connected()[1]

    def status(self) -> Status:
        """Return the status of the run."""
        return self._query(lambda client: client.request(verbs.STATUS, StatusRequest()))

    def history(self, after: int) -> History:
        """Return a page of the iterations after ``after``."""
        request = HistoryRequest(after=after)
        return self._query(lambda client: client.request(verbs.HISTORY, request))

    def contents(self) -> Contents:
        """Return the contents of the replay buffer."""
        return self._query(lambda client: client.request(verbs.CONTENTS, ContentsRequest()))

    def weights(self, version: Wanted) -> WeightsMessage:
        """Return a weights version that is kept."""
        request = WeightsRequest(version=version)
        return self._query(lambda client: client.request(verbs.WEIGHTS, request))

    def obedience(self) -> ObedienceReport | None:
        """Return None: the report is in the run's directory, perhaps on another machine."""
        return None

    def close(self) -> None:
        """Disconnect from the run's router."""
        with self._lock:
            self._connection = None
            self._stack.close()

    def _query(self, query: Callable[[ReplayClient], Found]) -> Found:
        with self._lock:
            client, _ = self._connected()
            try:
                return query(client)
            except Unreachable:
                self._disconnect()
                raise

    def _connected(self) -> tuple[ReplayClient, Hello]:
        if self._connection is None:
            transport, hello = self._stack.enter_context(connected("observer", self._address))
            self._connection = (
                ReplayClient(transport, hello.run_id, "the board", patience_s=REPLY_S),
                hello,
            )
        return self._connection

    def _disconnect(self) -> None:
        """Disconnect from the router, without waiting for a service that hangs."""
        self._connection, stack = None, self._stack.pop_all()
        threading.Thread(target=stack.close, name="disconnecting", daemon=True).start()


class Directory:
    """A run by its directory: queried from its replay service if there is one, else read.

    Args:
        run_dir: its directory.
        keys_dir: folder with an observer's keys.
    """

    def __init__(self, run_dir: Path, keys_dir: Path | None = None) -> None:
        self._run_dir = run_dir
        self._keys_dir = keys_dir
        self._stored = Stored(run_dir)
        self._served: tuple[Address, Served] | None = None
        self._silent_since = float("-inf")
        self._silent_because = ""
        self._lock = threading.Lock()

    def place(self) -> RunLocation:
        """Return the directory, and the endpoint while the run is served."""
        return RunLocation(str(self._run_dir), served_at(self._run_dir) or "")

    def doubt(self) -> str:
        """Return a message if there is a replay service that does not reply."""
        if served_at(self._run_dir) is None or not self._is_silent():
            return ""
        why = self._silent_because
        return f"The replay service does not reply; the board shows the run's file: {why}"

    def hello(self) -> Hello:
        """Return the run's specification."""
        return self._stored.hello()

    def status(self) -> Status:
        """Return the status of the run, or its last one."""
        return self._query(lambda source: source.status())

    def history(self, after: int) -> History:
        """Return a page of the iterations after ``after``."""
        return self._query(lambda source: source.history(after))

    def contents(self) -> Contents:
        """Return the contents of the replay buffer."""
        return self._query(lambda source: source.contents())

    def weights(self, version: Wanted) -> WeightsMessage:
        """Return a weights version that is kept."""
        return self._query(lambda source: source.weights(version))

    def obedience(self) -> ObedienceReport | None:
        """Return the report in the run's directory, or None."""
        return self._stored.obedience()

    def close(self) -> None:
        """Disconnect from the run's router."""
        with self._lock:
            if self._served is not None:
                self._served[1].close()
                self._served = None

    def _query(self, query: Callable[[Source], Found]) -> Found:
        """Query the replay service, or the file if there is none that replies."""
        served = None if self._is_silent() else self._service()
        if served is not None:
            try:
                return query(served)
            except Refused as error:
                log.debug("reading %s, since the replay service refused: %s", self._run_dir, error)
            except (PeerError, ConfigError) as error:
                self._silent_since = time.monotonic()
                self._silent_because = str(error)
        return query(self._stored)

    def _is_silent(self) -> bool:
        return time.monotonic() - self._silent_since < _SILENT_S

    def _service(self) -> Served | None:
        """Return the run's replay service; None if the run is not served."""
        address = self._address()
        with self._lock:
            if self._served is not None and self._served[0] != address:
                self._served[1].close()
                self._served = None
            if address is None:
                return None
            if self._served is None:
                self._served = address, Served(address)
            return self._served[1]

    def _address(self) -> Address | None:
        """Return the address of the run in the directory, which may have replaced another one."""
        endpoint = served_at(self._run_dir)
        if endpoint is None:
            return None
        return Address(endpoint, self._stored.hello().run_id, REPLY_S, self._keys_dir)
