"""Environments that are nondeterministic, or have changed since a run was created."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import udrl
from tests.foreign.conventions import Plain, register
from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.commands import Command
from udrl.config import Config, build
from udrl.determinism import difference
from udrl.errors import Deceived, EnvironmentFault, OtherConfiguration
from udrl.streams import Purpose, stream_key
from udrl_inspect.inspection import read_status
from udrl_proto.messages import Hello
from udrl_proto.reports import Status
from udrl_replay.progress import RunProgress
from udrl_replay.resuming import resume
from udrl_replay.store import Store

SMALL: dict[str, Any] = {
    "preset": "none", "hidden": [8], "n_warm_up_episodes": 4, "n_episodes_per_iter": 2,
    "n_updates_per_iter": 2, "batch_size": 16, "replay_size": 10, "last_few": 2,
    "eval_episodes": 2, "eval_every": 1000, "actors": 1, "envs_per_actor": 2,
}  # fmt: skip


class Unseeded(Plain):
    def reset(self, **_: Any) -> Any:
        return super().reset(seed=None)


class Changing(Plain):
    """Eighty steps, of which those after ``late`` pay the current value of ``today``."""

    late, today = 0, 1.0

    def pay(self, action: Any) -> float:
        return float(action) * (self.today if self.t > self.late else 1.0)

    def over(self) -> bool:
        return self.t >= 80


class ChangingLate(Changing):
    late = 70


class Breaking(ChangingLate):
    """Fails after ``late`` steps while ``today`` is not 1, as often as ``failures`` says."""

    failures = 1000

    def pay(self, action: Any) -> float:
        if self.t > self.late and self.today != 1.0 and self.failures > 0:
            type(self).failures -= 1
            raise RuntimeError("no more steps today")
        return float(action)


def train(kind: type[Plain], run_dir: Path, **more: Any) -> Status:
    name = register(kind, max_steps=100)
    return udrl.train(name, run_dir=run_dir, **SMALL | {"max_env_steps": 400} | more).status


def test_run_of_an_unseeded_environment_resumes_with_other_actors(tmp_path: Path) -> None:
    train(Unseeded, tmp_path / "run")
    status = train(Unseeded, tmp_path / "run", resume=True, max_env_steps=800, actors=2)
    assert status.state == "ended"
    assert not status.exact
    assert "does not repeat an episode from its seed" in status.inexact_reason


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (Changing, "its first steps differ"),
        (ChangingLate, r"in episode \d+ the reward of step 7\d is 10, it was 1"),
    ],
)
def test_changed_environment_is_detected_on_resume(
    kind: type[Changing], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train(kind, tmp_path / "run")
    monkeypatch.setattr(kind, "today", 10.0)
    with pytest.raises(OtherConfiguration, match=rf"has changed .*{message}.*--allow-inexact"):
        train(kind, tmp_path / "run", resume=True, max_env_steps=800)
    assert read_status(tmp_path / "run").exact, (
        "no episode of the changed environment is in the run"
    )

    with closing(Store(tmp_path / "run", read_only=True)) as store:
        config = store.fact("hello", Hello).config
    resume(tmp_path / "run", config, allow_inexact=True).close()
    status = train(kind, tmp_path / "run", resume=True, max_env_steps=800)
    assert status.state == "ended"
    assert not status.exact
    assert "has changed" in status.inexact_reason


def test_environment_that_newly_raises_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train(Breaking, tmp_path / "run")
    monkeypatch.setattr(Breaking, "today", 10.0)
    raised = r"step\(\) raised RuntimeError: no more steps today \(test_determinism\.py, line \d+\)"
    with pytest.raises(
        OtherConfiguration, match=rf"has changed .* in episode \d+ {raised}.*--allow-inexact"
    ):
        train(Breaking, tmp_path / "run", resume=True, max_env_steps=800)

    # All environments may fail now and then.
    monkeypatch.setattr(Breaking, "failures", 2)
    assert train(Breaking, tmp_path / "run", resume=True, max_env_steps=800).exact

    monkeypatch.setattr(Breaking, "late", 7)
    monkeypatch.setattr(Breaking, "failures", 1000)
    with pytest.raises(EnvironmentFault, match=rf"{raised}; it did not fail when the run was"):
        train(Breaking, tmp_path / "run", resume=True, max_env_steps=1200)


def test_false_episode_is_reported_before_a_changed_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train(Changing, tmp_path / "run")
    with closing(Store(tmp_path / "run")) as store, store.transaction():
        progress = store.fact("progress", RunProgress)
        progress.deceived, progress.problem = True, "actor a1 delivered a false episode"
        store.set_fact("progress", progress)
    monkeypatch.setattr(Changing, "today", 10.0)
    with pytest.raises(Deceived, match="actor a1 delivered a false episode"):
        train(Changing, tmp_path / "run", resume=True, max_env_steps=800)


def test_difference_is_the_first_differing_step() -> None:
    config = build(Config, {"environment": register(Changing, max_steps=100)})
    command = Command(
        id=0, kind="warm_up", desired_return=0.0, desired_horizon=1, environment_seed=7,
        stream_key=stream_key(1, Purpose.EPISODE, 0, 0), weights_version=0, max_steps=90,
    )  # fmt: skip
    with closing(EpisodeGenerator(config, 1)) as generator:
        (episode,) = generate_episodes(generator, [command], None)

    def found(**changes: Any) -> str | None:
        return difference(config, replace(episode, **changes), 7, 90)

    def changed(values: Any, step: int) -> Any:
        copy = values.copy()
        copy[step] += 1
        return copy

    assert found() is None
    paid = episode.rewards[41]
    message = f"the reward of step 41 is {paid:g}, it was {paid + 1:g}"
    assert found(rewards=changed(episode.rewards, 41)) == message
    assert (
        found(observations=changed(episode.observations, 3)) == "the observation of step 3 differs"
    )
    assert found(terminated=False, truncated=True) == "step 79 differs in terminated or truncated"
    short = {name: getattr(episode, name)[:50] for name in ("observations", "actions", "rewards")}
    assert found(**short) == "step 49 differs in terminated or truncated"
    assert difference(config, episode, 8, 90) == "the observation of step 0 differs"
