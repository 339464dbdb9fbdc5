from hypothesis import given
from hypothesis import strategies as st

from udrl.schedule import evaluation_due, opened_by, weights_version

leads = st.integers(0, 64)


def test_without_lead_each_iteration_acts_with_the_weights_just_trained() -> None:
    assert [weights_version(i, lead=0) for i in range(5)] == [0, 1, 2, 3, 4]
    assert [list(opened_by(i, lead=0)) for i in range(4)] == [[1], [2], [3], [4]]


def test_with_lead_acting_runs_ahead_of_training() -> None:
    assert [weights_version(i, lead=3) for i in range(8)] == [0, 1, 1, 1, 1, 2, 3, 4]
    assert [list(opened_by(i, lead=3)) for i in range(4)] == [[1, 2, 3, 4], [5], [6], [7]]


@given(leads, st.integers(0, 200))
def test_commands_use_the_buffer_that_their_weights_were_trained_on(
    lead: int, completed: int
) -> None:
    for iteration in range(1, 300):
        opened = iteration in opened_by(completed, lead)
        assert opened == (weights_version(iteration, lead) - 1 == completed)


@given(leads, st.integers(1, 100))
def test_every_iteration_is_opened_once_and_in_order(lead: int, n: int) -> None:
    opened = [i for completed in range(n) for i in opened_by(completed, lead)]
    assert opened == list(range(1, n + lead + 1))


@given(st.integers(0, 500), st.integers(1, 500), st.integers(1, 100))
def test_evaluation_is_due_when_a_multiple_is_passed(before: int, steps: int, every: int) -> None:
    after = before + steps
    passed = [m for m in range(every, after + 1, every) if m > before]
    assert evaluation_due(before, after, every) == bool(passed)


def test_multiple_counts_once_when_it_is_reached() -> None:
    assert not evaluation_due(80, 99, every=100)
    assert evaluation_due(99, 100, every=100)
    assert not evaluation_due(100, 199, every=100)
    assert evaluation_due(199, 450, every=100)
