"""The page is enough: an actor that was written from it gives the same bits and serves a run."""

import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zenoh

from tests.proto import stranger
from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.algorithm1 import algorithm1
from udrl.behavior import initialise
from udrl.commands import Command, Kind
from udrl.config import Budget, Config
from udrl.digests import episode_digest
from udrl.environments import EnvironmentSpec
from udrl.numerics import acting_class
from udrl.streams import Purpose, stream_key
from udrl_learner.service import LearnerService
from udrl_proto.session import find_run
from udrl_replay.creation import create
from udrl_replay.service import ReplayService

CONFIG = Config(
    environment="CartPole-v1",
    max_return=20.0,
    seed=3,
    lead=0,
    batch_size=32,
    hidden=(16, 8),
    last_few=4,
    n_episodes_per_iter=3,
    n_updates_per_iter=2,
    n_warm_up_episodes=4,
    replay_size=8,
    eval_every=100,
    eval_episodes=2,
)


@pytest.fixture
def generator() -> Iterator[EpisodeGenerator]:
    made = EpisodeGenerator(CONFIG, 3)
    yield made
    made.close()


def hello(config: Config, spec: EnvironmentSpec) -> dict[str, Any]:
    plain = {"config": config, "environment": spec}
    return {name: msgspec.to_builtins(value) for name, value in plain.items()}


@pytest.mark.parametrize("baseline", ["none", "value"])
@pytest.mark.parametrize("initialisation", ["orthogonal", "uniform"])
@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_probe_has_the_same_digest(activation: Any, initialisation: Any, baseline: Any) -> None:
    config = msgspec.structs.replace(
        CONFIG, activation=activation, initialisation=initialisation, baseline=baseline
    )
    generator = EpisodeGenerator(config, 1)
    assert stranger.numerics_class(hello(config, generator.spec)) == (
        acting_class(config, generator)
    )
    generator.close()


@pytest.mark.parametrize(
    ("kind", "version", "temperature", "hold_steps"),
    [
        ("warm_up", 0, 1.0, 0), ("explore", 1, 1.0, 0), ("explore", 1, 1.0, 3),
        ("evaluate", 1, 0.3, 0), ("evaluate", 1, 0.0, 0),
    ],
)  # fmt: skip
def test_episode_has_the_same_bytes(
    kind: Kind, version: int, temperature: float, hold_steps: int, generator: EpisodeGenerator
) -> None:
    commands = [
        Command(
            id=index,
            kind=kind,
            desired_return=30.0,
            desired_horizon=10,
            environment_seed=1_000_000 + index,
            stream_key=stream_key(7, Purpose.EPISODE, 1, index),
            weights_version=version,
            max_steps=25,
            temperature=temperature,
            hold_from=4,
            hold_steps=hold_steps,
        )
        for index in range(5)
    ]
    behavior = initialise(CONFIG, generator.spec) if version else None
    weights = behavior.state_dict() if behavior is not None else None
    for ours in generate_episodes(generator, commands, behavior):
        command = msgspec.to_builtins(commands[ours.command_id], builtin_types=(bytes,))
        theirs = stranger.run_episode(command, hello(CONFIG, generator.spec), weights)
        assert stranger.episode_digest(ours.command_id, theirs) == episode_digest(ours)


def test_actor_written_from_the_page_serves_a_run(
    router: zenoh.Session, client: zenoh.Session, tmp_path: Path
) -> None:
    budget = Budget(max_env_steps=300)
    stop = threading.Event()
    with ExitStack() as stack:
        store = create(tmp_path, CONFIG)
        stack.callback(store.close)
        service = ReplayService(router, store, budget, tmp_path)
        serving = threading.Thread(target=service.serve, args=[stop])
        serving.start()
        stack.callback(serving.join)
        stack.callback(stop.set)
        learner = LearnerService(client, find_run(client, None, 5.0), "learner-1", stop)
        training = threading.Thread(target=learner.run)
        training.start()
        stack.callback(training.join)
        delivered = stranger.act(client)
        expected = algorithm1(CONFIG, budget)
        progress = service.run.progress
        assert (progress.accepted, progress.rejected) == (delivered, 0)
        assert (progress.iteration, progress.env_steps) == (expected.iteration, expected.env_steps)
        version = store.version(progress.latest_version)
        assert version is not None
        assert version.digest.hex() == expected.weights_sha256
