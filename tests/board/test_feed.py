"""The updates of the page, and the rate of queries to the run."""

from collections import Counter
from typing import Any

import msgspec
import pytest

from udrl.actions import Categorical
from udrl.config import Config, flat
from udrl.environments import EnvironmentSpec
from udrl.errors import InvalidData, Unreachable
from udrl.spaces import Vector
from udrl_board.feed import FRESH_S, Feed
from udrl_board.source import RunLocation
from udrl_inspect.obedience_report import Agreement, ObediencePoint, ObedienceReport
from udrl_proto.messages import Hello, WeightsMessage
from udrl_proto.reports import Contents, EvaluationStatus, History, IterationStatus, Status

HELLO = Hello(
    protocol=1, software="1", run_id="run", settings=flat(Config(environment="CartPole-v1")),
    environment=EnvironmentSpec(
        observation_space=Vector(size=4), action_space=Categorical(n=2), max_episode_steps=500
    ),
    graph=b"", allow_inexact=False, exact=True,
)  # fmt: skip


def iteration(number: int) -> IterationStatus:
    return IterationStatus(
        iteration=number, env_steps=100 * number, wall_s=1.0, return_min=0.0, return_mean=1.0,
        return_max=2.0, explored_return=1.0, commanded_min=None, commanded_max=None, admitted=1,
        weights_version=number, loss=None, commands=3, eval_env_steps=0,
    )  # fmt: skip


def evaluation(number: int) -> EvaluationStatus:
    return EvaluationStatus(
        iteration=number, env_steps=100 * number, mean=1.0, std=0.0, ci95_low=1.0, ci95_high=1.0,
        episodes=1,
    )  # fmt: skip


class CountingSource:
    """A run with some iterations, which counts its queries."""

    def __init__(self, iterations: int) -> None:
        self.iterations = iterations
        self.page = 1000
        self.queries: Counter[str] = Counter()
        self.is_gone = False
        self.is_doubtful = False
        self.report: ObedienceReport | InvalidData | None = None

    def _query(self, what: str) -> None:
        self.queries[what] += 1
        if self.is_gone:
            raise Unreachable("no reply")

    def place(self) -> RunLocation:
        return RunLocation("runs/mine", "tcp/127.0.0.1:7447")

    def doubt(self) -> str:
        return "out of date" if self.is_doubtful else ""

    def hello(self) -> Hello:
        self._query("hello")
        return HELLO

    def status(self) -> Status:
        self._query("status")
        # The feed reads only these fields; tests of the whole system have complete ones.
        fields: dict[str, Any] = dict.fromkeys(Status.__struct_fields__)
        return Status(**fields | {"iteration": self.iterations - 1, "run_id": "run"})

    def history(self, after: int) -> History:
        self._query("history")
        numbers = list(range(after + 1, self.iterations))
        page = numbers[: self.page]
        return History(
            iterations=tuple(map(iteration, page)),
            evaluations=tuple(evaluation(n) for n in page if n % 2),
            more=len(numbers) > len(page),
        )

    def contents(self) -> Contents:
        self._query("contents")
        return Contents(
            iteration=self.iterations - 1, returns=(1.0,), lengths=(1,), iterations=(0,),
            desired_return=1.0, desired_horizon=1, return_std=0.0, desired_returns=(),
            desired_horizons=(), versions=(),
        )  # fmt: skip

    def weights(self, version: object) -> WeightsMessage:
        raise AssertionError("the feed must not request weights")

    def obedience(self) -> ObedienceReport | None:
        if isinstance(self.report, InvalidData):
            raise self.report
        return self.report

    def close(self) -> None:
        pass


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def run() -> CountingSource:
    return CountingSource(5)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def feed(run: CountingSource, clock: Clock) -> Feed:
    return Feed(run, clock)


def test_new_page_gets_everything(feed: Feed) -> None:
    news = feed.news()
    assert news.hello == HELLO
    assert [i.iteration for i in news.iterations] == [0, 1, 2, 3, 4]
    assert [e.iteration for e in news.evaluations] == [1, 3]
    assert news.contents is not None
    assert news.problem == ""
    assert msgspec.json.decode(msgspec.json.encode(news))["iterations"]


