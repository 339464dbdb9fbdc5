"""Updates for the page. The run is queried at most once a second for all open pages."""

import threading
import time
from collections.abc import Callable

import msgspec

from udrl.errors import InvalidData, UdrlError
from udrl.version import __version__
from udrl_board.source import RunLocation, Source
from udrl_inspect.obedience_report import ObedienceReport
from udrl_inspect.obedience_text import summary
from udrl_proto.messages import Hello
from udrl_proto.reports import Contents, EvaluationStatus, IterationStatus, Status

#: Seconds between queries of the run.
FRESH_S = 1.0
#: Maximum number of pages of history in one query of the run; the next query reads on.
_PAGES = 20


class Obeyed(msgspec.Struct, frozen=True, kw_only=True):
    """The report of ``udrl obedience``.

    Attributes:
        low: lowest return of the range in which the agent obeys; None: there is no such range.
        high: highest return of that range, or None.
        answer: summary of the report.
        weights_version: weights version that was measured.
    """

    low: float | None
    high: float | None
    answer: str
    weights_version: int

    @classmethod
    def of(cls, report: ObedienceReport) -> "Obeyed":
        """Return the part of a report that the page shows."""
        found = report.obeyed
        return cls(
            low=None if found is None else found.low,
            high=None if found is None else found.high,
            answer=summary(report),
            weights_version=report.weights_version,
        )


class News(msgspec.Struct, frozen=True, kw_only=True):
    """An update for a page.

    Attributes:
        software: the board's version of udrl.
        place: location of the run.
        hello: the run specification; None if the page has it.
        status: status of the run; None if it is unknown.
        iterations: iterations completed since the page's last update.
        evaluations: evaluations in these iterations.
        contents: contents of the replay buffer; None if the page has them.
        obeyed: the report of ``udrl obedience``; None if there is none.
        problem: why something is missing or may be out of date; empty: nothing is.
    """

    software: str
    place: RunLocation
    hello: Hello | None
    status: Status | None
    iterations: list[IterationStatus]
    evaluations: list[EvaluationStatus]
    contents: Contents | None
    obeyed: Obeyed | None
    problem: str


class RunSummary(msgspec.Struct, frozen=True, kw_only=True):
    """A run in a list of several.

    Attributes:
        place: location of the run.
        status: status of the run; None if it is unknown.
        evaluations: evaluations so far.
    """

    place: RunLocation
    status: Status | None
    evaluations: list[EvaluationStatus]


class Feed:
    """Holds the state of a run, at most :data:`FRESH_S` old.

    Args:
        source: source of the run.
        clock: returns the time, seconds.
    """

    def __init__(self, source: Source, clock: Callable[[], float] = time.monotonic) -> None:
        self.source = source
        self._clock = clock
        self._lock = threading.Lock()
        self._queried_at = float("-inf")
        self._hello: Hello | None = None
        self._status: Status | None = None
        self._contents: Contents | None = None
        self._iterations: list[IterationStatus] = []
        self._evaluations: list[EvaluationStatus] = []
        self._obeyed: Obeyed | None = None
        self._place = source.place()
        self._problem = ""

    def news(self, after: int = -1, run_id: str = "") -> News:
        """Return the update for a page.

        Args:
            after: last iteration that the page has; -1: none.
            run_id: id of the run that the page shows.
        """
        with self._lock:
            self._refresh()
            known = self._iterations
            # The page may have been opened with an earlier board, and show another run.
            same = self._hello is not None and run_id == self._hello.run_id
            first = after + 1 if same and after < len(known) else 0
            contents = self._contents
            return News(
                software=__version__,
                place=self._place,
                hello=self._hello if first == 0 else None,
                status=self._status,
                iterations=known[first:],
                evaluations=[e for e in self._evaluations if e.iteration >= first],
                contents=contents
                if contents and (not first or contents.iteration > after)
                else None,
                obeyed=self._obeyed,
                problem=self._problem,
            )

    def summary(self) -> RunSummary:
        """Return the run's row in a list of several."""
        with self._lock:
            self._refresh()
            return RunSummary(
                place=self._place, status=self._status, evaluations=list(self._evaluations)
            )

    def _refresh(self) -> None:
        if self._clock() - self._queried_at >= FRESH_S:
            self._query()
            self._queried_at = self._clock()

    def _query(self) -> None:
        """Query the run; keep what it replied, or the reason why it did not."""
        self._problem = ""
        try:
            self._status = self.source.status()
            if self._hello is None or self._hello.run_id != self._status.run_id:
                self._hello, self._contents = self.source.hello(), None
                self._iterations, self._evaluations = [], []
            if self._iterations and self._status.iteration < self._iterations[-1].iteration:
                self._iterations, self._evaluations = [], []  # the run was restored from a backup
            for _ in range(_PAGES):
                page = self.source.history(len(self._iterations) - 1)
                self._iterations += page.iterations
                self._evaluations += page.evaluations
                if not page.more:
                    break
            known = self._contents
            if known is None or not known.returns or known.iteration < self._status.iteration:
                self._contents = self.source.contents()
            self._place, self._problem = self.source.place(), self.source.doubt()
            self._obeyed = None
            report = self.source.obedience()
            if report is not None and report.run_id == self._status.run_id:
                self._obeyed = Obeyed.of(report)
        except InvalidData as error:  # e.g. in the obedience report; the rest is shown
            self._problem = str(error)
        except UdrlError as error:
            self._status = None
            self._problem = str(error)
