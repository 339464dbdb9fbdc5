"""Datasets: exported, read by Minari itself, and used to start a run."""

import re
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import minari
import numpy as np
import pytest
from click.testing import CliRunner
from minari.dataset._storages.hdf5_storage import HDF5Storage
from msgspec.structs import replace

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.actions import Categorical
from udrl.algorithm1 import algorithm1
from udrl.commands import CommandSampler
from udrl.config import Budget, Config
from udrl.datasets import dataset_digest, read_dataset, write_dataset
from udrl.environments.making import make_environment
from udrl.environments.specification import EnvironmentSpec, specify
from udrl.episode import Episode
from udrl.errors import ConfigError, OtherConfiguration
from udrl.spaces import Image, Leaf, Record, Vector
from udrl_inspect.inspection import read_status, settings_of
from udrl_launch.cli import cli as command_line
from udrl_launch.settings import Fleet, Settings
from udrl_launch.training_run import run_training
from udrl_proto.reports import Status
from udrl_replay.store import Store
from whole_run import digests, small

VECTOR = EnvironmentSpec(
    observation_space=Vector(size=4), action_space=Categorical(n=2), max_episode_steps=500
)
IMAGE = EnvironmentSpec(
    observation_space=Image(channels=1, height=12, width=10),
    action_space=Categorical(n=3),
    max_episode_steps=500,
)


@pytest.fixture(autouse=True)
def _datasets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))


def some_episodes(spec: EnvironmentSpec, lengths: tuple[int, ...] = (3, 9, 1)) -> list[Episode]:
    rng = np.random.default_rng(1)

    def observations(n: int) -> Any:
        shape = (n, *spec.observation_space.shape)
        if isinstance(spec.observation_space, Image):
            return rng.integers(0, 256, shape).astype(np.uint8)
        return rng.normal(size=shape).astype(np.float32)

    return [
        Episode(
            command_id=i,
            observations=observations(n),
            actions=rng.integers(0, spec.action_space.n_parameters, n).astype(np.uint8),
            rewards=rng.normal(size=n).astype(np.float32),
            terminated=i % 3 != 1,
            truncated=i % 3 != 0,
        )
        for i, n in enumerate(lengths)
    ]


@pytest.mark.parametrize("spec", [VECTOR, IMAGE], ids=["vector", "image"])
def test_dataset_round_trips_bit_identically(spec: EnvironmentSpec) -> None:
    episodes = some_episodes(spec)
    write_dataset("some/ours-v0", episodes, small(), spec)
    assert dataset_digest(read_dataset("some/ours-v0", small(), spec)) == dataset_digest(episodes)
    # As Minari itself reads it.
    for theirs, ours in zip(minari.load_dataset("some/ours-v0"), episodes, strict=True):
        assert theirs.observations[:-1].dtype == ours.observations.dtype
        assert (theirs.observations[:-1] == ours.observations).all()
        assert theirs.actions.tolist() == ours.actions.tolist()
        assert theirs.rewards.tolist() == ours.rewards.tolist()
        assert theirs.terminations.tolist()[-1] == ours.terminated
        assert theirs.truncations.tolist()[-1] == ours.truncated


@pytest.mark.parametrize(
    "settings",
    [
        {"environment": "kinds_of_spaces:Unsorted-v0"},
        {"environment": "kinds_of_spaces:Unsorted-v0", "observe_previous": True},
        {"observe_previous": True, "observe_time": True},
        {"environment": "Taxi-v4", "action_mask": "info"},
    ],
    ids=str,
)
def test_episodes_with_unsorted_keys_round_trip(settings: dict[str, Any]) -> None:
    config = small(**settings)
    with closing(EpisodeGenerator(config, 2)) as generator:
        commands = CommandSampler(config, generator.spec).warm_up()
        episodes = generate_episodes(generator, commands, None)
        write_dataset("some/ours-v0", episodes, config, generator.spec)
        found = read_dataset("some/ours-v0", config, generator.spec)
    assert dataset_digest(found) == dataset_digest(episodes)


@pytest.mark.parametrize(
    ("settings", "remedy"),
    [
        ({"observe_time": True}, "set observe_time = true, as in the run that exported it"),
        ({"observe_previous": True, "observe_time": True},
         "set observe_previous = true, observe_time = true, as"),
        ({"environment": "Taxi-v4", "action_mask": "info"}, "set action_mask = info, as"),
    ],
)  # fmt: skip
def test_dataset_with_more_observations_is_rejected_with_the_settings_that_it_needs(
    settings: dict[str, Any], remedy: str
) -> None:
    config = small(**settings)
    with closing(EpisodeGenerator(config, 2)) as generator:
        commands = CommandSampler(config, generator.spec).warm_up()[:2]
        episodes = generate_episodes(generator, commands, None)
        write_dataset("some/ours-v0", episodes, config, generator.spec)
    plain = small(environment=config.environment)
    with closing(make_environment(plain)) as env, pytest.raises(ConfigError, match=remedy):
        read_dataset("some/ours-v0", plain, specify(env, plain))


