"""Audits and quarantine: only false episodes have consequences, and results do not change."""

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from tests.replay.synthetic import (
    arrive,
    episode,
    join,
    reference,
    result,
    train_next,
    weights_of,
    work,
)
from udrl.commands import Command
from udrl.config import Budget
from udrl.errors import Deceived, Refused
from udrl_proto.messages import CommandsRequest
from udrl_replay.auditing import MOST_OPEN, Auditor, Verdict
from udrl_replay.quarantine import OFFENCES
from udrl_replay.run import StoredRun
from udrl_replay.store import Store


def command(number: int) -> Command:
    return Command(
        id=number, kind="explore", desired_return=1.0, desired_horizon=2, environment_seed=3,
        stream_key=bytes(16), weights_version=number % 7, max_steps=4,
    )  # fmt: skip


def audited(*digests: tuple[str, bytes]) -> Verdict | None:
    """Return the verdict on one command that actors deliver in this order."""
    auditor = Auditor(1.0)
    (first, digest), *others = digests
    auditor.maybe_audit(command(5), first, "c", digest)
    verdict = None
    for name, other in others:
        assert [c.id for c in auditor.assign(name, "c", (), 9)] == [5]
        verdict = auditor.compare(name, 5, other)
    return verdict


def test_two_equal_episodes_end_the_audit() -> None:
    auditor = Auditor(1.0)
    auditor.maybe_audit(command(5), "a", "c", b"x")
    assert auditor.versions == {5}
    assert auditor.assign("b", "c", (), 9) == [command(5)]
    assert auditor.is_assigned("b", 5)
    assert not auditor.is_assigned("a", 5)
    assert auditor.compare("b", 5, b"x") is None
    assert (auditor.open, auditor.versions) == ({}, set())


@pytest.mark.parametrize(("digests", "wrong_actor"), [("xyx", "b"), ("xyy", "a")])
def test_third_episode_decides_between_two(digests: str, wrong_actor: str) -> None:
    made = zip("abc", (d.encode() for d in digests), strict=True)
    assert audited(*made) == Verdict(wrong_actor)


def test_three_different_episodes_decide_nothing() -> None:
    assert audited(("a", b"x"), ("b", b"y"), ("c", b"z")) == Verdict(None)


def test_audit_goes_to_another_actor_of_the_same_class() -> None:
    auditor = Auditor(1.0)
    auditor.maybe_audit(command(5), "a", "c", b"x")
    assert auditor.assign("a", "c", (), 9) == []
    assert auditor.assign("b", "other", (), 9) == []
    assert auditor.assign("b", "c", (), 0) == []
    assert len(auditor.assign("b", "c", (), 9)) == 1
    assert auditor.assign("d", "c", (), 9) == [], "one audit of a command at a time"


def test_lost_audit_is_assigned_again() -> None:
    auditor = Auditor(1.0)
    auditor.maybe_audit(command(5), "a", "c", b"x")
    auditor.assign("b", "c", (), 9)
    assert auditor.assign("b", "c", {5}, 9) == [], "still assigned"
    assert len(auditor.assign("b", "c", (), 9)) == 1, "lost, and may be assigned again"
    auditor.remove_actor("b")
    assert len(auditor.assign("d", "c", (), 9)) == 1


def test_rate_is_the_audited_share() -> None:
    numbers = iter([0.0, 0.24, 0.25, 0.9])
    auditor = Auditor(0.25, lambda: next(numbers))
    for i in range(4):
        auditor.maybe_audit(command(i), "a", "c", b"x")
    assert set(auditor.open) == {0, 1}


def test_open_audits_are_bounded() -> None:
    auditor = Auditor(1.0)
    for i in range(MOST_OPEN + 10):
        auditor.maybe_audit(command(i), "a", "c", b"x")
    assert len(auditor.open) == MOST_OPEN
    auditor.stop()
    auditor.maybe_audit(command(1), "a", "c", b"x")
    assert not auditor.open


# Audits in a run.


def deliver(run: StoredRun, name: str, made: Command, *, is_false: bool = False) -> str:
    with run.store.transaction():
        reply = run.accept(arrive(episode(made, weights_of(run, made), is_false), name), 0.0)
        run.save()
    return reply


