"""``udrl.train``."""

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import udrl
from udrl.errors import ConfigError, RunFailed, StoreError, UdrlError
from udrl_inspect.agents import load_agent
from udrl_inspect.exporting import export_folder
from udrl_inspect.inspection import read_status
from udrl_launch import api
from udrl_proto.reports import EvaluationStatus, IterationStatus, Status
from udrl_replay.creation import create_run
from udrl_replay.reporting import history
from udrl_replay.store import Store
from whole_run import SMALL, digests, small

SETTINGS: dict[str, Any] = {k: v for k, v in SMALL.items() if k != "environment"}


def test_training_equals_that_of_the_command(run: Callable[..., Status], tmp_path: Path) -> None:
    seen: list[Status] = []
    trained = udrl.train(
        "CartPole-v1", run_dir=tmp_path / "api", preset="none", callbacks=seen.append,
        max_env_steps=3000, actors=1, **SETTINGS,
    )  # fmt: skip
    assert digests(trained.status) == digests(run(small(), 3000))
    assert seen[-1] == trained.status
    assert trained.status.state == "ended"
    assert trained.run_dir == tmp_path / "api"
    trained_policy = trained.policy
    seen_now = [0.0, 0.1, 0.0, -0.1]
    assert trained_policy.logits(seen_now, 50.0, 50).tolist() == (
        load_agent(tmp_path / "api").policy.logits(seen_now, 50.0, 50).tolist()
    )


def test_callback_stops_a_run_that_can_be_resumed(
    run: Callable[..., Status], tmp_path: Path
) -> None:
    def stop(status: Status) -> bool:
        return status.iteration < 2

    others: list[int] = []
    stopped = udrl.train(
        "CartPole-v1", run_dir=tmp_path / "run", preset="none", max_env_steps=10_000_000,
        callbacks=[stop, lambda status: others.append(status.iteration)], **SETTINGS,
    )  # fmt: skip
    assert stopped.status.state == "stopped"
    assert stopped.status.ended_because == "stopped on request"
    assert others
    budget = stopped.status.env_steps + 1000
    ended = udrl.train("CartPole-v1", run_dir=tmp_path / "run", resume=True, max_env_steps=budget)
    assert digests(ended.status) == digests(run(small(), budget))


