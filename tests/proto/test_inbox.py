"""The inbox: bounds, and two lanes of which bulk has the lower priority."""

import threading

from udrl_proto.inbox import Inbox

NOW = 0.0


def test_bulk_has_lower_priority_and_lanes_are_fifo() -> None:
    inbox: Inbox[str] = Inbox(100, 1000)
    for name in ("episode 1", "status", "episode 2", "commands"):
        assert inbox.put(name, 10, bulk=name.startswith("episode"))
    assert inbox.take(3, 1000, NOW) == ["status", "commands", "episode 1"]
    assert inbox.take(3, 1000, NOW) == ["episode 2"]
    assert inbox.take(3, 1000, NOW) == []


def test_length_is_bounded() -> None:
    inbox: Inbox[int] = Inbox(2, 1000)
    assert [inbox.put(i, 1) for i in range(4)] == [True, True, False, False]
    assert inbox.take(1, 1000, NOW) == [0]
    assert inbox.put(4, 1)


def test_bulk_does_not_use_the_capacity_of_other_items() -> None:
    inbox: Inbox[str] = Inbox(2, 10)
    assert inbox.put("episode", 10, bulk=True)
    assert not inbox.put("episode", 1, bulk=True)
    assert inbox.has_room(10)
    assert inbox.put("weights", 10)
    assert inbox.take(5, 100, NOW) == ["weights", "episode"]


def test_size_is_bounded_but_a_single_item_always_fits() -> None:
    inbox: Inbox[str] = Inbox(100, 10)
    assert inbox.put("huge", 50)
    assert not inbox.has_room(1)
    assert not inbox.put("small", 1)
    assert inbox.take(1, 1, NOW) == ["huge"]
    assert inbox.put("small", 1)
    assert inbox.has_room(9)
    assert not inbox.has_room(10)


def test_must_put_ignores_the_bounds() -> None:
    inbox: Inbox[str] = Inbox(1, 10)
    assert inbox.put("question", 10)
    inbox.must_put("departure")
    assert inbox.take(5, 100, NOW) == ["question", "departure"]


def test_batch_is_bounded_in_bytes() -> None:
    inbox: Inbox[int] = Inbox(100, 1000)
    for i in range(5):
        inbox.put(i, 10, bulk=True)
    assert inbox.take(10, 25, NOW) == [0, 1, 2]
    assert inbox.take(10, 1, NOW) == [3]


def test_take_waits_for_the_first_item() -> None:
    inbox: Inbox[str] = Inbox(100, 1000)
    taken: list[str] = []
    thread = threading.Thread(target=lambda: taken.extend(inbox.take(5, 100, 10.0)))
    thread.start()
    inbox.put("late", 1)
    thread.join(10.0)
    assert taken == ["late"]
