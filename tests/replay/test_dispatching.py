"""Distribution of commands to actors, and reassignment after failures."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.replay.synthetic import join
from udrl.commands import Command
from udrl.config import COMMANDS_PER_ITERATION
from udrl_proto.codec import SMALL, encode
from udrl_proto.messages import CommandsReply, CommandsRequest
from udrl_replay.dispatching import MAX_ASSIGNED, SILENCE_S, STRAGGLER, Dispatcher


def command(index: int, iteration: int = 1, version: int = 1) -> Command:
    return Command(
        id=iteration * COMMANDS_PER_ITERATION + index,
        kind="explore",
        desired_return=0.0,
        desired_horizon=1,
        environment_seed=1,
        stream_key=bytes(16),
        weights_version=version,
        max_steps=4,
    )


def ids(*indices: int) -> list[int]:
    return [command(index).id for index in indices]


@pytest.fixture
def dispatcher() -> Dispatcher:
    """Six commands, two actors."""
    dispatcher = Dispatcher()
    dispatcher.add(command(index) for index in range(6))
    for name in ("a", "b"):
        dispatcher.join(join(name), 0.0)
    return dispatcher


def ask(
    dispatcher: Dispatcher,
    name: str,
    wanted: int = 100,
    running: list[int] | None = None,
    now: float = 0.0,
    version: int = 1,
    spare_cores: float = 0.0,
) -> list[int]:
    """Return the ids of the commands that an actor is given."""
    request = CommandsRequest(
        actor=name, wanted=wanted, running=tuple(running or ()), spare_cores=spare_cores
    )
    return [c.id for c in dispatcher.assign(request, version, now)]


def test_first_actor_gets_its_share_only(dispatcher: Dispatcher) -> None:
    assert ask(dispatcher, "a") == ids(0, 1, 2)
    assert ask(dispatcher, "b") == ids(3, 4, 5)


@given(n_commands=st.integers(1, 40), n_actors=st.integers(1, 9))
def test_shares_are_even_and_cover_all_commands(n_commands: int, n_actors: int) -> None:
    dispatcher = Dispatcher()
    dispatcher.add(command(index) for index in range(n_commands))
    names = [f"actor-{n}" for n in range(n_actors)]
    for name in names:
        dispatcher.join(join(name), 0.0)
    assigned = [ask(dispatcher, name) for name in names]
    assert sorted(i for share in assigned for i in share) == ids(*range(n_commands))
    assert max(map(len, assigned)) <= -(-n_commands // n_actors)


def test_actor_gets_at_most_what_it_wants(dispatcher: Dispatcher) -> None:
    assert ask(dispatcher, "a", wanted=2) == ids(0, 1)
    assert ask(dispatcher, "a", wanted=0, running=ids(0, 1)) == []


def test_running_commands_count_towards_the_share(dispatcher: Dispatcher) -> None:
    running = ask(dispatcher, "a", wanted=2)
    assert ask(dispatcher, "a", running=running) == ids(2)


def test_earlier_iterations_come_first(dispatcher: Dispatcher) -> None:
    dispatcher.add([command(0, iteration=0, version=0)])
    assert ask(dispatcher, "b", wanted=1) == [0]


def test_command_waits_for_its_weights(dispatcher: Dispatcher) -> None:
    assert ask(dispatcher, "a", version=0) == []
    assert ask(dispatcher, "a", version=1) == ids(0, 1, 2)


def test_commands_with_missing_weights_do_not_block_others(dispatcher: Dispatcher) -> None:
    dispatcher.add([command(0, iteration=2, version=2)])
    assert ask(dispatcher, "a") + ask(dispatcher, "b") == ids(0, 1, 2, 3, 4, 5)
    assert ask(dispatcher, "a", running=ids(0, 1, 2)) == []


def test_largest_reply_is_a_small_message() -> None:
    dispatcher = Dispatcher()
    dispatcher.add(command(index) for index in range(2 * MAX_ASSIGNED))
    dispatcher.join(join("a"), 0.0)
    request = CommandsRequest(actor="a", wanted=65_536)
    commands = dispatcher.assign(request, 1, 0.0)
    assert len(commands) == MAX_ASSIGNED
    assert len(encode(CommandsReply(commands=tuple(commands)))) < SMALL


# Actors that leave, and lost replies.


def test_commands_of_a_removed_actor_go_to_others(dispatcher: Dispatcher) -> None:
    ask(dispatcher, "a")
    dispatcher.remove_actor("a")
    assert ask(dispatcher, "b") == ids(0, 1, 2, 3, 4, 5)


def test_actor_that_joins_again_holds_nothing(dispatcher: Dispatcher) -> None:
    ask(dispatcher, "a")
    dispatcher.join(join("a"), 0.0)
    assert ask(dispatcher, "a") == ids(0, 1, 2)


def test_commands_of_a_lost_reply_are_assigned_again(dispatcher: Dispatcher) -> None:
    assert ask(dispatcher, "a") == ids(0, 1, 2)
    assert ask(dispatcher, "a", running=[]) == ids(0, 1, 2)


def test_restarted_service_adopts_running_commands(dispatcher: Dispatcher) -> None:
    assert ask(dispatcher, "a", wanted=0, running=ids(4, 5)) == []
    assert ask(dispatcher, "b") == ids(0, 1, 2)
    assert dispatcher.holds("a", ids(4)[0])


def test_running_command_that_is_not_outstanding_is_ignored(dispatcher: Dispatcher) -> None:
    assert ask(dispatcher, "a", running=[*ids(99), 3]) == ids(0, 1, 2)


def test_listed_commands_are_not_kept_with_the_request(dispatcher: Dispatcher) -> None:
    ask(dispatcher, "a", wanted=1, running=list(range(65_536)))
    assert dispatcher.actors["a"].request == CommandsRequest(actor="a", wanted=1)


def test_reruns_and_failures_are_counted_by_actor(dispatcher: Dispatcher) -> None:
    ask(dispatcher, "a")
    dispatcher.note_failure(command(0).id, "a")
    assert ask(dispatcher, "b") == ids(0, 3, 4)
    assert (dispatcher.actors["a"].reruns, dispatcher.actors["a"].failures) == (0, 1)
    assert (dispatcher.actors["b"].reruns, dispatcher.actors["b"].failures) == (1, 0)
    dispatcher.remove_actor("a")
    assert ask(dispatcher, "b", running=ids(0, 3, 4)) == ids(1, 2, 5)
    assert dispatcher.actors["b"].reruns == 3
    dispatcher.join(join("a"), 0.0)
    assert (dispatcher.actors["a"].reruns, dispatcher.actors["a"].failures) == (0, 0)


def test_reassigned_command_of_before_a_restart_is_a_rerun(dispatcher: Dispatcher) -> None:
    ask(dispatcher, "a", wanted=0, running=ids(0))
    dispatcher.remove_actor("a")
    assert command(0).id in ask(dispatcher, "b")
    assert dispatcher.actors["b"].reruns == 1


def test_silent_actor_is_removed(dispatcher: Dispatcher) -> None:
    ask(dispatcher, "a", now=0.0)
    ask(dispatcher, "b", wanted=0, now=SILENCE_S)
    assert dispatcher.silent_actors(set(), SILENCE_S + 1) == ["a"]
    dispatcher.remove_actor("a")
    assert list(dispatcher.actors) == ["b"]
    assert ask(dispatcher, "b") == ids(0, 1, 2, 3, 4, 5)


def test_delivery_ends_an_actors_silence(dispatcher: Dispatcher) -> None:
    for name in ("a", "b", "stranger"):
        dispatcher.note_seen(name, SILENCE_S)
    assert dispatcher.silent_actors(set(), SILENCE_S + 1) == []
    assert list(dispatcher.actors) == ["a", "b"]


def test_silent_actor_with_a_presence_token_is_kept(dispatcher: Dispatcher) -> None:
    ask(dispatcher, "a", now=0.0)
    assert dispatcher.silent_actors({"a"}, SILENCE_S + 1) == ["b"]


# Stragglers.


@pytest.fixture
def straggling(dispatcher: Dispatcher) -> Dispatcher:
    """``a`` has held one command since 0 s, all others are done; an episode takes 2 s."""
    first, *others = [c for name in ("a", "b") for c in ask(dispatcher, name)]
    for command_id in others:
        dispatcher.remove_command(command_id, now=2.0)
    assert dispatcher.holds("a", first)
    return dispatcher


OVERDUE = STRAGGLER * 2.0


def test_straggler_is_also_assigned_to_an_idle_actor(straggling: Dispatcher) -> None:
    assert ask(straggling, "b", now=OVERDUE + 0.1, spare_cores=1.0) == ids(0)
    assert straggling.holds("a", ids(0)[0])


def test_straggler_is_not_assigned_again_too_early(straggling: Dispatcher) -> None:
    assert ask(straggling, "b", now=OVERDUE, spare_cores=1.0) == []


def test_straggler_is_not_assigned_again_on_a_saturated_machine(straggling: Dispatcher) -> None:
    assert ask(straggling, "b", now=OVERDUE + 0.1, spare_cores=0.9) == []


def test_straggler_is_not_assigned_again_to_a_busy_actor(straggling: Dispatcher) -> None:
    straggling.add([command(7)])
    ask(straggling, "b", wanted=1)
    busy = ask(straggling, "b", running=ids(7), now=OVERDUE + 0.1, spare_cores=1.0)
    assert busy == []


def test_straggler_runs_on_at_most_two_actors(straggling: Dispatcher) -> None:
    straggling.join(join("c"), 0.0)
    ask(straggling, "b", now=OVERDUE + 0.1, spare_cores=1.0)
    assert ask(straggling, "c", now=100.0, spare_cores=1.0) == []


def test_there_are_no_stragglers_before_the_first_episode(dispatcher: Dispatcher) -> None:
    ask(dispatcher, "a")
    ask(dispatcher, "b", running=[])
    dispatcher.remove_actor("b")
    dispatcher.join(join("b"), 0.0)
    for command_id in ids(3, 4, 5):
        dispatcher.remove_command(command_id)
    assert ask(dispatcher, "b", now=1000.0, spare_cores=1.0) == []


def test_straggler_stays_with_the_first_actor_if_the_second_dies(straggling: Dispatcher) -> None:
    ask(straggling, "b", now=OVERDUE + 0.1, spare_cores=1.0)
    straggling.remove_actor("b")
    assert straggling.holds("a", ids(0)[0])
    straggling.join(join("b"), 0.0)
    assert ask(straggling, "b", now=OVERDUE + 0.1) == []


# Failures.


def fail(dispatcher: Dispatcher, name: str) -> bool:
    ask(dispatcher, name, wanted=0, running=ids(0))
    dispatcher.note_failure(ids(0)[0], name)
    return dispatcher.is_hopeless(ids(0)[0])


def test_three_failures_on_two_actors_are_hopeless(dispatcher: Dispatcher) -> None:
    assert [fail(dispatcher, name) for name in "aba"] == [False, False, True]


def test_failures_on_one_of_two_actors_are_not_hopeless(dispatcher: Dispatcher) -> None:
    assert [fail(dispatcher, "a") for _ in range(5)] == [False] * 5
    assert fail(dispatcher, "b")


def test_failures_on_the_only_actor_are_hopeless(dispatcher: Dispatcher) -> None:
    dispatcher.remove_actor("b")
    assert [fail(dispatcher, "a") for _ in range(3)] == [False, False, True]


def test_failures_on_a_removed_actor_are_not_hopeless_before_another_has_tried(
    dispatcher: Dispatcher,
) -> None:
    assert [fail(dispatcher, "a") for _ in range(3)] == [False] * 3
    ask(dispatcher, "a", wanted=0, running=ids(0))
    dispatcher.remove_actor("a")
    assert not dispatcher.is_hopeless(ids(0)[0])
    assert fail(dispatcher, "b")


def test_actor_that_vanished_with_a_command_has_tried_it(dispatcher: Dispatcher) -> None:
    ask(dispatcher, "b", wanted=0, running=ids(0))
    dispatcher.join(join("b"), 0.0)
    assert [fail(dispatcher, "a") for _ in range(3)] == [False, False, True]


def test_failed_command_is_assigned_again(dispatcher: Dispatcher) -> None:
    ask(dispatcher, "a")
    dispatcher.note_failure(ids(0)[0], "a")
    assert not dispatcher.holds("a", ids(0)[0])
    assert ask(dispatcher, "b", wanted=1) == ids(0)


# Actors that vanish together with their commands.


@pytest.fixture
def alone() -> Dispatcher:
    """Three commands; three actors vanished while they held the first."""
    dispatcher = Dispatcher()
    dispatcher.add(command(index) for index in range(3))
    for name in ("x", "y", "z"):
        dispatcher.join(join(name), 0.0)
        assert ask(dispatcher, name) == ids(0, 1, 2)
        assert [item.command.id for item in dispatcher.remove_actor(name)] == ids(0, 1, 2)
    for command_id in ids(1, 2):
        dispatcher.remove_command(command_id)
    dispatcher.add(command(index) for index in range(3, 6))
    return dispatcher


def vanish(dispatcher: Dispatcher, name: str) -> bool:
    """Let an actor vanish with the first command; return whether the command is hopeless then."""
    dispatcher.join(join(name), 0.0)
    assert ask(dispatcher, name) == ids(0)
    dispatcher.remove_actor(name)
    return dispatcher.is_hopeless(ids(0)[0])


def test_suspect_command_is_assigned_alone(alone: Dispatcher) -> None:
    for name in ("a", "b"):
        alone.join(join(name), 0.0)
    assert ask(alone, "a") == ids(0)
    assert ask(alone, "a", running=ids(0)) == []
    assert ask(alone, "b") == ids(3, 4)


def test_suspect_command_waits_for_an_idle_actor(alone: Dispatcher) -> None:
    alone.join(join("a"), 0.0)
    alone.add([command(7)])
    assert ask(alone, "a", running=ids(7)) == ids(3, 4, 5)
    assert ask(alone, "a", running=ids(7, 3, 4, 5)) == []
    assert ask(alone, "a") == ids(0)


def test_suspect_command_waits_for_its_weights(alone: Dispatcher) -> None:
    alone.join(join("a"), 0.0)
    assert ask(alone, "a", version=0) == []


def test_suspect_commands_that_succeed_alone_are_done(dispatcher: Dispatcher) -> None:
    dispatcher.remove_actor("b")
    for name in ("a", "c", "d"):
        dispatcher.join(join(name), 0.0)
        held = ask(dispatcher, name)
        dispatcher.remove_actor(name)
    dispatcher.join(join("e"), 0.0)
    for command_id in held:
        assert ask(dispatcher, "e") == [command_id]
        dispatcher.remove_command(command_id, 1.0)
    assert not dispatcher.outstanding


def test_suspect_command_is_hopeless_after_three_actors_vanish_with_it_alone(
    alone: Dispatcher,
) -> None:
    assert [vanish(alone, name) for name in "abc"] == [False, False, True]


def test_vanished_actors_and_reported_failures_are_added(alone: Dispatcher) -> None:
    assert [vanish(alone, name) for name in "ab"] == [False, False]
    alone.join(join("c"), 0.0)
    assert ask(alone, "c") == ids(0)
    alone.note_failure(ids(0)[0], "c")
    assert alone.is_hopeless(ids(0)[0])


def test_actors_of_one_environment_get_three_more_attempts() -> None:
    dispatcher = Dispatcher()
    dispatcher.add([command(0)])
    assert [vanish(dispatcher, name) for name in "abcdef"] == [False] * 5 + [True]


def test_disconnected_actor_has_not_vanished(alone: Dispatcher) -> None:
    for _ in range(10):
        assert vanish(alone, "a") is False
        alone.join(join("a"), 0.0)
        assert ask(alone, "a", running=ids(0)) == []
    assert alone.outstanding[ids(0)[0]].vanished.keys() == {"x", "y", "z"}


def test_only_the_command_that_kills_actors_is_hopeless() -> None:
    """One of eight commands ends every actor that runs it; the others always succeed."""
    dispatcher = Dispatcher()
    dispatcher.add(command(index) for index in range(8))
    (deadly,) = ids(5)
    for number in range(100):
        dispatcher.join(join(f"actor-{number}"), 0.0)
        while deadly not in (held := ask(dispatcher, f"actor-{number}", wanted=4)):
            for command_id in held:
                dispatcher.remove_command(command_id, 1.0)
        dispatcher.remove_actor(f"actor-{number}")
        if any(dispatcher.is_hopeless(i) for i in dispatcher.outstanding):
            break
    assert dispatcher.is_hopeless(deadly)
    assert number < 6


# Waiting.


def test_retry_delay_grows_with_the_fleet_and_is_jittered(dispatcher: Dispatcher) -> None:
    few = [dispatcher.retry_after_s() for _ in range(100)]
    for number in range(100):
        dispatcher.join(join(f"actor-{number}"), 0.0)
    many = [dispatcher.retry_after_s() for _ in range(100)]
    assert 0 < max(few) < min(many)
    assert len(set(few)) > 1


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 5)), max_size=30))
def test_outstanding_commands_are_counted_by_iteration(steps: list[tuple[str, int]]) -> None:
    dispatcher = Dispatcher()
    dispatcher.add(command(index) for index in range(6))
    for name, index in steps:
        dispatcher.join(join(name), 0.0)
        ask(dispatcher, name)
        if command(index).id in dispatcher.outstanding:
            dispatcher.remove_command(command(index).id, 1.0)
    assert dispatcher.outstanding_in(1) == len(dispatcher.outstanding)
    assert dispatcher.outstanding_in(2) == 0