def test_events_are_passed_once_and_in_order(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    iterations: list[IterationStatus] = []
    evaluations: list[EvaluationStatus] = []
    ends: list[Status] = []
    given: dict[str, Any] = {
        "run_dir": run_dir, "on_iteration": iterations.append, "on_evaluation": evaluations.append,
        "on_end": ends.append,
    }  # fmt: skip
    first = udrl.train("CartPole-v1", preset="none", max_env_steps="3K", **given, **SETTINGS)
    assert ends == [first.status]
    assert [i.iteration for i in iterations] == list(range(first.status.iteration + 1))
    last = udrl.train("CartPole-v1", resume=True, max_env_steps=4500, **given)
    assert ends == [first.status, last.status]
    assert [i.iteration for i in iterations] == list(range(last.status.iteration + 1))
    with closing(Store(run_dir, read_only=True)) as store:
        found = history(store, -1)
    # Exactly the rows of the store, from before and after the resumption.
    assert iterations == list(found.iterations)
    assert evaluations == list(found.evaluations)


def test_run_stopped_in_its_warm_up_reports_all_iterations_on_resume(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    create_run(run_dir, small()).close()
    seen: list[int] = []
    udrl.train(
        "CartPole-v1", run_dir=run_dir, resume=True, max_env_steps=500,
        on_iteration=lambda iteration: seen.append(iteration.iteration),
    )  # fmt: skip
    assert seen[:2] == [0, 1]


def test_failed_run_calls_on_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RunFailed("an environment crashed")

    create_run(tmp_path / "run", small()).close()
    monkeypatch.setattr(api, "run_training", fail)
    ends: list[Status] = []
    with pytest.raises(RunFailed, match="crashed"):
        udrl.train("CartPole-v1", run_dir=tmp_path / "run", resume=True, on_end=ends.append)
    assert len(ends) == 1


def test_exception_of_a_callback_stops_the_run_without_on_end(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    ends: list[Status] = []

    def broken(iteration: IterationStatus) -> None:
        raise ZeroDivisionError

    create_run(run_dir, small()).close()
    with pytest.raises(ZeroDivisionError):
        udrl.train(
            "CartPole-v1", run_dir=run_dir, resume=True, on_iteration=broken, on_end=ends.append
        )
    assert (ends, read_status(run_dir).state) == ([], "stopped")


@pytest.mark.parametrize("false", [False, np.False_])
@pytest.mark.parametrize("event", ["on_iteration", "on_evaluation"])
def test_event_callback_can_stop_a_run(event: str, false: Any, tmp_path: Path) -> None:
    seen: list[object] = []

    def stop(found: object) -> Any:
        seen.append(found)
        return false

    callback: dict[str, Any] = {event: stop}
    stopped = udrl.train(
        "CartPole-v1", run_dir=tmp_path / "run", preset="none", max_env_steps=50_000,
        **callback, **SETTINGS,
    )  # fmt: skip
    assert seen
    assert stopped.status.state == "stopped"


def test_run_directory_can_be_loaded(ended_run: Path, tmp_path: Path) -> None:
    policy, agent = udrl.load(ended_run), load_agent(ended_run)
    seen = [0.0, 0.1, 0.0, -0.1]
    assert policy.logits(seen, 50.0, 50).tolist() == agent.policy.logits(seen, 50.0, 50).tolist()
    assert policy.desired_return == agent.policy.desired_return
    best = udrl.load(str(ended_run), "best")
    assert best.behavior.weights.keys() == policy.behavior.weights.keys()
    export_folder(agent, ended_run, tmp_path / "agent")
    assert udrl.load(tmp_path / "agent").logits(seen, 50.0, 50).tolist() == (
        policy.logits(seen, 50.0, 50).tolist()
    )
    with pytest.raises(ConfigError, match="an exported agent has one version"):
        udrl.load(tmp_path / "agent", "best")
    with pytest.raises(ConfigError, match="expected latest, best or a version number"):
        udrl.load(ended_run, "newest")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="expected latest, best or a version number"):
        udrl.load(ended_run, 10**30)
    with pytest.raises(StoreError, match=r"is not kept in .*; choose latest, best or one"):
        udrl.load(ended_run, 10**6)


def test_run_that_ends_with_its_warm_up_has_no_agent(tmp_path: Path) -> None:
    trained = udrl.train("CartPole-v1", run_dir=tmp_path / "run", max_env_steps=1, **SETTINGS)
    assert trained.status.state == "ended"
    with pytest.raises(StoreError, match="nothing has been trained"):
        _ = trained.policy


def test_default_directory_is_created_in_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    trained = udrl.train(
        "Figure2-v0", max_env_steps=60, n_warm_up_episodes=5, n_episodes_per_iter=5,
        n_updates_per_iter=2, last_few=3, eval_episodes=2,
    )  # fmt: skip
    assert trained.run_dir.parent == tmp_path / "runs"
    assert (trained.run_dir / "run.sqlite").exists()


def test_invalid_arguments_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="did you mean 'batch_size'"):
        udrl.train("CartPole-v1", batchsize=3)
    with pytest.raises(ConfigError, match="resume needs run_dir"):
        udrl.train("CartPole-v1", resume=True)
    for given in ({"on_evaluation": 3}, {"on_end": ""}, {"callbacks": [print, None]}):
        with pytest.raises(ConfigError, match=f"^{next(iter(given))}: .* is not a function"):
            udrl.train("CartPole-v1", run_dir=tmp_path / "run", **given)
    with pytest.raises(UdrlError, match="cannot be created"):
        udrl.train("Nothing-v0", run_dir=tmp_path / "run")