def ask(run: StoredRun, name: str, wanted: int = 1) -> list[Command]:
    return run.assign(CommandsRequest(actor=name, wanted=wanted), 0.0)


@pytest.fixture
def audited_run(make_run: Callable[..., StoredRun]) -> StoredRun:
    run = make_run()
    run.auditor = Auditor(1.0)
    for name in "abc":
        run.dispatcher.join(join(name), 0.0)
    return run


def test_audits_do_not_change_the_result(
    audited_run: StoredRun, make_run: Callable[..., StoredRun]
) -> None:
    run = audited_run
    run.budget = Budget(max_env_steps=40)
    while run.progress.state != "ended":
        if run.awaits_version() is not None:
            with run.store.transaction():
                run.add_version(train_next(run), 0.0)
        for name in "abc":
            for made in ask(run, name, wanted=4):
                deliver(run, name, made)
    assert run.progress.agreed > 10
    assert run.progress.exact
    assert result(run) == reference(0, 40)
    progress = run.progress
    assert progress.delivered == progress.accepted + progress.duplicate + progress.rejected


def test_actor_with_a_false_episode_stops_the_run_even_after_a_restart(
    audited_run: StoredRun, tmp_path: Path
) -> None:
    run = audited_run
    (made,) = ask(run, "a")
    assert deliver(run, "a", made, is_false=True) == "accepted"
    for name in "bc":
        assert ask(run, name) == [made], "audits precede other commands"
        assert deliver(run, name, made) == "duplicate"
    assert run.progress.state == "failed"
    assert (
        "actor a delivered a false episode: its episode of command 0 differs"
        in run.progress.problem
    )
    assert "Since iteration 0" in run.progress.problem
    assert set(run.quarantined.reasons) == {"a"}
    run.store.close()
    with (
        closing(Store(tmp_path)) as store,
        pytest.raises(Deceived, match="actor a delivered a false episode"),
    ):
        StoredRun(store, run.budget)
    assert Deceived.exit_code == 10


def test_auditor_with_a_false_episode_is_quarantined_and_the_run_continues(
    audited_run: StoredRun, reopened: Callable[..., StoredRun]
) -> None:
    run = audited_run
    (made,) = ask(run, "a")
    deliver(run, "a", made)
    ask(run, "b")
    deliver(run, "b", made, is_false=True)
    ask(run, "c")
    deliver(run, "c", made)
    assert run.progress.state == "running"
    assert set(run.quarantined.reasons) == {"b"}
    assert "b" not in run.dispatcher.actors
    (other,) = ask(run, "a")
    with pytest.raises(Refused, match="quarantined") as refused:
        deliver(run, "b", other)
    assert refused.value.code == "quarantined"
    assert set(reopened(run).quarantined.reasons) == {"b"}


def test_false_episode_of_before_the_first_audit_stops_the_run(
    make_run: Callable[..., StoredRun], reopened: Callable[..., StoredRun]
) -> None:
    run = make_run()
    run.dispatcher.join(join("b"), 0.0)
    (earlier,) = ask(run, "b")
    deliver(run, "b", earlier)
    run = reopened(run)
    run.auditor = Auditor(1.0)
    for name in "abc":
        run.dispatcher.join(join(name), 0.0)
    (made,) = ask(run, "a")
    deliver(run, "a", made)
    ask(run, "b")
    deliver(run, "b", made, is_false=True)
    ask(run, "c")
    deliver(run, "c", made)
    assert run.progress.deceived
    assert "actor b delivered a false episode" in run.progress.problem


def dispute(run: StoredRun, *, first_is_false: bool = False) -> Command:
    """Let actors a and b deliver different episodes of a command."""
    (made,) = ask(run, "a")
    deliver(run, "a", made, is_false=first_is_false)
    assert ask(run, "b") == [made]
    deliver(run, "b", made, is_false=not first_is_false)
    return made


def end(run: StoredRun, max_env_steps: int = 1) -> None:
    """Deliver everything that a run with a small budget needs, but no audits."""
    run.budget = Budget(max_env_steps=max_env_steps)
    while run.progress.state != "ended":
        work(run)


