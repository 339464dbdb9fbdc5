"""Where the board knows things from: a replay service, or the file of a run that nobody serves."""

import logging
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Literal, Protocol, TypeVar

import msgspec

from udrl.errors import ConfigError, PeerError, Refused, Unreachable
from udrl_inspect.address import Address, connected, served_at
from udrl_inspect.agents import load_agent
from udrl_inspect.inspection import read_run, read_status
from udrl_inspect.obedience import Obedience, kept
from udrl_proto import verbs
from udrl_proto.asking import Asker
from udrl_proto.messages import Hello, Weights, WeightsRequest
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

Answer = TypeVar("Answer")
Wanted = int | Literal["latest", "best"]

#: Seconds that an answer may take; who looks at a page does not wait for longer.
_ANSWER_S = 3.0
#: Seconds for which a service that did not answer is not asked again.
_SILENT_S = 10.0


class Place(msgspec.Struct, frozen=True):
    """Where a run is, for the commands that the page names; empty: unknown.

    Attributes:
        run_dir: its directory on the board's machine.
        endpoint: that services of the run connect to.
    """

    run_dir: str = ""
    endpoint: str = ""


class Source(Protocol):
    """What can be asked about a run. Every method may raise :class:`~udrl.errors.UdrlError`."""

    def place(self) -> Place:
        """Return where the run is."""
        ...

    def doubt(self) -> str:
        """Return why answers may be of an earlier moment; empty: they are of now."""
        ...

    def hello(self) -> Hello:
        """Return the run's specification."""
        ...

    def status(self) -> Status:
        """Return how the run is doing."""
        ...

    def history(self, after: int) -> History:
        """Return what came of the iterations after one, or the first of them."""
        ...

    def contents(self) -> Contents:
        """Return what the replay buffer holds."""
        ...

    def weights(self, version: Wanted) -> Weights:
        """Return a weights version that is kept."""
        ...

    def obedience(self) -> Obedience | None:
        """Return the report of ``udrl obedience`` on the run; None: there is none here."""
        ...

    def close(self) -> None:
        """Let go of what is held."""
        ...


class Stored:
    """A run by its directory alone; what is read is of the moment.

    Args:
        run_dir: its directory.
    """

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir

    def place(self) -> Place:
        """Return its directory."""
        return Place(str(self._run_dir))

    def doubt(self) -> str:
        """Return nothing: there is no other moment."""
        return ""

    def hello(self) -> Hello:
        """Return the run's specification."""
        with closing(Store(self._run_dir, read_only=True)) as store:
            return store.fact("hello", Hello)

    def status(self) -> Status:
        """Return how the run was doing when it was last worked on."""
        return read_status(self._run_dir)

    def history(self, after: int) -> History:
        """Return what came of the iterations after one, or the first of them."""
        with closing(Store(self._run_dir, read_only=True)) as store:
            return history(store, after)

    def contents(self) -> Contents:
        """Return what the replay buffer holds."""
        with closing(Store(self._run_dir, read_only=True)) as store:
            return contents(read_run(self._run_dir, store))

    def weights(self, version: Wanted) -> Weights:
        """Return a weights version that is kept."""
        agent = load_agent(self._run_dir, version)
        return Weights(version=agent.version, weights=agent.weights)

    def obedience(self) -> Obedience | None:
        """Return the report that its directory holds."""
        return kept(self._run_dir)

    def close(self) -> None:
        """Nothing is held."""


