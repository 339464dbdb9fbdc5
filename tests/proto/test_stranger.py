"""``proto/README.md`` suffices to write an actor: same bits, and it serves a run."""

import ast
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import gymnasium as gym
import msgspec
import numpy as np
import numpy.typing as npt
import pytest
import zenoh

from tests.proto import stranger
from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.algorithm1 import algorithm1
from udrl.commands import Command
from udrl.config import Budget, Config, build, change, flat
from udrl.determinism import environment_digest
from udrl.digests import episode_digest
from udrl.environments import EnvironmentSpec
from udrl.graph import acting_graph
from udrl.inference import ActingFunction
from udrl.numerics import acting_class
from udrl.streams import Purpose, stream_key
from udrl.training import untrained
from udrl_learner.learner_service import LearnerService
from udrl_proto.session import find_run
from udrl_proto.zenoh_transport import ZenohTransport
from udrl_replay.creation import create_run
from udrl_replay.replay_service import ReplayService

CONFIG = build(
    Config,
    {
        "environment": "CartPole-v1",
        "max_return": 20.0,
        "seed": 3,
        "lead": 0,
        "batch_size": 32,
        "hidden": [16, 8],
        "last_few": 4,
        "n_episodes_per_iter": 3,
        "n_updates_per_iter": 2,
        "n_warm_up_episodes": 4,
        "warm_up_hold_steps": 3,
        "replay_size": 8,
        "eval_every": 100,
        "eval_episodes": 2,
    },
)


@pytest.fixture
def generator() -> Iterator[EpisodeGenerator]:
    made = EpisodeGenerator(CONFIG, 3)
    yield made
    made.close()


