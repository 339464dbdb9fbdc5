"""Admission of actors and learners to a run."""

from collections.abc import Callable

import pytest
from msgspec.structs import replace

from tests.replay.synthetic import SPEC, join
from udrl.errors import Refused
from udrl_proto.messages import CommandsRequest, Hello, JoinRequest, Role
from udrl_replay import admission
from udrl_replay.admission import Admission
from udrl_replay.dispatching import SUSPICIOUS
from udrl_replay.run import StoredRun

MakeRun = Callable[..., StoredRun]


def request(role: Role, name: str, numerics_class: str = "c") -> JoinRequest:
    environment = SPEC if role == "actor" else None
    return replace(join(name), role=role, numerics_class=numerics_class, environment=environment)


def refusal(ask: Callable[[], None]) -> str:
    """Return the code of a refusal."""
    with pytest.raises(Refused) as no:
        ask()
    return no.value.code


@pytest.mark.parametrize("role", ["actor", "learner"])
def test_unknown_service_must_join_first(role: Role, make_run: MakeRun) -> None:
    one = Admission(make_run())
    assert refusal(lambda: one.check(role, "a")) == "join_first"
    one.join(request(role, "a"), 0.0)
    one.check(role, "a")
    one.remove_service(role, "a")
    assert refusal(lambda: one.check(role, "a")) == "join_first"


@pytest.mark.parametrize(
    ("role", "field"), [("actor", "acting_class"), ("learner", "training_class")]
)
def test_first_delivery_sets_the_numerics_class(role: Role, field: str, make_run: MakeRun) -> None:
    run = make_run()
    one = Admission(run)
    for name in ("first", "second"):
        one.join(request(role, name, f"of {name}"), 0.0)
        one.check(role, name)
    assert run.hello == run.store.fact("hello", Hello)
    assert (run.hello.acting_class, run.hello.training_class) == ("", "")
    with run.store.transaction():
        one.note_accepted(role, "second")
    assert getattr(run.hello, field) == "of second"
    assert run.store.fact("hello", Hello) == run.hello
    one.check(role, "second")
    assert refusal(lambda: one.check(role, "first")) == "other_numerics"
    assert refusal(lambda: one.check(role, "first")) == "join_first"
    assert refusal(lambda: one.join(request(role, "first", "of first"), 0.0)) == "other_numerics"
    assert run.progress.exact


@pytest.mark.parametrize("role", ["actor", "learner"])
def test_removed_and_refused_services_do_not_wait(role: Role, make_run: MakeRun) -> None:
    run = make_run()
    one = Admission(run)
    for name in ("a", "b", "c"):
        one.join(request(role, name, f"of {name}"), 0.0)
        run.waits.begin(f"{role} {name}", "learner", "weights version 1", 0.0)
    with run.store.transaction():
        one.note_accepted(role, "a")
    one.remove_service(role, "c")
    with pytest.raises(Refused, match="numerics class"):
        one.check(role, "b")
    assert [wait.who for wait in run.waits.list(1.0)] == [f"{role} a"]


def test_quarantined_actor_does_not_wait(make_run: MakeRun) -> None:
    run = make_run()
    run.dispatcher.join(join("a"), 0.0)
    run.waits.begin("actor a", "learner", "weights version 1", 0.0)
    with run.store.transaction():
        run.enforcement.quarantine("a", "a false episode")
    assert run.waits.list(1.0) == ()


def test_actors_and_learners_have_separate_numerics_classes(make_run: MakeRun) -> None:
    run = make_run()
    one = Admission(run)
    one.join(request("actor", "a", "of actors"), 0.0)
    with run.store.transaction():
        one.note_accepted("actor", "a")
    one.join(request("learner", "l", "of learners"), 0.0)
    one.check("learner", "l")