@pytest.mark.parametrize("max_env_steps", [1, 20])
def test_run_that_ends_with_an_undecided_dispute_is_not_exact(
    audited_run: StoredRun, max_env_steps: int
) -> None:
    made = dispute(audited_run)
    assert audited_run.progress.exact
    end(audited_run, max_env_steps)
    assert audited_run.progress.inexact_reason == (
        f"two actors ran command {made.id} and their episodes differ; no third actor decided which "
        f"is wrong"
    )


def test_dispute_that_arises_after_the_end_makes_the_run_inexact(audited_run: StoredRun) -> None:
    run = audited_run
    (made,) = ask(run, "a")
    deliver(run, "a", made)
    ask(run, "b")
    end(run)
    assert run.progress.exact
    deliver(run, "b", made, is_false=True)
    assert "no third actor decided" in run.progress.inexact_reason


@pytest.mark.parametrize("first_is_false", [True, False])
def test_dispute_that_is_decided_after_the_end(
    first_is_false: bool, audited_run: StoredRun, reopened: Callable[..., StoredRun]
) -> None:
    run = audited_run
    made = dispute(run, first_is_false=first_is_false)
    assert ask(run, "c") == [made]
    end(run)
    assert run.progress.exact, "it may still be decided"
    deliver(run, "c", made)
    with run.store.transaction():
        run.stop()
    again = reopened(run).progress
    assert (again.state, again.deceived, again.problem) == ("ended", False, "")
    assert set(run.quarantined.reasons) == {"a" if first_is_false else "b"}
    assert again.exact is not first_is_false
    if first_is_false:
        assert again.inexact_reason.startswith("actor a delivered a false episode: its episode")


def test_failed_run_with_a_false_episode_cannot_be_resumed(
    audited_run: StoredRun, tmp_path: Path
) -> None:
    run = audited_run
    made = dispute(run, first_is_false=True)
    assert ask(run, "c") == [made]
    run.progress.state, run.progress.problem = "failed", "command 2 failed 3 times"
    deliver(run, "c", made)
    assert run.progress.state == "failed"
    run.store.close()
    with (
        closing(Store(tmp_path)) as store,
        pytest.raises(Deceived, match="actor a delivered a false episode"),
    ):
        StoredRun(store, run.budget)


def test_run_that_stops_with_an_undecided_dispute_is_not_exact(
    audited_run: StoredRun, reopened: Callable[..., StoredRun]
) -> None:
    run = audited_run
    made = dispute(run)
    assert ask(run, "c") == [made]
    with run.store.transaction():
        run.stop()
    assert "no third actor decided" in reopened(run).progress.inexact_reason


def test_nondeterministic_environment_leads_to_no_quarantine(audited_run: StoredRun) -> None:
    run = audited_run
    (made,) = ask(run, "a")
    for name, weights in zip("abc", (b"1", b"2", b"3"), strict=True):
        if name != "a":
            assert ask(run, name) == [made]
        with run.store.transaction():
            run.accept(arrive(episode(made, weights), name), 0.0)
    assert not run.quarantined.reasons
    assert not run.progress.exact
    assert "not deterministic" in run.progress.inexact_reason
    assert run.auditor.rate == 0


def test_repeated_offender_is_quarantined(make_run: Callable[..., StoredRun]) -> None:
    run = make_run()
    work(run)  # the warm-up
    with run.store.transaction():
        run.add_version(train_next(run), 0.0)
    run.dispatcher.join(join("a"), 0.0)
    (made,) = ask(run, "a")
    unknown = command(999)  # of the warm-up, which had fewer
    for _ in range(OFFENCES):
        with pytest.raises(Refused, match="never issued"), run.store.transaction():
            run.accept(arrive(episode(unknown, b""), "a"), 0.0)
    assert "10 invalid episodes" in run.quarantined.reasons["a"]
    with pytest.raises(Refused, match="quarantined"):
        deliver(run, "a", made)
    assert run.progress.rejected == OFFENCES + 1
    run.dispatcher.join(join("b"), 0.0)
    assert ask(run, "b") == [made], "its commands must be reassigned"
    assert deliver(run, "b", made) == "accepted"