class Served:
    """A run by the replay service that answers for it; connects again after it did not.

    Args:
        address: where it is.
    """

    def __init__(self, address: Address) -> None:
        self._address = address
        self._stack = ExitStack()
        self._line: tuple[Asker, Hello] | None = None
        self._lock = threading.Lock()

    def place(self) -> Place:
        """Return its endpoint."""
        return Place("", self._address.endpoint)

    def doubt(self) -> str:
        """Return nothing: who does not answer raises."""
        return ""

    def hello(self) -> Hello:
        """Return the run's specification."""
        with self._lock:
            return self._connected()[1]

    def status(self) -> Status:
        """Return how the run is doing."""
        return self._ask(lambda asker: asker.ask(verbs.STATUS, StatusRequest()))

    def history(self, after: int) -> History:
        """Return what came of the iterations after one, or the first of them."""
        request = HistoryRequest(after=after)
        return self._ask(lambda asker: asker.ask(verbs.HISTORY, request))

    def contents(self) -> Contents:
        """Return what the replay buffer holds."""
        return self._ask(lambda asker: asker.ask(verbs.CONTENTS, ContentsRequest()))

    def weights(self, version: Wanted) -> Weights:
        """Return a weights version that is kept."""
        request = WeightsRequest(version=version)
        return self._ask(lambda asker: asker.ask(verbs.WEIGHTS, request))

    def obedience(self) -> Obedience | None:
        """Return nothing: it is in the run's directory, which may be on another machine."""
        return None

    def close(self) -> None:
        """Leave the run's router."""
        with self._lock:
            self._line = None
            self._stack.close()

    def _ask(self, question: Callable[[Asker], Answer]) -> Answer:
        with self._lock:
            asker, _ = self._connected()
            try:
                return question(asker)
            except Unreachable:
                self._disconnect()
                raise

    def _connected(self) -> tuple[Asker, Hello]:
        if self._line is None:
            transport, hello = self._stack.enter_context(connected("observer", self._address))
            self._line = Asker(transport, hello.run_id, "the board", patience_s=_ANSWER_S), hello
        return self._line

    def _disconnect(self) -> None:
        """Leave the router; whoever asks does not wait until a service that hangs has noticed."""
        self._line, stack = None, self._stack.pop_all()
        threading.Thread(target=stack.close, name="leaving", daemon=True).start()


class Directory:
    """A run by its directory: asked where it is served, read where it is not.

    Args:
        run_dir: its directory.
        keys_dir: folder with the keys that an observer proves its role with.
    """

    def __init__(self, run_dir: Path, keys_dir: Path | None = None) -> None:
        self._run_dir = run_dir
        self._keys_dir = keys_dir
        self._stored = Stored(run_dir)
        self._served: tuple[str, Served] | None = None
        self._silent_since = float("-inf")
        self._why = ""
        self._lock = threading.Lock()

    def place(self) -> Place:
        """Return its directory, and its endpoint while it is served."""
        return Place(str(self._run_dir), served_at(self._run_dir) or "")

    def doubt(self) -> str:
        """Return that the replay service does not answer, if it is there and does not."""
        if served_at(self._run_dir) is None or not self._is_silent():
            return ""
        return f"What is shown is what the run's file says, not what its service does: {self._why}"

    def hello(self) -> Hello:
        """Return the run's specification."""
        return self._stored.hello()

    def status(self) -> Status:
        """Return how the run is doing, or was when it was last worked on."""
        return self._ask(lambda source: source.status())

    def history(self, after: int) -> History:
        """Return what came of the iterations after one, or the first of them."""
        return self._ask(lambda source: source.history(after))

    def contents(self) -> Contents:
        """Return what the replay buffer holds."""
        return self._ask(lambda source: source.contents())

    def weights(self, version: Wanted) -> Weights:
        """Return a weights version that is kept."""
        return self._ask(lambda source: source.weights(version))

    def obedience(self) -> Obedience | None:
        """Return the report that its directory holds."""
        return self._stored.obedience()

    def close(self) -> None:
        """Leave the run's router."""
        with self._lock:
            if self._served is not None:
                self._served[1].close()
                self._served = None

    def _ask(self, question: Callable[[Source], Answer]) -> Answer:
        served = None if self._is_silent() else self._service()
        if served is not None:
            try:
                return question(served)
            except Refused as error:
                log.debug("%s is read, since it refuses: %s", self._run_dir, error)
            except (PeerError, ConfigError) as error:
                self._silent_since, self._why = time.monotonic(), str(error)
        return question(self._stored)

    def _is_silent(self) -> bool:
        return time.monotonic() - self._silent_since < _SILENT_S

    def _service(self) -> Served | None:
        endpoint = served_at(self._run_dir)
        with self._lock:
            if self._served is not None and self._served[0] != endpoint:
                self._served[1].close()
                self._served = None
            if endpoint is None:
                return None
            if self._served is None:
                run_id = self._stored.hello().run_id
                address = Address(endpoint, run_id, _ANSWER_S, self._keys_dir)
                self._served = endpoint, Served(address)
            return self._served[1]
