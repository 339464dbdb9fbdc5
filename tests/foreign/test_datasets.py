"""Datasets have the observations and actions of their environment."""

import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from tests.foreign.conventions import Plain, register
from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.commands import Command
from udrl.config import Config, build
from udrl.datasets import dataset_digest, read_dataset, write_dataset
from udrl.environments import make_environment, specify
from udrl.errors import ConfigError
from udrl.streams import Purpose, stream_key


class ActsFromOne(Plain):
    action_space = spaces.Discrete(3, start=1)


class ShowsStates(Plain):
    observation_space = spaces.Discrete(20, start=-5)

    def seen(self) -> Any:
        return self.t - 5


class ShowsPictures(Plain):
    observation_space = spaces.Box(0, 255, (6, 5, 3), np.uint8)

    def seen(self) -> Any:
        return np.arange(90, dtype=np.uint8).reshape(6, 5, 3) + np.uint8(self.t)


class ShowsGrey(Plain):
    observation_space = spaces.Box(0, 255, (6, 5), np.uint8)

    def seen(self) -> Any:
        return np.arange(30, dtype=np.uint8).reshape(6, 5) + np.uint8(self.t)


KINDS = [Plain, ActsFromOne, ShowsStates, ShowsPictures, ShowsGrey]


@pytest.fixture(autouse=True)
def _datasets(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))


def config(kind: type[Plain]) -> Config:
    return build(Config, {"environment": register(kind)})


def record(kind: type[Plain], actions: list[int]) -> EpisodeBuffer:
    """Record an episode in the environment itself, without udrl."""
    env = gym.make(register(kind), disable_env_checker=True)
    start = int(env.action_space.start)  # type: ignore[attr-defined]
    parts: dict[str, list[Any]] = {
        "observations": [env.reset(seed=7)[0]], "actions": [], "rewards": [], "terminations": [],
        "truncations": [],
    }  # fmt: skip
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action + start)
        for name, value in zip(
            parts, (observation, action + start, reward, terminated, truncated), strict=True
        ):
            parts[name].append(value)
    return EpisodeBuffer(id=0, **parts)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_dataset_of_an_environment_equals_acting_in_it(kind: type[Plain]) -> None:
    settings = config(kind)
    generator = EpisodeGenerator(settings, 1)
    command = Command(
        id=0, kind="warm_up", desired_return=0.0, desired_horizon=1, environment_seed=7,
        stream_key=stream_key(1, Purpose.EPISODE, 0, 0), weights_version=0, max_steps=50,
    )  # fmt: skip
    (ours,) = generate_episodes(generator, [command], None)
    env = gym.make(register(kind), disable_env_checker=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        minari.create_dataset_from_buffers(
            "some/theirs-v0", [record(kind, ours.actions.tolist())], jpeg_encoding=False,
            observation_space=env.observation_space, action_space=env.action_space,
        )  # fmt: skip
    found = read_dataset("some/theirs-v0", settings, generator.spec)
    assert dataset_digest(found) == dataset_digest([ours])

    # The exported dataset equals the environment's own, including its name.
    write_dataset("some/ours-v0", [ours], settings, generator.spec)
    written = minari.load_dataset("some/ours-v0")
    assert written.observation_space == env.observation_space
    assert written.action_space == env.action_space
    (theirs,), (again,) = minari.load_dataset("some/theirs-v0"), written
    assert np.array_equal(theirs.observations[:-1], again.observations[:-1])
    assert np.array_equal(theirs.actions, again.actions)
    found = read_dataset("some/ours-v0", settings, generator.spec)
    assert dataset_digest(found) == dataset_digest([ours])
    generator.close()


def test_dataset_has_the_id_of_its_environment() -> None:
    settings = build(Config, {"environment": "Obedience-v0", "environment_kwargs": {"steps": 4}})
    generator = EpisodeGenerator(settings, 1)
    command = Command(
        id=0, kind="warm_up", desired_return=0.0, desired_horizon=1, environment_seed=7,
        stream_key=stream_key(1, Purpose.EPISODE, 0, 0), weights_version=0, max_steps=4,
    )  # fmt: skip
    write_dataset(
        "some/ours-v0", generate_episodes(generator, [command], None), settings, generator.spec
    )
    recovered = minari.load_dataset("some/ours-v0").recover_environment()
    assert recovered.spec is not None
    assert (recovered.spec.id, recovered.spec.kwargs["steps"]) == ("Obedience-v0", 4)


def test_dataset_of_other_spaces_is_rejected() -> None:
    write_dataset("some/ours-v0", [], config(ShowsStates), _spec(ShowsStates))
    with pytest.raises(ConfigError, match=r"Discrete\(20, start=-5\).*Vector\(size=2\)"):
        read_dataset("some/ours-v0", config(Plain), _spec(Plain))


def _spec(kind: type[Plain]) -> Any:
    return specify(make_environment(config(kind)), config(kind))
