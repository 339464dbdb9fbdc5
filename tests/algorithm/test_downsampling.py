"""Area averages, and the wrapper that downsamples an environment's images."""

from fractions import Fraction
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st

from udrl.environments import Downsample
from udrl.environments.downsampling import AreaAverage
from udrl.errors import UnsupportedEnvironment


class Camera(gym.Env[Any, Any]):
    """Returns one observation forever."""

    action_space = spaces.Discrete(2)

    def __init__(self, space: spaces.Space[Any], observation: Any = None) -> None:
        self.observation_space = space
        space.seed(1)
        self.shown = space.sample() if observation is None else observation

    def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        return self.shown, {}


def image(*shape: int) -> spaces.Box:
    return spaces.Box(0, 255, shape, np.uint8)


def downsampled(camera: Camera, height: int = 4, width: int = 5) -> Any:
    env = Downsample(camera, height, width)
    observation, _ = env.reset()
    assert env.observation_space.contains(observation)
    return observation


@pytest.mark.parametrize(
    ("shape", "smaller"),
    [((12, 10), (4, 5)), ((12, 10, 3), (4, 5, 3)), ((3, 12, 10), (3, 4, 5))],
)
def test_images_are_downsampled_wherever_their_channels_are(
    shape: tuple[int, ...], smaller: tuple[int, ...]
) -> None:
    camera = Camera(image(*shape))
    found = downsampled(camera)
    assert found.shape == smaller
    if len(shape) == 3:
        axis = shape.index(3)
        for channel in range(3):
            plane = camera.shown.take(channel, axis)
            assert found.take(channel, axis).tolist() == area_average(plane, 4, 5)
    else:
        assert found.tolist() == area_average(camera.shown, 4, 5)


def test_images_within_other_spaces_are_downsampled_and_the_rest_is_not() -> None:
    space = spaces.Dict(
        screen=image(8, 10, 3), pair=spaces.Tuple([image(4, 5), spaces.Discrete(3)]),
        health=spaces.Box(0, 1, (2,)),
    )  # fmt: skip
    camera = Camera(space)
    found = downsampled(camera)
    assert found["screen"].shape == (4, 5, 3)
    assert np.array_equal(found["pair"][0], camera.shown["pair"][0])
    assert found["pair"][1] == camera.shown["pair"][1]
    assert np.array_equal(found["health"], camera.shown["health"])


@pytest.mark.parametrize(
    ("space", "returned"),
    [
        (image(8, 10), np.zeros((9, 10), np.uint8)),
        (image(8, 10), np.full((8, 10), 0.5)),
        (image(8, 10), np.full((8, 10), 256)),
        (image(8, 10), [[1], [2, 3]]),
        (image(8, 10), None),
        (spaces.Dict(a=image(8, 10)), np.zeros((8, 10), np.uint8)),
        (spaces.Tuple([image(8, 10)]), ()),
    ],
)
def test_invalid_observations_are_returned_unchanged(
    space: spaces.Space[Any], returned: Any
) -> None:
    env = Downsample(Camera(space), 4, 5)
    assert env.observation(returned) is returned


@pytest.mark.parametrize("kind", [np.int64, np.float32, list])
def test_images_of_other_types_are_converted(kind: Any) -> None:
    pixels = np.arange(80, dtype=np.uint8).reshape(8, 10)
    env = Downsample(Camera(image(8, 10)), 4, 5)
    given = pixels.tolist() if kind is list else pixels.astype(kind)
    np.testing.assert_array_equal(env.observation(given), env.observation(pixels))


def test_unknown_keys_are_kept() -> None:
    env = Downsample(Camera(spaces.Dict(a=image(8, 10))), 4, 5)
    found = env.observation({"b": 1})
    assert found == {"b": 1}


@pytest.mark.parametrize(
    ("space", "size", "message"),
    [
        (spaces.Box(0, 1, (8, 10)), (4, 5), "without an image"),
        (image(8, 10, 3), (9, 5), "8 x 10 pixels; expected at least 9 x 5"),
        (image(8, 10, 3), (3, 3), "3 x 3 pixels; expected more than its 3 channels"),
        (image(8, 10), (0, 5), "expected at least 1 x 1"),
    ],
)
def test_impossible_sizes_are_refused(
    space: spaces.Space[Any], size: tuple[int, int], message: str
) -> None:
    with pytest.raises(UnsupportedEnvironment, match=message):
        Downsample(Camera(space), *size)


def area_average(shown: npt.NDArray[np.uint8], height: int, width: int) -> list[list[int]]:
    """The area average as exact fractions."""

    def share(i: int, size: int, j: int, to_size: int) -> Fraction:
        low = max(Fraction(i, size), Fraction(j, to_size))
        return max(Fraction(0), min(Fraction(i + 1, size), Fraction(j + 1, to_size)) - low)

    def pixel(row: int, column: int) -> int:
        total = sum(
            int(shown[y, x])
            * share(y, shown.shape[0], row, height)
            * share(x, shown.shape[1], column, width)
            for y in range(shown.shape[0])
            for x in range(shown.shape[1])
        )
        return int(total * height * width + Fraction(1, 2))

    return [[pixel(row, column) for column in range(width)] for row in range(height)]


@settings(deadline=None, max_examples=40)
@given(st.data())
def test_area_average_is_exact(data: st.DataObject) -> None:
    height, width = data.draw(st.integers(1, 9)), data.draw(st.integers(1, 9))
    to_height, to_width = data.draw(st.integers(1, height)), data.draw(st.integers(1, width))
    pixels = data.draw(st.binary(min_size=height * width, max_size=height * width))
    shown = np.frombuffer(pixels, np.uint8).reshape(height, width)
    found = AreaAverage(height, width, to_height, to_width)(shown)
    assert found.tolist() == area_average(shown, to_height, to_width)


def test_area_average_of_colours_and_of_large_images() -> None:
    rng = np.random.default_rng(1)
    shown = rng.integers(0, 256, (480, 640, 3)).astype(np.uint8)
    found = AreaAverage(480, 640, 60, 80)(shown)
    blocks = shown.astype(np.int64).reshape(60, 8, 80, 8, 3).sum(axis=(1, 3))
    assert np.array_equal(found, (2 * blocks + 64) // 128)


def test_area_average_of_more_pixels_than_32_bits_can_sum() -> None:
    shown = np.full((2100, 2100), 255, np.uint8)
    assert AreaAverage(2100, 2100, 2, 3)(shown).tolist() == [[255] * 3] * 2
