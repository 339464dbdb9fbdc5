"""An actor that delivers false episodes is identified among honest ones."""

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import udrl_actor.outbox
from udrl.config import Budget
from udrl.episode import Episode
from udrl.errors import Deceived, UdrlError
from udrl_inspect.inspection import status_of
from udrl_launch.settings import Fleet, Settings
from udrl_launch.training_run import run_training
from udrl_proto.codec import encode_episode
from udrl_proto.reports import Status
from whole_run import assert_conserved, digests, toy

BUDGET = 600
FLEET = Fleet(actors=3, envs_per_actor=2)


def test_honest_actors_agree_and_the_result_is_unchanged(run: Callable[..., Status]) -> None:
    audited = run(toy(lead=2), BUDGET, actors=3, audit=0.5)
    assert audited.audit.rate == 0.5
    assert audited.audit.agreed > 20
    assert audited.audit.disputed == 0
    assert audited.quarantined == ()
    assert audited.exact
    assert_conserved(audited)
    assert digests(audited) == digests(run(toy(lead=2), BUDGET))


def test_false_episode_fails_the_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    false_actors: list[str] = []
    lock = threading.Lock()

    def deliver_false(episode: Episode, actor: str) -> bytes:
        with lock:
            if not false_actors:
                false_actors.append(actor)
        if actor == false_actors[0]:
            episode = replace(episode, rewards=episode.rewards + 1)
        return encode_episode(episode, actor)

    monkeypatch.setattr(udrl_actor.outbox, "encode_episode", deliver_false)
    settings = Settings(toy(lead=2), Budget(max_env_steps=100 * BUDGET), FLEET)

    def train(*, resume: bool) -> None:
        run_training(settings, tmp_path / "run", threading.Event(), in_process=True, audit=1.0,
              resume=resume)  # fmt: skip

    with pytest.raises(UdrlError, match=r"false episode|quarantined"):
        train(resume=False)
    status = status_of(tmp_path / "run")
    assert status.state == "failed"
    assert [actor.id for actor in status.quarantined] == false_actors
    assert f"actor {false_actors[0]} delivered a false episode" in status.problem
    assert_conserved(status)
    with pytest.raises(Deceived, match=false_actors[0]):
        train(resume=True)
