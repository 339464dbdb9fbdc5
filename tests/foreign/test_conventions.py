"""Return values of environments are checked wherever environments are used."""

import logging
from pathlib import Path

import numpy as np
import pytest

from tests.foreign.conventions import BORNE, REFUSED, ClosesWithAnError, Plain, ShowsNan, register
from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.commands import Command
from udrl.config import Config, build
from udrl.environments import make_environment
from udrl.episode import Episode
from udrl.errors import EnvironmentFault, UdrlError
from udrl.streams import Purpose, stream_key
from udrl_replay.creation import create_run

COMMAND = Command(
    id=0, kind="warm_up", desired_return=0.0, desired_horizon=1, environment_seed=7,
    stream_key=stream_key(1, Purpose.EPISODE, 0, 0), weights_version=0, max_steps=50,
)  # fmt: skip


def config(kind: type[Plain]) -> Config:
    return build(Config, {"environment": register(kind)})


def episode(kind: type[Plain]) -> Episode:
    generator = EpisodeGenerator(config(kind), 1)
    (found,) = generate_episodes(generator, [COMMAND], None)
    generator.close()
    return found


@pytest.mark.parametrize("kind", BORNE, ids=lambda kind: kind.__name__)
def test_unambiguous_conventions_are_accepted(kind: type[Plain]) -> None:
    found, expected = episode(kind), episode(Plain)
    assert found.observations.tolist() == expected.observations.tolist()
    assert found.observations.dtype == expected.observations.dtype
    assert found.rewards.tolist() == expected.rewards.tolist()
    assert (found.terminated, found.truncated) == (True, False)


@pytest.mark.parametrize("kind", REFUSED, ids=lambda kind: kind.__name__)
def test_ambiguous_conventions_are_rejected_when_a_run_is_created(
    kind: type[Plain], tmp_path: Path
) -> None:
    came, declared = REFUSED[kind]
    with pytest.raises(UdrlError) as refusal:
        create_run(tmp_path / "run", config(kind))
    assert isinstance(refusal.value, EnvironmentFault)
    assert came in str(refusal.value)
    assert declared in str(refusal.value)
    assert not (tmp_path / "run").exists(), "no run must be created"


# Non-finite values are found when an episode is complete, and by the network's caller.
@pytest.mark.parametrize(
    "kind", [kind for kind in REFUSED if kind is not ShowsNan], ids=lambda kind: kind.__name__
)
def test_ambiguous_conventions_are_rejected_when_stepping_one_environment(
    kind: type[Plain],
) -> None:
    env = make_environment(config(kind))

    def ten_steps() -> None:
        env.reset(seed=7)
        for _ in range(10):
            env.step(1)

    with pytest.raises(EnvironmentFault):
        ten_steps()


def test_error_in_close_is_logged_and_ignored(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "udrl"):
        create_run(tmp_path / "run", config(ClosesWithAnError)).close()
    assert "failed in close(): AttributeError: 'NoneType' object" in caplog.text


def test_actions_have_the_type_of_the_space() -> None:
    taken = []

    class Watched(Plain):
        def pay(self, action: np.int64) -> float:
            taken.append(action)
            return 0.0

    episode(Watched)
    assert {type(action) for action in taken} == {np.int64}