def test_page_gets_changes_only(feed: Feed, run: CountingSource, clock: Clock) -> None:
    feed.news()
    run.iterations = 8
    clock.now += FRESH_S
    news = feed.news(4, "run")
    assert [i.iteration for i in news.iterations] == [5, 6, 7]
    assert [e.iteration for e in news.evaluations] == [5, 7]
    assert news.hello is None
    assert news.contents is not None
    again = feed.news(7, "run")
    assert (again.iterations, again.evaluations, again.contents) == ([], [], None)


def test_run_is_queried_once_a_second_for_any_number_of_pages(
    feed: Feed, run: CountingSource, clock: Clock
) -> None:
    for _ in range(10):
        feed.news()
    assert run.queries == {"hello": 1, "status": 1, "history": 1, "contents": 1}
    clock.now += FRESH_S
    for _ in range(10):
        feed.news(4, "run")
    # The buffer has not changed.
    assert run.queries == {"hello": 1, "status": 2, "history": 2, "contents": 1}


def test_long_history_is_fetched_page_by_page(feed: Feed, run: CountingSource) -> None:
    run.iterations, run.page = 100, 7
    assert [i.iteration for i in feed.news().iterations] == list(range(100))


def test_page_keeps_its_state_without_a_reply(
    feed: Feed, run: CountingSource, clock: Clock
) -> None:
    feed.news()
    run.is_gone = True
    clock.now += FRESH_S
    news = feed.news(4, "run")
    assert (news.status, news.iterations, news.problem) == (None, [], "no reply")
    assert len(feed.news().iterations) == 5
    run.is_gone, run.iterations = False, 6
    clock.now += FRESH_S
    news = feed.news(4, "run")
    assert (news.problem, [i.iteration for i in news.iterations]) == ("", [5])


def test_page_gets_the_place_and_doubts(feed: Feed, run: CountingSource, clock: Clock) -> None:
    assert feed.news().place == RunLocation("runs/mine", "tcp/127.0.0.1:7447")
    run.is_doubtful = True
    clock.now += FRESH_S
    news = feed.news(4, "run")
    assert news.status is not None
    assert news.problem == "out of date"


@pytest.mark.parametrize(("after", "run_id"), [(77, "run"), (2, "another"), (2, "")])
def test_page_of_another_run_gets_everything(feed: Feed, after: int, run_id: str) -> None:
    news = feed.news(after, run_id)
    assert news.hello == HELLO
    assert len(news.iterations) == 5
    assert news.contents is not None


def test_run_restored_from_a_backup_is_sent_again(
    feed: Feed, run: CountingSource, clock: Clock
) -> None:
    feed.news()
    run.iterations = 3
    clock.now += FRESH_S
    news = feed.news(4, "run")
    assert news.hello == HELLO
    assert [i.iteration for i in news.iterations] == [0, 1, 2]


def report(run_id: str = "run", *, obeys: bool) -> ObedienceReport:
    every = Agreement(low=0.0, high=4.0, mean_absolute_error=0.1, correlation=0.5)
    numbers: dict[str, float] = dict.fromkeys(ObediencePoint.__struct_fields__, 1)
    points = [ObediencePoint(**numbers | {"desired_return": r}) for r in (0.0, 4.0)]  # type: ignore[arg-type]
    return ObedienceReport(
        run_id=run_id, environment="CartPole-v1", weights_version=3, temperature=1.0, episodes=1,
        reachable_low=0.0, reachable_high=4.0, tolerance=0.4, by_return=points, by_horizon=[],
        all_returns=every, obeyed=every if obeys else None, all_horizons=None,
    )  # fmt: skip


@pytest.mark.parametrize("obeys", [True, False])
def test_page_gets_the_report_on_obedience(run: CountingSource, clock: Clock, obeys: bool) -> None:
    feed = Feed(run, clock)
    assert feed.news().obeyed is None
    run.report = report(obeys=obeys)
    clock.now += FRESH_S
    found = feed.news(after=4, run_id="run").obeyed
    assert found is not None
    assert (found.low, found.high) == ((0.0, 4.0) if obeys else (None, None))
    assert found.weights_version == 3
    assert found.answer.startswith("You can command returns from 0 to 4" if obeys else "This agent")
    run.report = report("of another run", obeys=obeys)
    clock.now += FRESH_S
    assert feed.news().obeyed is None


def test_damaged_report_does_not_hide_other_data(run: CountingSource, clock: Clock) -> None:
    run.report = InvalidData("obedience.json: damaged; delete it")
    news = Feed(run, clock).news()
    assert news.problem == "obedience.json: damaged; delete it"
    assert news.status is not None
    assert news.contents is not None
    assert news.obeyed is None
