"""Reports of a run: status, waits, and ``metrics.csv``."""

import csv
import math
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from tests.replay.synthetic import arrive, config, episode, finish, join, work
from udrl.config import Budget
from udrl.schedule import weights_version
from udrl_proto import verbs
from udrl_proto.codec import decode, encode
from udrl_proto.messages import CommandsRequest
from udrl_proto.reports import Contents, EvaluationStatus, History, IterationStatus, Status
from udrl_replay import reporting
from udrl_replay.dispatching import MOST_ACTORS
from udrl_replay.reporting import (
    MetricsFile,
    Throughput,
    contents,
    history,
    status,
)
from udrl_replay.run import StoredRun
from udrl_replay.store import COLUMNS

MakeRun = Callable[..., StoredRun]


def shown(run: StoredRun, now: float = 0.0) -> Status:
    return status(run, Throughput(), 0.0, now)


# Status.


def test_status_of_a_new_run_is_complete(make_run: MakeRun) -> None:
    seen = shown(make_run())
    assert (seen.state, seen.iteration, seen.env_steps) == ("running", 0, 0)
    assert (seen.buffer.episodes, seen.buffer.return_mean) == (0, None)
    assert (seen.weights_version, seen.weights_sha256, seen.loss) == (0, "", None)
    assert (seen.evaluation, seen.final_evaluation, seen.time_left_s) == (None, None, None)
    assert seen.commands.outstanding == seen.commands.issued == config().commands.n_warm_up_episodes
    assert seen.useful_concurrency == config().commands.n_episodes_per_iter
    assert decode(encode(seen), Status) == seen


def test_useful_concurrency_grows_with_the_lead(make_run: MakeRun) -> None:
    assert shown(make_run(lead=3)).useful_concurrency == 4 * config().commands.n_episodes_per_iter


def test_status_of_an_ended_run_has_the_reason(make_run: MakeRun) -> None:
    run = make_run(lead=1, max_env_steps=40)
    finish(run)
    seen = shown(run)
    returns = [e.episode_return for e in run.buffer.best(run.config.buffer.replay_size)]
    version = run.store.version(run.progress.iteration)
    final = run.store.last_evaluation(is_final=True)
    assert version is not None
    assert final is not None
    assert seen.state == "ended"
    assert seen.weights_version == seen.iteration == run.progress.iteration
    assert seen.weights_sha256 == version.digest.hex()
    assert seen.loss == version.loss
    assert (seen.buffer.return_min, seen.buffer.return_max) == (returns[0], returns[-1])
    assert seen.buffer.return_mean == math.fsum(returns) / len(returns)
    assert seen.final_evaluation is not None
    assert seen.final_evaluation.mean == final.evaluation.mean
    assert seen.evaluation is not None
    assert seen.time_left_s is None
    assert decode(encode(seen), Status) == seen


def test_status_lists_actors_by_their_last_request(make_run: MakeRun) -> None:
    run = make_run(max_env_steps=1000)
    work(run)
    work(run)
    for name in ("b", "a"):
        run.dispatcher.join(join(name, environments=4), 10.0)
    request = CommandsRequest(actor="a", wanted=2, env_steps_per_s=12.34, weights_version=1)
    assigned = run.dispatcher.assign(request, run.progress.latest_version, 11.0)
    seen = shown(run, now=13.5)
    first, second = seen.actors
    assert (first.id, first.environments, first.running) == ("a", 4, len(assigned))
    assert (first.env_steps_per_s, first.last_seen_s) == (12.3, 2.5)
    assert first.weights_lag == run.progress.latest_version - 1
    assert (second.id, second.running, second.last_seen_s) == ("b", 0, 3.5)
    assert seen.weights_lag == second.weights_lag == run.progress.latest_version


def test_status_counts_duplicates_and_rejected_episodes(make_run: MakeRun) -> None:
    run = make_run()
    command = next(iter(run.dispatcher.outstanding.values())).command
    for _ in range(3):
        run.accept(arrive(episode(command, b"")), 0.0)
    run.progress.delivered += 1
    run.reject("a wrong one")
    seen = shown(run).episodes
    assert (seen.delivered, seen.accepted, seen.duplicate, seen.rejected) == (4, 1, 2, 1)