def test_commands_of_a_refused_actor_go_to_others(make_run: MakeRun) -> None:
    run = make_run()
    one = Admission(run)
    for name in ("a", "b"):
        one.join(request("actor", name, f"of {name}"), 0.0)
        assert run.dispatcher.assign(run.dispatcher.actors[name].request, 0, 0.0) == []
    held = run.dispatcher.assign(replace(run.dispatcher.actors["b"].request, wanted=1), 0, 0.0)
    with run.store.transaction():
        one.note_accepted("actor", "a")
    assert refusal(lambda: one.check("actor", "b")) == "other_numerics"
    again = run.dispatcher.assign(replace(run.dispatcher.actors["a"].request, wanted=9), 0, 0.0)
    assert held[0] in again


def test_refused_and_quarantined_actors_have_not_vanished_with_their_commands(
    make_run: MakeRun,
) -> None:
    run = make_run()
    one = Admission(run)
    one.join(request("actor", "a"), 0.0)
    with run.store.transaction():
        one.note_accepted("actor", "a")
        for number in range(2 * SUSPICIOUS):
            name = f"b{number}"
            run.dispatcher.join(request("actor", name, "other"), 0.0)
            held = run.assign(CommandsRequest(actor=name, wanted=1), 0.0)
            assert held, "the commands of the one before must be assigned again"
            if number % 2:
                run.enforcement.quarantine(name, "a false episode")
            else:
                with pytest.raises(Refused, match="numerics class"):
                    one.check("actor", name)
    assert list(run.dispatcher.actors) == ["a"]
    assert all(not item.vanished for item in run.dispatcher.outstanding.values())


def test_run_becomes_inexact_with_the_first_delivery_of_another_class_if_allowed(
    make_run: MakeRun,
) -> None:
    run = make_run()
    run.hello = replace(run.hello, allow_inexact=True)
    one = Admission(run)
    for name in ("a", "b"):
        one.join(request("actor", name, f"of {name}"), 0.0)
    with run.store.transaction():
        one.note_accepted("actor", "a")
    one.check("actor", "b")
    assert run.progress.exact
    with run.store.transaction():
        one.note_accepted("actor", "b")
    assert run.progress.inexact_reason == "actor b is of another numerics class"


def test_another_environment_is_refused(make_run: MakeRun) -> None:
    other = replace(join("a"), environment=replace(SPEC, max_episode_steps=5))
    assert refusal(lambda: Admission(make_run()).join(other, 0.0)) == "other_environment"


def test_quarantined_actors_and_too_many_actors_are_refused(
    make_run: MakeRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run()
    one = Admission(run)
    with run.store.transaction():
        run.quarantined.add("wrong_actor", "a false episode")
    with pytest.raises(Refused, match="a false episode"):
        one.join(join("wrong_actor"), 0.0)
    monkeypatch.setattr(admission, "MOST_ACTORS", 1)
    one.join(join("a"), 0.0)
    assert refusal(lambda: one.join(join("b"), 0.0)) == "too_many_actors"
    one.join(join("a"), 1.0)  # its reply was lost
    assert run.dispatcher.actors["a"].last_seen == 1.0
    one.join(request("learner", "l"), 0.0)


def test_number_of_remembered_learners_is_bounded(
    make_run: MakeRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(admission, "_MOST_LEARNERS", 2)
    one = Admission(make_run())
    for name in ("a", "b", "a", "c"):
        one.join(request("learner", name), 0.0)
    one.check("learner", "a")
    assert refusal(lambda: one.check("learner", "b")) == "join_first"


def test_actor_with_another_environment_digest_requires_an_inexact_run(
    make_run: MakeRun,
) -> None:
    run = make_run()
    one = Admission(run)
    actor = replace(request("actor", "a"), environment_digest="of another")
    one.join(actor, 0.0)  # environments that do not replay cannot be compared
    run.hello = replace(run.hello, environment_digest="of its own")
    assert refusal(lambda: one.join(actor, 0.0)) == "other_environment"
    one.join(request("learner", "l"), 0.0)
    one.join(replace(actor, environment_digest="of its own"), 0.0)
    assert run.progress.exact
    run.hello = replace(run.hello, allow_inexact=True)
    one.join(actor, 0.0)
    assert not run.progress.exact