class Pixels(gym.Env[npt.NDArray[np.uint8], np.int64]):
    """Two channels of noise that depends on the last action."""

    observation_space = gym.spaces.Box(0, 255, (9, 8, 2), np.uint8)
    action_space = gym.spaces.Discrete(3)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.uint8], dict[str, Any]]:
        super().reset(seed=seed)
        return self._look(0), {}

    def step(
        self, action: np.int64
    ) -> tuple[npt.NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        return self._look(int(action)), float(action) / 3, False, False, {}

    def _look(self, action: int) -> npt.NDArray[np.uint8]:
        return self.np_random.integers(0, 200, (9, 8, 2), np.uint8) + np.uint8(action)


@pytest.fixture
def pixels() -> Iterator[str]:
    """The id of an environment with image observations."""
    gym.register("Pixels-v0", entry_point=lambda **_: Pixels(), max_episode_steps=20)
    yield "Pixels-v0"
    del gym.registry["Pixels-v0"]


def test_stranger_imports_nothing_from_udrl() -> None:
    tree = ast.parse(Path(stranger.__file__).read_text(encoding="utf-8"))
    imported = {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
    imported |= {str(n.module) for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    packages = {name.partition(".")[0] for name in imported} - sys.stdlib_module_names
    assert packages == {
        "gymnasium", "msgpack", "numpy", "onnx", "onnxruntime", "safetensors", "zenoh",
    }  # fmt: skip


def hello(config: Config, spec: EnvironmentSpec) -> dict[str, Any]:
    return {
        "config": flat(config),
        "environment": msgspec.to_builtins(spec),
        "graph": acting_graph(config.network, spec),
    }


def assert_same_class(config: Config) -> None:
    generator = EpisodeGenerator(config, 1)
    run_hello = hello(config, generator.spec)
    assert stranger.numerics_class(run_hello) == acting_class(
        run_hello["graph"], generator.spec.action_space
    )
    assert stranger.environment_digest(run_hello) == environment_digest(generator)
    generator.close()


@pytest.mark.parametrize("frame_stack", [1, 3])
@pytest.mark.parametrize("equal", [False, True])
@pytest.mark.parametrize("baseline", ["none", "value"])
@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_probe_has_equal_digests(
    activation: Any, baseline: Any, equal: bool, frame_stack: int
) -> None:
    assert_same_class(
        change(
            CONFIG, activation=activation, baseline=baseline, horizon_equals_return=equal,
            frame_stack=frame_stack,
        )
    )  # fmt: skip


@pytest.mark.parametrize("baseline", ["none", "value"])
def test_probe_of_images_has_equal_digests(baseline: Any, pixels: str) -> None:
    assert_same_class(
        change(CONFIG, environment=pixels, baseline=baseline, convolutions=(4, 6), frame_stack=2)
    )


@pytest.mark.parametrize(
    ("version", "more"),
    [
        (0, {"random_steps": 25}), (0, {"random_steps": 25, "random_hold": 4}), (1, {}),
        (1, {"random_from": 4, "random_steps": 3, "random_hold": 3}), (1, {"cap": 9.0}),
        (1, {"random_rate": 0.4}), (1, {"random_rate": 0.3, "random_hold": 2}),
        (1, {"temperature": 0.3}), (1, {"temperature": 0.0}),
    ],
)  # fmt: skip
def test_episode_has_equal_bytes(
    version: int, more: dict[str, Any], generator: EpisodeGenerator
) -> None:
    assert_same_episodes(CONFIG, generator, version, more)


@pytest.mark.parametrize(
    ("environment", "settings"),
    [
        ("Nested", {}),
        ("Nested", {"frame_stack": 3, "baseline": "value", "normalise_observations": True}),
        ("Nested", {"memory": "gru", "baseline": "value", "action_bins": 4}),
        ("Reach", {}),
        ("Reach", {"memory": "gru", "memory_size": 5, "frame_stack": 2}),
    ],
)
def test_every_kind_of_space_has_equal_class_and_bytes(
    environment: str, settings: dict[str, Any]
) -> None:
    config = change(
        CONFIG, environment=f"kinds_of_spaces:{environment}-v0", convolutions=(4,), **settings
    )
    assert_same_class(config)
    generator = EpisodeGenerator(config, 2)
    for version, more in ((0, {"random_steps": 25}), (1, {}), (1, {"random_rate": 0.3})):
        assert_same_episodes(config, generator, version, more)
    generator.close()


def assert_same_episodes(
    config: Config, generator: EpisodeGenerator, version: int, more: dict[str, Any]
) -> None:
    commands = [
        Command(
            id=index,
            kind="explore",
            desired_return=30.0,
            desired_horizon=10,
            environment_seed=1_000_000 + index,
            stream_key=stream_key(7, Purpose.EPISODE, 1, index),
            weights_version=version,
            max_steps=25,
            **more,
        )
        for index in range(5)
    ]
    run_hello = hello(config, generator.spec)
    behavior = network = None
    if version:
        weights = untrained(config, generator.spec).weights
        behavior = ActingFunction(run_hello["graph"], weights)
        network = stranger.Network(run_hello["graph"], weights)
    for ours in generate_episodes(generator, commands, behavior):
        command = msgspec.to_builtins(commands[ours.command_id], builtin_types=(bytes,))
        theirs = stranger.run_episode(command, run_hello, network)
        assert stranger.episode_digest(ours.command_id, theirs) == episode_digest(ours)


def test_stranger_serves_a_run(
    router: zenoh.Session, client: zenoh.Session, tmp_path: Path
) -> None:
    budget = Budget(max_env_steps=300)
    stop = threading.Event()
    with ExitStack() as stack:
        store = create_run(tmp_path, CONFIG)
        stack.callback(store.close)
        service = ReplayService(ZenohTransport(router), store, budget, tmp_path)
        stack.callback(service.close)
        serving = threading.Thread(target=service.serve, args=[stop])
        serving.start()
        stack.callback(serving.join)
        stack.callback(stop.set)
        learner = LearnerService(
            ZenohTransport(client), find_run(client, None, 5.0), "learner-1", stop
        )
        training = threading.Thread(target=learner.run)
        training.start()
        stack.callback(training.join)
        delivered = stranger.act(client)
        assert delivered > 0
        expected = algorithm1(CONFIG, budget)
        progress = service.run.progress
        assert (progress.accepted, progress.rejected) == (delivered, 0)
        assert (progress.iteration, progress.env_steps) == (expected.iteration, expected.env_steps)
        version = store.version(progress.latest_version)
        assert version is not None
        assert version.digest.hex() == expected.weights_sha256
