"""The run as a state machine: its result does not depend on faults or on the order of events."""

import tempfile
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
)
from msgspec.structs import replace

from tests.replay.synthetic import (
    MAX_AGE,
    arrive,
    config,
    create,
    episode,
    finish,
    join,
    reference,
    reopen,
    result,
    train_next,
    weights_of,
    work,
)
from udrl.commands import FINAL_EVALUATION, Command
from udrl.config import COMMANDS_PER_ITERATION, Budget
from udrl.errors import Refused
from udrl.replay_buffer import Entry
from udrl.schedule import weights_version
from udrl_inspect.inspection import read_status
from udrl_proto.codec import decode, encode
from udrl_proto.messages import CommandsRequest, FailureMessage
from udrl_proto.reports import Status
from udrl_replay.arrival import Arrival
from udrl_replay.progress import KILLED, STOPPED, RunProgress
from udrl_replay.reporting import Throughput, status
from udrl_replay.run import StoredRun
from udrl_replay.run_state import RunState
from udrl_replay.store import Store, Version

#: Env steps at which every run of the machine ends.
FINAL = 60
#: A file system that syncs at once; a disk takes ten times as long.
MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None


class Died(Exception):
    """The process dies in the middle of a transaction."""


class RunMachine(RuleBasedStateMachine):
    """Actors, a learner and a replay service, whose operations happen in any order."""

    @initialize(
        lead=st.integers(0, 3),
        max_env_steps=st.integers(1, FINAL // 2),
        keep_versions=st.none() | st.integers(0, 2),
    )
    def start(self, lead: int, max_env_steps: int, keep_versions: int | None) -> None:
        self.lead = lead
        self.keep_versions = keep_versions
        self.folder = tempfile.TemporaryDirectory(dir=MEMORY)
        self.run_dir = Path(self.folder.name)
        self.run = StoredRun(create(self.run_dir, lead), self.budget(max_env_steps))
        self.now = 0.0
        self.held: dict[tuple[str, int], tuple[Command, bytes]] = {}
        self.accepted: dict[int, tuple[Command, bytes]] = {}
        self.explored: list[Entry] = []
        self.trained: list[Version] = []

    def budget(self, max_env_steps: int) -> Budget:
        return Budget(max_env_steps=max_env_steps, keep_versions=self.keep_versions)

    # Actors.

    @rule(name=st.sampled_from("abc"))
    def actor_joins(self, name: str) -> None:
        self.run.dispatcher.join(join(name), self.now)

    @rule(name=st.sampled_from("abc"), dies=st.booleans())
    def actor_leaves(self, name: str, dies: bool) -> None:
        self.run.dispatcher.remove_actor(name)
        if dies:
            self.held = {key: item for key, item in self.held.items() if key[0] != name}

    @precondition(lambda self: self.run.dispatcher.actors)
    @rule(pick=st.integers(0, 2), wanted=st.integers(1, 4), arrives=st.integers(0, 4).map(bool))
    def actor_asks(self, pick: int, wanted: int, arrives: bool) -> None:
        name = sorted(self.run.dispatcher.actors)[pick % len(self.run.dispatcher.actors)]
        self.now += 1.0
        request = CommandsRequest(
            actor=name,
            wanted=wanted,
            running=tuple(i for owner, i in self.held if owner == name),
            spare_cores=2.0,
        )
        assigned = self.run.assign(request, self.now)
        assert len(assigned) <= wanted
        for command in assigned:
            assert command.id in self.run.dispatcher.outstanding
            weights = weights_of(self.run, command)
            if arrives:
                self.held[name, command.id] = command, weights

    @precondition(lambda self: self.held)
    @rule(pick=st.integers(0, 20), dies=st.integers(0, 5).map(lambda n: n == 0))
    def actor_delivers(self, pick: int, dies: bool) -> None:
        name, command_id = key = list(self.held)[pick % len(self.held)]
        command, weights = self.held[key]
        arrival = arrive(episode(command, weights), name)
        if dies:
            with suppress(Died), self.run.store.transaction():
                with suppress(Refused):
                    self.run.accept(arrival, self.now)
                raise Died
            self.replay_dies()
            return
        del self.held[key]
        expected = "duplicate" if command_id in self.accepted else "rejected"
        if command_id in self.run.dispatcher.outstanding:
            expected = "accepted"
            self.note_accepted(command, weights, arrival)
        assert self.deliver(arrival) == expected

    @rule(rounds=st.integers(1, 4), share=st.integers(1, 3))
    def all_services_work(self, rounds: int, share: int) -> None:
        """Run a share of the available commands, to get further than single steps do."""
        for _ in range(rounds):
            if self.run.awaits_version() is not None:
                self.learner_delivers()
            latest = self.run.progress.latest_version
            able = [
                item.command
                for item in self.run.dispatcher.outstanding.values()
                if item.command.weights_version <= latest
            ]
            for command in able[::share]:
                if command.id in self.run.dispatcher.outstanding:
                    weights = weights_of(self.run, command)
                    arrival = arrive(episode(command, weights))
                    self.note_accepted(command, weights, arrival)
                    assert self.deliver(arrival) == "accepted"

    def note_accepted(self, command: Command, weights: bytes, arrival: Arrival) -> None:
        self.accepted[command.id] = command, weights
        if command.kind != "evaluate":
            self.explored.append(arrival.entry)

    @precondition(lambda self: self.accepted)
    @rule(pick=st.integers(0, 100), other=st.booleans())
    def actor_delivers_again(self, pick: int, other: bool) -> None:
        command, weights = list(self.accepted.values())[pick % len(self.accepted)]
        known = self.run.store.episode_digest(command.id) is not None
        assert self.deliver(arrive(episode(command, weights, other))) == "duplicate"
        assert not (other and known and self.run.progress.exact)

    @rule(iteration=st.integers(0, 3), index=st.integers(6, FINAL_EVALUATION - 1))
    def actor_delivers_an_unknown_command(self, iteration: int, index: int) -> None:
        unknown = Command(
            id=iteration * COMMANDS_PER_ITERATION + index,
            kind="explore",
            desired_return=0.0,
            desired_horizon=1,
            environment_seed=0,
            stream_key=bytes(16),
            weights_version=0,
            max_steps=4,
        )
        quarantined = "stranger" in self.run.quarantined
        answer = self.deliver(arrive(episode(unknown, b""), "stranger"))
        assert answer == ("quarantined" if quarantined else "rejected")

    @precondition(lambda self: self.held)
    @rule(pick=st.integers(0, 20), times=st.integers(1, 2))
    def actor_fails(self, pick: int, times: int) -> None:
        name, command_id = list(self.held)[pick % len(self.held)]
        del self.held[name, command_id]
        before = self.run.progress.env_failures
        with self.run.store.transaction():
            for _ in range(times):
                self.run.fail(FailureMessage(actor=name, command_id=command_id, error="e"))
            self.run.save()
        assert self.run.progress.env_failures <= before + 1

    def deliver(self, arrival: Arrival) -> str:
        with self.run.store.transaction():
            try:
                return self.run.accept(arrival, self.now)
            except Refused as refusal:
                return refusal.code
            finally:
                self.run.save()

    # The learner.

    @precondition(lambda self: self.run.awaits_version() is not None)
    @rule()
    def learner_delivers(self) -> None:
        self.trained.append(train_next(self.run))
        assert self.deliver_version(self.trained[-1]) == "accepted"
        self.check_collected()

    @precondition(lambda self: self.trained)
    @rule(pick=st.integers(0, 20), equal=st.booleans())
    def learner_delivers_again(self, pick: int, equal: bool) -> None:
        version = self.trained[pick % len(self.trained)]
        if equal:
            assert self.deliver_version(version) == "duplicate"
        else:
            other = version._replace(digest=b"other", weights=b"other")
            assert self.deliver_version(other) == "unequal_version"

    @rule(ahead=st.integers(1, 3))
    def learner_is_ahead(self, ahead: int) -> None:
        ahead += self.run.awaits_version() is not None
        version = Version(self.run.progress.latest_version + ahead, b"d", 1.0, b"w", b"o")
        assert self.deliver_version(version) == "rewind"

    def deliver_version(self, version: Version) -> str:
        with self.run.store.transaction():
            try:
                return self.run.add_version(version, 0.0)
            except Refused as refusal:
                return refusal.code
            finally:
                self.run.save()

    # The replay process.

    @rule()
    def replay_dies(self) -> None:
        self.run = reopen(self.run, self.run_dir)

    @rule(more=st.integers(0, FINAL // 4))
    def run_is_resumed_with_a_larger_budget(self, more: int) -> None:
        budget = self.budget(min(self.run.budget.max_env_steps + more, FINAL))
        self.run = reopen(self.run, self.run_dir, budget)
        if self.run.progress.state == "running":
            # The evaluations of the earlier end are discarded.
            self.accepted = {
                i: a for i, a in self.accepted.items() if a[0].index < FINAL_EVALUATION
            }

    # Invariants.

    @invariant()
    def ledgers_balance(self) -> None:
        shown = status(self.run, Throughput(), 0.0, self.now)
        assert_conserved(shown)
        assert shown.episodes.accepted >= len(self.accepted)
        assert shown.commands.outstanding == len(self.run.store.commands(cancelled=False)) - len(
            self.run.store.pending_ids()
        )

    @invariant()
    def buffer_holds_the_best_of_everything(self) -> None:
        assert list(self.run.buffer) == self.best(self.run.progress.iteration)
        assert sorted(self.run.digests) == sorted(e.id for e in self.run.buffer)

    @invariant()
    def earlier_buffers_are_available(self) -> None:
        for iteration in self.needed_buffers():
            ids = [p.entry.id for p in self.run.store.buffer(iteration)]
            assert ids == [e.id for e in self.best(iteration)]
            assert len(self.run.store.episode_bodies(ids, 1 << 30)) == len(ids)

    @invariant()
    def weights_that_commands_name_are_kept(self) -> None:
        outstanding = [item.command for item in self.run.dispatcher.outstanding.values()]
        for command in [*outstanding, *self.run.store.commands(cancelled=True)]:
            if command.weights_version <= self.run.progress.latest_version:
                weights_of(self.run, command)

    @invariant()
    def progress_is_on_disk(self) -> None:
        assert self.run.store.fact("progress", RunProgress) == self.run.progress

    @invariant()
    def every_episode_has_its_body(self) -> None:
        store = self.run.store
        assert store._rows("SELECT id FROM bodies") == store._rows("SELECT id FROM episodes")

    def needed_buffers(self) -> range:
        """Return the iterations after which the buffer may still be requested."""
        latest, iteration = self.run.progress.latest_version, self.run.progress.iteration
        return range(min(latest, iteration), iteration + 1)

    def best(self, iteration: int) -> list[Entry]:
        """Return the buffer after an iteration, computed from all accepted episodes."""
        held: list[Entry] = []
        settings = config().buffer
        for i in range(iteration + 1):
            held += sorted((e for e in self.explored if e.iteration == i), key=lambda e: e.id)
            held = [e for e in held if i - e.iteration < MAX_AGE]
            best, newest = sorted(held)[-settings.replay_size :], held[-settings.recent_size :]
            held = [e for e in held if e in best or e in newest]
        return sorted(held)

    def check_collected(self) -> None:
        """Check after a version that everything unneeded was deleted."""
        store, progress = self.run.store, self.run.progress
        wanted = {p.entry.id for i in self.needed_buffers() for p in store.buffer(i)}
        wanted |= store.pending_ids()
        assert {i for i in self.accepted if store.episode_digest(i) is not None} == wanted
        named = {c.weights_version for c in store.commands(cancelled=True)}
        named |= {c.weights_version for c in store.commands(cancelled=False)}
        latest, lead = progress.latest_version, self.run.config.lead
        evaluated = {weights_version(e.iteration, lead) for e in store.evaluations(-1, 2**62)}
        assert progress.best_version in evaluated | {0}
        if self.keep_versions is not None:
            evaluated = set(sorted(evaluated, reverse=True)[: self.keep_versions])
        named |= evaluated | {latest, progress.best_version}
        assert set(store.versions_kept()) == {v for v in named if 0 < v <= latest}

    def teardown(self) -> None:
        if not hasattr(self, "run"):
            return
        with self.folder:
            self.run = reopen(self.run, self.run_dir, self.budget(FINAL))
            finish(self.run)
            assert self.run.progress.state == "ended"
            assert result(self.run) == reference(self.lead, FINAL)
            self.run.store.close()


TestRunMachine = RunMachine.TestCase
TestRunMachine.settings = settings(max_examples=60, stateful_step_count=50)


def assert_conserved(shown: Status) -> None:
    commands, episodes = shown.commands, shown.episodes
    assert commands.issued == commands.accepted + commands.cancelled + commands.outstanding
    assert episodes.delivered == episodes.accepted + episodes.duplicate + episodes.rejected


# Single cases.

MakeRun = Callable[..., StoredRun]


def outstanding(run: StoredRun) -> list[Command]:
    return [item.command for item in run.dispatcher.outstanding.values()]


def deliver(run: StoredRun, command: Command, other: bool = False) -> str:
    with run.store.transaction():
        try:
            return run.accept(arrive(episode(command, weights_of(run, command), other)), 0.0)
        finally:
            run.save()


def work_until_final_evaluation(run: StoredRun) -> None:
    """Work until only the final evaluation is left."""
    while run.progress.state == "running":
        work(run)
    while run.awaits_version() is not None:
        with run.store.transaction():
            run.add_version(train_next(run), 0.0)


def fail(run: StoredRun, command_id: int, *actors: str) -> None:
    """Let actors get a command and fail on it, one after the other."""
    for name in actors:
        run.dispatcher.join(join(name), 0.0)
        run.dispatcher.assign(
            CommandsRequest(actor=name, wanted=0, running=(command_id,)),
            run.progress.latest_version,
            0.0,
        )
    with run.store.transaction():
        for name in actors:
            run.fail(FailureMessage(actor=name, command_id=command_id, error="no more fuel"))
        run.save()


@pytest.mark.parametrize("lead", range(4))
@pytest.mark.parametrize("max_env_steps", [1, 30, 100])
def test_run_equals_the_reference(lead: int, max_env_steps: int, make_run: MakeRun) -> None:
    run = make_run(lead, max_env_steps)
    finish(run)
    assert result(run) == reference(lead, max_env_steps)


def test_reopened_run_issues_no_command_twice(make_run: MakeRun, reopened: MakeRun) -> None:
    run = make_run()
    before = outstanding(run)
    run = reopened(run)
    assert outstanding(run) == before
    assert run.progress.issued == len(before) == config().commands.n_warm_up_episodes


def test_second_delivery_is_a_duplicate(make_run: MakeRun) -> None:
    run = make_run()
    command = outstanding(run)[0]
    assert deliver(run, command) == "accepted"
    assert deliver(run, command) == "duplicate"
    assert run.progress.exact


def test_different_episode_of_a_command_is_a_duplicate_and_marks_the_run(make_run: MakeRun) -> None:
    run = make_run()
    command = outstanding(run)[0]
    deliver(run, command)
    assert deliver(run, command, other=True) == "duplicate"
    assert not run.progress.exact
    assert f"command {command.id} and their episodes differ" in run.progress.inexact_reason


def test_episode_above_max_steps_is_rejected_and_stays_outstanding(make_run: MakeRun) -> None:
    run = make_run()
    command = next(c for c in outstanding(run) if len(episode(c, b"").rewards) > 1)
    run.dispatcher.outstanding[command.id].command = replace(command, max_steps=1)
    with pytest.raises(Refused, match=r"steps, its command allows 1"):
        deliver(run, command)
    assert run.progress.rejected == 1
    assert command.id in run.dispatcher.outstanding


def test_warm_up_that_exhausts_the_budget_ends_the_run(make_run: MakeRun) -> None:
    run = make_run(max_env_steps=1)
    for command in outstanding(run):
        deliver(run, command)
    assert run.progress.state == "ended"
    assert run.awaits_version() is None


def test_final_evaluation_has_the_final_weights_and_fresh_seeds(make_run: MakeRun) -> None:
    run = make_run(lead=2, max_env_steps=20)
    seeds = set()
    while run.progress.state == "running":
        seeds |= {c.environment_seed for c in outstanding(run)}
        work(run)
    work_until_final_evaluation(run)
    final = run.progress.iteration
    assert [c.id for c in outstanding(run)] == [
        final * COMMANDS_PER_ITERATION + FINAL_EVALUATION + n
        for n in range(config().evaluation.eval_episodes)
    ]
    assert {c.weights_version for c in outstanding(run)} == {final}
    assert seeds.isdisjoint(c.environment_seed for c in outstanding(run))


def test_repeated_episode_of_the_final_evaluation_is_a_duplicate(make_run: MakeRun) -> None:
    run = make_run(max_env_steps=20)
    work_until_final_evaluation(run)
    final = outstanding(run)
    assert [deliver(run, c) for c in final + final] == ["accepted"] * 2 + ["duplicate"] * 2
    assert run.progress.state == "ended"


def test_cancelled_command_is_refused_until_the_run_is_resumed(
    make_run: MakeRun, reopened: MakeRun
) -> None:
    run = make_run(lead=1, max_env_steps=20)
    finish(run)
    cancelled = run.store.commands(cancelled=True)[0]
    with pytest.raises(Refused, match=f"command {cancelled.id} is cancelled"):
        deliver(run, cancelled)
    run = reopened(run, Budget(max_env_steps=40))
    assert deliver(run, cancelled) == "accepted"


def test_resumed_run_completes_the_pending_episodes(make_run: MakeRun, reopened: MakeRun) -> None:
    run = make_run(lead=1)
    work(run)
    budget = run.progress.env_steps + 1  # iteration 1 reaches it
    run = reopened(run, Budget(max_env_steps=budget))
    run.add_version(train_next(run), 0.0)
    *others, last = [c for c in outstanding(run) if c.iteration == 1]
    for command in [*others, *(c for c in outstanding(run) if c.iteration == 2), last]:
        deliver(run, command)
    assert (run.progress.state, run.progress.iteration) == ("finishing", 1)
    run = reopened(run, Budget(max_env_steps=budget + 40))
    assert (run.progress.state, run.progress.iteration) == ("running", 2)


def test_evaluation_that_reaches_the_stop_return_ends_the_run(make_run: MakeRun) -> None:
    run = make_run(stop_return=0.0)
    finish(run)
    evaluation = run.store.last_evaluation(is_final=False)
    assert evaluation is not None
    assert evaluation.iteration == run.progress.iteration == 1


def test_run_has_the_reason_of_its_end(
    make_run: MakeRun, reopened: MakeRun, tmp_path: Path
) -> None:
    run = make_run(stop_return=0.0)
    assert run.progress.why_ended() == ""
    finish(run)
    assert run.progress.why_ended() == "reached return 0"
    assert run.limit_reached() == "stop_return"
    steps = run.progress.env_steps
    run = reopened(run, Budget(max_env_steps=steps + 20))
    assert (run.progress.state, run.progress.why_ended()) == ("running", "")
    assert run.limit_reached() is None
    finish(run)
    assert run.limit_reached() == "max_env_steps"
    assert run.progress.why_ended() == f"spent its budget of {steps + 20} env steps"
    assert read_status(tmp_path).ended_because == run.progress.why_ended()


def test_failed_run_has_the_reason(make_run: MakeRun, tmp_path: Path) -> None:
    run = make_run()
    for actors in ("ab", "a"):
        fail(run, 2, *actors)
    assert read_status(tmp_path).ended_because.startswith("failed: command 2 failed 3 times: ")


def test_stopped_run_differs_from_a_killed_one(
    make_run: MakeRun, reopened: MakeRun, tmp_path: Path
) -> None:
    run = make_run(max_env_steps=20)
    work_until_final_evaluation(run)
    with run.store.transaction():
        run.save()
    assert read_status(tmp_path).state == "stopped"
    assert read_status(tmp_path).ended_because == KILLED
    with run.store.transaction():
        run.stop()
    assert read_status(tmp_path).ended_because == STOPPED
    run = reopened(run)
    assert run.progress.ended_because == "spent its budget of 20 env steps"


def test_best_version_is_kept(make_run: MakeRun) -> None:
    run = make_run(max_env_steps=120)
    best: dict[int, float] = {}
    while run.progress.state != "ended":
        work(run)
        last = run.store.last_evaluation(is_final=False)
        if last is not None:
            best.setdefault(last.iteration, last.evaluation.mean)
    expected = min(best, key=lambda version: (-best[version], version))
    assert 0 < run.progress.best_version == expected < run.progress.latest_version
    assert run.progress.version_named("best") == expected
    assert run.progress.version_named("latest") == run.progress.latest_version
    assert run.progress.version_named(3) == 3
    version = run.store.version(expected)
    assert version is not None
    assert version.weights


def test_keep_versions_limits_the_evaluated_versions(
    make_run: MakeRun, reopened: MakeRun, tmp_path: Path
) -> None:
    run = make_run(lead=1, max_env_steps=120, keep_versions=2)
    finish(run)
    last, best = run.progress.latest_version, run.progress.best_version
    cancelled = {c.weights_version for c in run.store.commands(cancelled=True)}
    evaluated = sorted(weights_version(e.iteration, 1) for e in run.store.evaluations(-1, 2**62))
    assert len(set(evaluated)) > 4
    assert set(run.store.versions_kept()) == {*evaluated[-2:], *cancelled, best, last} - {last + 1}
    assert result(run) == reference(1, 120)
    run = reopened(run, Budget(max_env_steps=120, keep_versions=0))
    assert set(run.store.versions_kept()) == {*cancelled, best, last} - {last + 1}
    assert read_status(tmp_path).weights_kept == tuple(run.store.versions_kept())
    run = reopened(run, Budget(max_env_steps=200, keep_versions=0))
    finish(run)
    assert result(run) == reference(1, 200)


def test_different_version_is_refused_with_both_digests(make_run: MakeRun) -> None:
    run = make_run()
    work(run)
    version = train_next(run)
    run.add_version(version, 0.0)
    assert run.add_version(version, 0.0) == "duplicate"
    other = version._replace(digest=bytes(32))
    with pytest.raises(Refused, match=f"{'0' * 16}, .*{version.digest.hex()[:16]}") as caught:
        run.add_version(other, 0.0)
    assert caught.value.code == "unequal_version"


def test_diverged_version_is_refused_with_the_remedy(make_run: MakeRun) -> None:
    run = make_run()
    work(run)
    with pytest.raises(Refused, match="loss nan: training diverged; lower learning_rate"):
        run.add_version(train_next(run)._replace(loss=float("nan")), 0.0)
    assert run.awaits_version() == 1


def test_three_failures_on_two_actors_stop_the_run(make_run: MakeRun) -> None:
    run = make_run()
    fail(run, 2, "a", "b")
    before = run.progress.state
    fail(run, 2, "a")
    assert (before, run.progress.state) == ("running", "failed")
    assert run.progress.problem == (
        "command 2 failed 3 times: no more fuel; reproduce it with: udrl reproduce "
        f"{run.store.run_dir} 2"
    )


def test_long_error_leaves_room_for_the_remedy(make_run: MakeRun) -> None:
    run = make_run()
    for name in ("a", "b", "a"):
        run.dispatcher.join(join(name), 0.0)
        request = CommandsRequest(actor=name, wanted=0, running=(2,))
        run.dispatcher.assign(request, 0, 0.0)
        run.fail(FailureMessage(actor=name, command_id=2, error=4000 * "\n"))
    seen = status(run, Throughput(), 0.0, 0.0)
    assert seen.problem.endswith(f"; reproduce it with: udrl reproduce {run.store.run_dir} 2")
    assert decode(encode(seen), Status) == seen


def test_repeated_failure_counts_once(make_run: MakeRun) -> None:
    run = make_run()
    fail(run, 2, "a")
    for _ in range(3):
        run.fail(FailureMessage(actor="a", command_id=2, error="no more fuel"))
    assert run.progress.env_failures == 1
    assert run.progress.state == "running"


def test_failed_run_retries_when_it_is_resumed(make_run: MakeRun, reopened: MakeRun) -> None:
    run = make_run(max_env_steps=20)
    fail(run, 2, "a", "b")
    fail(run, 2, "a")
    run = reopened(run)
    assert (run.progress.state, run.progress.problem) == ("running", "")
    finish(run)
    assert result(run) == reference(0, 20)


def test_failed_final_evaluation_is_retried(make_run: MakeRun, reopened: MakeRun) -> None:
    run = make_run(max_env_steps=20)
    work_until_final_evaluation(run)
    for actors in ("ab", "a"):
        fail(run, outstanding(run)[0].id, *actors)
    assert run.progress.state == "failed"
    run = reopened(run)
    assert run.progress.state == "finishing"
    finish(run)
    assert result(run) == reference(0, 20)


def test_final_evaluation_that_another_actor_completes_after_a_failure_ends_the_run(
    make_run: MakeRun, reopened: MakeRun
) -> None:
    run = make_run(max_env_steps=20)
    work_until_final_evaluation(run)
    commands = outstanding(run)
    for actors in ("ab", "a"):
        fail(run, commands[0].id, *actors)
    for command in commands:
        deliver(run, command)
    assert run.progress.state == "failed"
    run = reopened(run)
    assert run.progress.state == "ended"
    assert result(run) == reference(0, 20)


def vanish(run: StoredRun, *actors: str) -> set[int]:
    """Let actors get commands and vanish, one after the other; return the last one's commands."""
    for name in actors:
        run.dispatcher.join(join(name), 0.0)
        request = CommandsRequest(actor=name, wanted=100)
        held = run.dispatcher.assign(request, run.progress.latest_version, 0.0)
        with run.store.transaction():
            run.remove_actor(name)
            run.save()
    return {command.id for command in held}


def test_command_that_kills_its_actors_stops_the_run(
    make_run: MakeRun, reopened: MakeRun, caplog: pytest.LogCaptureFixture
) -> None:
    run = make_run(max_env_steps=20)
    assert vanish(run, "a", "b", "c") == {0, 1, 2, 3}
    assert "command 3 was held by 3 actors that vanished and is now run alone" in caplog.text
    assert vanish(run, "d", "e") == {0}
    before = run.progress.state
    assert vanish(run, "f") == {0}
    assert (before, run.progress.state) == ("running", "failed")
    assert run.progress.problem == (
        "command 0 failed 3 times, 3 of them by ending an actor that ran nothing else: its "
        "environment hangs or crashes; reproduce it with: udrl reproduce "
        f"{run.store.run_dir} 0"
    )
    run = reopened(run)
    finish(run)
    assert result(run) == reference(0, 20)


def test_command_that_failed_on_one_actor_only_does_not_stop_the_run_when_it_leaves(
    make_run: MakeRun,
) -> None:
    run = make_run(max_env_steps=20)
    run.dispatcher.join(join("healthy"), 0.0)
    for _ in range(3):
        fail(run, 2, "broken")
    run.dispatcher.join(join("broken"), 0.0)
    again = CommandsRequest(actor="broken", wanted=0, running=(2,))
    run.dispatcher.assign(again, run.progress.latest_version, 0.0)
    with run.store.transaction():
        run.remove_actor("broken")
        run.save()
    assert run.progress.state == "running"
    assert run.dispatcher.outstanding[2].ended == []
    finish(run)
    assert result(run) == reference(0, 20)


@pytest.mark.parametrize("reported_last", [True, False])
def test_failed_run_has_the_causes_of_all_attempts(reported_last: bool, make_run: MakeRun) -> None:
    run = make_run()
    if not reported_last:
        fail(run, 0, "x")
    assert vanish(run, "a", "b", "c", "d") == {0}
    assert vanish(run, "e") == {0}
    if reported_last:
        fail(run, 0, "f")
    cause = "no more fuel" if reported_last else "its environment hangs or crashes"
    assert run.progress.problem == (
        "command 0 failed 3 times, 2 of them by ending an actor that ran nothing else: "
        f"{cause}; reproduce it with: udrl reproduce {run.store.run_dir} 0"
    )


def test_removal_of_an_unknown_actor_has_no_effect(make_run: MakeRun) -> None:
    run = make_run()
    run.remove_actor("stranger")
    assert run.progress.state == "running"


def test_read_only_run_writes_nothing(make_run: MakeRun, tmp_path: Path) -> None:
    run = make_run(max_env_steps=20)
    finish(run)
    with closing(Store(tmp_path, read_only=True)) as store:
        looked_at = RunState(store, Budget(max_env_steps=1000))
        assert looked_at.progress == run.progress
        assert result(looked_at) == result(run)
