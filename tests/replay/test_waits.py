"""The waits of a run's services."""

from udrl_proto.reports import Waiting
from udrl_replay.waits import Waits


def test_wait_for_the_same_reason_continues() -> None:
    waits = Waits()
    waits.begin("actor a", "learner", "weights version 3", 10.0)
    waits.begin("actor a", "learner", "weights version 3", 12.0)
    assert waits.list(15.0) == (
        Waiting(who="actor a", on="learner", why="weights version 3", seconds=5.0),
    )


def test_wait_for_another_reason_starts_again() -> None:
    waits = Waits()
    waits.begin("actor a", "learner", "weights version 3", 10.0)
    waits.begin("actor a", "learner", "weights version 4", 12.0)
    assert [w.seconds for w in waits.list(15.0)] == [3.0]


def test_ended_wait_is_not_listed() -> None:
    waits = Waits()
    for who in ("b", "a"):
        waits.begin(who, "learner", "", 0.0)
    assert [w.who for w in waits.list(0.0)] == ["a", "b"]
    waits.end("a")
    waits.end("stranger")
    assert [w.who for w in waits.list(0.0)] == ["b"]


def test_waits_are_bounded() -> None:
    waits = Waits()
    for i in range(20_000):
        waits.begin(f"learner {i}", "actors", "iteration 1", 0.0)
    assert len(waits.list(1.0)) == 10_000