def test_largest_status_is_within_its_limit(
    make_run: MakeRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run()
    wide = "\U00020000"  # four bytes in UTF-8
    for number in range(MOST_ACTORS):
        name = f"{number:-<100}"
        host, large = wide * 4000, 2**62
        run.dispatcher.join(replace(join(name, 65_536), host=host), 0.0)
        actor = run.dispatcher.actors[name]
        actor.request = CommandsRequest(
            actor=name, wanted=0, env_steps_per_s=1e300, weights_version=large
        )
        actor.reruns = actor.failures = large
        run.waits.begin(
            f"learner {name}", "actors", f"iteration {large}: no actor is connected", 0.0
        )
    run.quarantined.reasons = {f"{number:-<100}": wide * 1000 for number in range(1000)}
    run.progress.problem = run.progress.inexact_reason = wide * 5000
    monkeypatch.setattr(run.store, "versions_kept", lambda: range(2**40, 2**40 + 100_000))
    seen = status(run, Throughput(), 0.0, 1e-3)
    data = encode(seen)
    assert len(data) < verbs.STATUS.reply_limit
    assert decode(data, Status, verbs.STATUS.reply_limit) == seen
    assert len(seen.actors) == len(seen.waiting) == MOST_ACTORS


def test_replay_digest_covers_order_and_content(make_run: MakeRun) -> None:
    run = make_run()
    before = shown(run).replay_sha256
    work(run)
    after = shown(run).replay_sha256
    assert before != after
    first = next(iter(run.buffer)).id
    run.digests[first] = bytes(32)
    assert shown(run).replay_sha256 not in (before, after)


# Throughput.


def test_throughput_is_the_mean_of_ten_seconds() -> None:
    throughput = Throughput()
    for second in range(21):
        throughput.add(float(second), 100)
    assert throughput.per_second(20.0) == pytest.approx(110.0)


def test_throughput_decreases_without_episodes() -> None:
    throughput = Throughput()
    assert throughput.per_second(0.0) == 0.0
    throughput.add(0.0, 100)
    assert throughput.per_second(10.0) > 0.0
    assert throughput.per_second(10.1) == 0.0


def test_throughput_of_the_first_moment_is_finite() -> None:
    throughput = Throughput()
    throughput.add(5.0, 100)
    assert throughput.per_second(5.0) == 100.0


def test_unobserved_throughput_forgets_old_episodes() -> None:
    throughput = Throughput()
    for second in range(1000):
        throughput.add(float(second), 100)
    assert len(throughput._arrivals) == 11
    assert throughput.per_second(999.0) == pytest.approx(110.0)


# metrics.csv.


def lines(run_dir: Path) -> list[dict[str, str]]:
    with (run_dir / "metrics.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write_metrics(run: StoredRun, run_dir: Path) -> None:
    with closing(MetricsFile(run_dir, run.store)) as metrics:
        metrics.update(run.progress.iteration)


def test_every_iteration_has_one_row(make_run: MakeRun, tmp_path: Path) -> None:
    run = make_run(lead=1, max_env_steps=60)
    with closing(MetricsFile(tmp_path, run.store)) as metrics:
        assert (tmp_path / "metrics.csv").read_text() == ",".join(COLUMNS) + "\n"
        while run.progress.state != "ended":
            work(run)
            metrics.update(run.progress.iteration)
            metrics.update(run.progress.iteration)
            assert len(lines(tmp_path)) == run.progress.iteration + 1
    found = lines(tmp_path)
    assert [int(line["iteration"]) for line in found] == list(range(run.progress.iteration + 1))
    assert int(found[-1]["env_steps"]) == run.progress.env_steps
    assert all(tuple(line) == COLUMNS for line in found)


def test_row_of_an_evaluated_iteration_has_the_evaluation(
    make_run: MakeRun, tmp_path: Path
) -> None:
    run = make_run(max_env_steps=60)
    finish(run)
    write_metrics(run, tmp_path)
    evaluation = run.store.last_evaluation(is_final=False)
    assert evaluation is not None
    found = lines(tmp_path)
    line = found[evaluation.iteration]
    assert float(line["eval_mean"]) == evaluation.evaluation.mean
    assert float(line["eval_ci95_low"]) == evaluation.evaluation.ci95_low
    # The evaluated weights were trained on the previous buffer, whose env steps the row has.
    before = found[int(line["weights_version"]) - 1]
    assert line["eval_at_env_steps"] == before["env_steps"]
    assert found[0]["eval_mean"] == found[0]["loss"] == ""


def test_metrics_of_a_resumed_run_equal_those_of_an_uninterrupted_one(
    make_run: MakeRun, reopened: MakeRun, tmp_path: Path
) -> None:
    run = make_run(lead=2, max_env_steps=30)
    finish(run)
    write_metrics(run, tmp_path)
    before = lines(tmp_path)
    run = reopened(run, Budget(max_env_steps=60))
    finish(run)
    write_metrics(run, tmp_path)
    after = lines(tmp_path)
    assert after[: len(before)] == before
    assert len(after) == run.progress.iteration + 1


# History and contents, for plots.


def test_history_equals_the_metrics(make_run: MakeRun, tmp_path: Path) -> None:
    run = make_run(lead=1, max_env_steps=60)
    finish(run)
    write_metrics(run, tmp_path)
    found = history(run.store, -1)
    assert decode(encode(found), History) == found
    assert not found.more
    assert len(found.iterations) == len(lines(tmp_path))
    for line, row in zip(lines(tmp_path), found.iterations, strict=True):
        for name, value in msgspec.structs.asdict(row).items():
            assert line[name] == ("" if value is None else str(value))
    means = [line["eval_mean"] for line in lines(tmp_path) if line["eval_mean"]]
    assert [str(e.mean) for e in found.evaluations] == means
    assert found.iterations[0].commanded_min is None
    assert all(
        r.commanded_min is not None and r.commanded_max is not None and
        r.commanded_min <= r.commanded_max for r in found.iterations[1:]
    )  # fmt: skip
    assert 0 < sum(r.admitted for r in found.iterations) <= run.progress.accepted


def test_history_is_paginated(make_run: MakeRun, monkeypatch: pytest.MonkeyPatch) -> None:
    run = make_run(max_env_steps=60)
    finish(run)
    whole = history(run.store, -1)
    monkeypatch.setattr(reporting, "HISTORY_PAGE", 3)
    iterations: list[IterationStatus] = []
    evaluations: list[EvaluationStatus] = []
    after, more = -1, True
    while more:
        page = history(run.store, after)
        assert len(page.iterations) <= 3
        iterations += page.iterations
        evaluations += page.evaluations
        after, more = page.iterations[-1].iteration, page.more
    assert (tuple(iterations), tuple(evaluations)) == (whole.iterations, whole.evaluations)
    assert history(run.store, after) == History(iterations=(), evaluations=(), more=False)


def test_contents_have_the_buffer_and_the_commands_drawn_from_it(make_run: MakeRun) -> None:
    run = make_run(lead=1)
    empty = contents(run)
    assert (empty.returns, empty.desired_return, empty.desired_horizon) == ((), None, None)
    for _ in range(4):
        work(run)
    found = contents(run)
    assert decode(encode(found), Contents) == found
    assert found.iteration == run.progress.iteration
    shown = list(zip(found.returns, found.lengths, found.iterations, strict=True))
    assert shown == [(e.episode_return, e.length, e.iteration) for e in run.buffer]
    best = run.buffer.best(run.config.commands.last_few)
    mean = math.fsum(e.episode_return for e in best) / len(best)
    assert found.desired_return == pytest.approx(mean)
    assigned = [
        (o.command.desired_return, o.command.desired_horizon)
        for o in run.dispatcher.outstanding.values() if o.command.kind == "explore"
    ]  # fmt: skip
    assert assigned
    assert list(zip(found.desired_returns, found.desired_horizons, strict=True)) == assigned
    assert set(found.versions) == set(run.store.versions_kept())


def test_large_buffers_are_sampled_evenly(
    make_run: MakeRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run()
    for _ in range(3):
        work(run)
    monkeypatch.setattr(reporting, "MOST_SHOWN", 3)
    found = contents(run)
    returns = [e.episode_return for e in run.buffer]
    assert len(returns) > 3
    assert len(found.returns) <= 3
    assert found.returns[-1] == returns[-1], "the best episode must be included"
    assert list(found.returns) == sorted(found.returns)


def test_evaluated_weights_are_kept(make_run: MakeRun, reopened: MakeRun) -> None:
    run = make_run(lead=1, max_env_steps=200)
    finish(run)
    evaluated = {weights_version(e.iteration, 1) for e in run.store.evaluations(-1, 2**62)}
    assert len(evaluated) > 3
    assert evaluated <= set(run.store.versions_kept())
    again = reopened(run, Budget(max_env_steps=300))
    finish(again)
    assert evaluated < set(again.store.versions_kept())
