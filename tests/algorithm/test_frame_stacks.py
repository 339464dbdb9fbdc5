"""Stacked frames: the inputs in acting and in training are bit-identical."""

import math
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.commands import Command
from udrl.config import Config, build
from udrl.environments import make_environment, specify
from udrl.episode import Episode
from udrl.experience import Experience
from udrl.frame_stack import FrameStack
from udrl.graph import acting_graph
from udrl.inference import ActingFunction, Call, probe_weights
from udrl.segments import Segments
from udrl.spaces import Category, Image, ObservationSpace, Vector
from udrl.streams import Purpose, stream_key

STACK = 4


class Noise(gym.Env[npt.NDArray[np.uint8], np.int64]):
    """Random observations, for a number of steps that the seed determines."""

    metadata = {"render_modes": []}

    def __init__(self, shape: tuple[int, ...] = (5, 6, 3)) -> None:
        self.render_mode = None
        self.observation_space = gym.spaces.Box(0, 255, shape, np.uint8)
        self.action_space = gym.spaces.Discrete(3)
        self._left = 0

    def _observe(self) -> npt.NDArray[np.uint8]:
        shape = self.observation_space.shape
        assert shape is not None
        return self.np_random.integers(0, 256, shape).astype(np.uint8)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self._left = (seed or 0) % 7 * 23 + 1
        return self._observe(), {}

    def step(self, action: np.int64) -> Any:
        self._left -= 1
        return self._observe(), 1.0, self._left == 0, False, {}


class Vectors(Noise):
    def __init__(self) -> None:
        super().__init__((2,))
        self.observation_space = gym.spaces.Box(0, 255, (2,), np.float32)  # type: ignore[assignment]


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    gym.register("Noise-v0", entry_point=lambda **_: Noise(), max_episode_steps=5000)
    gym.register("NoiseVectors-v0", entry_point=lambda **_: Vectors(), max_episode_steps=5000)
    yield
    for name in ("Noise-v0", "NoiseVectors-v0"):
        del gym.registry[name]


def settings(environment: str = "Noise-v0", **values: Any) -> Config:
    small = {
        "environment": environment, "frame_stack": STACK, "convolutions": [4, 6], "hidden": [8, 8],
        "replay_size": 20, "last_few": 5,
    }  # fmt: skip
    return build(Config, small | values)


class RecordingGraph(ActingFunction):
    """Records its inputs."""

    def __init__(self, graph: bytes) -> None:
        super().__init__(graph, probe_weights(graph))
        self.seen: list[npt.NDArray[Any]] = []

    def call(self, n: int) -> Call:
        return _RecordingCall(super().call(n), self.seen)


class _RecordingCall:
    def __init__(self, call: Call, seen: list[npt.NDArray[Any]]) -> None:
        self.seen, self.command, self.logits = call.seen, call.command, call.logits
        self.state, self.next_state = call.state, call.next_state
        self._call = call
        self._noted = seen

    def run(self) -> None:
        self._noted.extend(self.seen[0].copy())
        self._call.run()


def record_inputs(
    config: Config, n_environments: int, n: int
) -> tuple[list[Episode], RecordingGraph]:
    generator = EpisodeGenerator(config, n_environments)
    behavior = RecordingGraph(acting_graph(config.network, generator.spec))
    commands = [
        Command(
            id=i,
            kind="explore",
            desired_return=3.0,
            desired_horizon=5,
            environment_seed=i + 1,
            stream_key=stream_key(1, Purpose.EPISODE, 1, i),
            weights_version=1,
            max_steps=5000,
        )
        for i in range(n)
    ]
    return generate_episodes(generator, commands, behavior), behavior


def test_first_observation_fills_the_stack() -> None:
    memory = FrameStack(Vector(size=2), 4)
    times = memory.times(np.array([0, 2, 9]))
    assert times.tolist() == [[0, 0, 0, 0], [0, 0, 1, 2], [6, 7, 8, 9]]


@pytest.mark.parametrize(
    ("space", "shape"),
    [
        (Vector(size=2), (8,)),
        (Image(channels=3, height=5, width=6), (12, 5, 6)),
        (Category(n=7), (4,)),
    ],
)
def test_observations_are_stacked_along_the_first_dimension(
    space: ObservationSpace, shape: tuple[int, ...]
) -> None:
    memory = FrameStack(space, 4)
    assert memory.shapes == (shape,)
    n = math.prod(space.shape)
    each = np.arange(2 * 4 * n).astype(space.dtype).reshape(2, 4, *space.shape)
    (joined,) = memory.join(each)
    assert joined.shape == (2, *shape)
    assert joined.ravel().tolist() == each.ravel().tolist()


@pytest.mark.parametrize("environment", ["Noise-v0", "NoiseVectors-v0"])
@pytest.mark.parametrize("capacity", [1024, 8])
def test_acting_and_training_have_equal_inputs(
    environment: str, capacity: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "udrl.recording._FIRST_CAPACITY", capacity
    )  # 8: the ring wraps around and grows
    config = settings(environment)
    episodes, behavior = record_inputs(config, 3, 12)
    acted_on = {image.tobytes() for image in behavior.seen}
    spec = specify(make_environment(config), config)
    experience = Experience(config, spec)
    for episode in episodes:
        experience.add(episode)
    ranked = experience.by_rank([e.command_id for e in episodes])
    trained_on = set()
    for rank, episode in enumerate(episodes):
        t = np.arange(episode.length)
        examples = ranked.examples(Segments(np.full_like(t, rank), t, np.full_like(t, len(t))))
        (seen,) = examples.seen
        assert (seen.shape[1:],) == FrameStack(
            spec.observation_space, config.network.frame_stack
        ).shapes
        for i, stack in enumerate(seen):
            frames = [episode.observations[max(0, i - k)] for k in range(STACK)[::-1]]
            assert np.array_equal(stack, np.concatenate(frames)), f"step {i}"
            trained_on.add(stack.tobytes())
    assert acted_on == trained_on
    assert len(trained_on) == sum(e.length for e in episodes)


def test_image_channels_come_first() -> None:
    env = make_environment(settings())
    raw = gym.make("Noise-v0", disable_env_checker=True)
    image, _ = env.reset(seed=4)
    expected, _ = raw.reset(seed=4)
    assert image.shape == (3, 5, 6)
    assert np.array_equal(image, np.moveaxis(expected, -1, 0))
    space = specify(env, settings()).observation_space
    assert space == Image(channels=3, height=5, width=6)


@pytest.mark.parametrize(
    ("shape", "seen"), [((5, 6), (1, 5, 6)), ((3, 5, 6), (3, 5, 6)), ((5, 6, 4), (4, 5, 6))]
)
def test_position_of_the_channels_is_detected(
    shape: tuple[int, ...], seen: tuple[int, ...]
) -> None:
    config = settings(environment_kwargs={})
    gym.register("Shaped-v0", entry_point=lambda **_: Noise(shape), max_episode_steps=9)
    try:
        env = make_environment(build(Config, {"environment": "Shaped-v0"}))
        assert env.reset(seed=1)[0].shape == specify(env, config).observation_space.shape == seen
    finally:
        del gym.registry["Shaped-v0"]


def test_stack_of_one_is_the_observation() -> None:
    config = settings(frame_stack=1)
    episodes, behavior = record_inputs(config, 2, 3)
    frames = {frame.tobytes() for e in episodes for frame in e.observations}
    assert {image.tobytes() for image in behavior.seen} == frames
    assert episodes[0].observations.dtype == np.uint8