def test_existing_or_unknown_name_is_rejected() -> None:
    write_dataset("some/ours-v0", some_episodes(VECTOR), small(), VECTOR)
    with pytest.raises(ConfigError, match=r"already exists.*another name, or a new version"):
        write_dataset("some/ours-v0", some_episodes(VECTOR), small(), VECTOR)
    with pytest.raises(ConfigError, match=r"not found locally.*minari list local"):
        read_dataset("some/thing-v0", small(), VECTOR)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (replace(VECTOR, observation_space=Vector(size=5)),
         r"has observations Box.* and actions .* environment has Vector\(size=5\)"),
        (replace(VECTOR, action_space=Categorical(n=1)),
         r"and actions Discrete\(2\), .* and Categorical\(n=1\)"),
        (replace(VECTOR, max_episode_steps=8), r"has 9 steps, expected 1 to 8; .* max_train_steps"),
        (IMAGE, "name a dataset of the run's environment"),
    ],
)  # fmt: skip
def test_dataset_of_another_environment_is_rejected(spec: EnvironmentSpec, message: str) -> None:
    write_dataset("some/ours-v0", some_episodes(VECTOR), small(), VECTOR)
    with pytest.raises(ConfigError, match=message):
        read_dataset("some/ours-v0", small(), spec)


@pytest.mark.parametrize("key", ["a/b", "", ".", 0])
def test_key_that_files_of_datasets_cannot_store_is_rejected(key: Any, tmp_path: Path) -> None:
    inner = (Leaf(("eyes", key), Vector(size=2)), Leaf(("eyes", "other"), Vector(size=2)))
    spec = replace(VECTOR, observation_space=Record(inner))
    with pytest.raises(ConfigError, match=rf"cannot store the key {re.escape(repr(key))} of"):
        write_dataset("some/ours-v0", [], small(), spec)
    assert not (tmp_path / "datasets").exists()


@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()])
def test_interrupted_export_leaves_the_name_free(
    error: BaseException, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise error

    with monkeypatch.context() as patched:
        patched.setattr(HDF5Storage, "update_episodes", fails)
        with pytest.raises((ConfigError, KeyboardInterrupt)):
            write_dataset("some/ours-v0", some_episodes(VECTOR), small(), VECTOR)
    write_dataset("some/ours-v0", some_episodes(VECTOR), small(), VECTOR)
    assert len(list(minari.load_dataset("some/ours-v0"))) == 3


@pytest.mark.parametrize(
    "name", ["../../etc-v0", "bad name-v0", "mine", "", "/x-v0", "é-v0", "-x-v0"]
)
def test_name_that_minari_does_not_allow_is_rejected(name: str, tmp_path: Path) -> None:
    found = set(minari.list_local_datasets())
    with pytest.raises(ConfigError, match=r"a name with a version.*e\.g\. CartPole/mine-v0"):
        write_dataset(name, some_episodes(VECTOR), small(), VECTOR)
    assert set(minari.list_local_datasets()) == found, "no files must remain"


@pytest.fixture
def dataset(ended_run: Path) -> str:
    """The replay buffer of a run, exported by the command."""
    words = ["export", str(ended_run), "--minari", "CartPole/elite-v0"]
    result = CliRunner().invoke(command_line, words, standalone_mode=False, catch_exceptions=False)
    assert result.stdout.startswith("dataset: CartPole/elite-v0, ")
    return "CartPole/elite-v0"


def offline(dataset: str, **changes: object) -> Config:
    return small(dataset=dataset, lead=0, **changes)


def test_exported_dataset_equals_the_buffer(dataset: str, ended_run: Path) -> None:
    store = Store(ended_run, read_only=True)
    held = store.buffer(10**9)
    store.close()
    found = minari.load_dataset(dataset)
    assert [float(np.sum(e.rewards)) for e in found] == [p.entry.episode_return for p in held]


def test_run_starts_with_a_dataset(
    dataset: str, run: Callable[..., Status], tmp_path: Path
) -> None:
    config = offline(dataset)
    status = run(config, 3000, run_dir=tmp_path / "run")
    n = len(list(minari.load_dataset(dataset)))
    settings = settings_of(tmp_path / "run")
    assert settings["n_warm_up_episodes"] == n
    assert len(settings["dataset_sha256"]) == 64
    assert status.episodes.accepted >= n
    # The services equal the reference for any number of actors.
    assert digests(status) == digests(algorithm1(config, Budget(max_env_steps=3000)))
    assert digests(status) == digests(run(config, 3000, actors=2, envs=3))
    assert digests(status) != digests(run(small(lead=0), 3000))


def test_run_resumes_without_the_dataset(
    dataset: str, run: Callable[..., Status], tmp_path: Path
) -> None:
    config = offline(dataset)
    run(config, 2000, run_dir=tmp_path / "run")
    whole = digests(run(config, 4000))
    minari.delete_dataset(dataset)
    status = run(config, 4000, run_dir=tmp_path / "run", resume=True)
    assert digests(status) == whole


def test_changed_dataset_of_the_same_name_is_detected(dataset: str, tmp_path: Path) -> None:
    settings = Settings(offline(dataset, dataset_sha256="0" * 64), Budget(), Fleet())
    with pytest.raises(ConfigError, match=r"expected [0-9a-f]+; restore the dataset"):
        run_training(settings, tmp_path / "run", threading.Event(), in_process=True)


def test_run_with_another_dataset_is_another_configuration(
    dataset: str, run: Callable[..., Status], tmp_path: Path
) -> None:
    run(offline(dataset), 1000, run_dir=tmp_path / "run")
    assert read_status(tmp_path / "run").exact
    with pytest.raises(OtherConfiguration, match="dataset = 'CartPole/elite-v0', not None"):
        run(small(lead=0), 2000, run_dir=tmp_path / "run", resume=True)
