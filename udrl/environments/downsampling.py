"""Downsampling of images by area averaging, with the same bits on every machine."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from udrl.environments.conversions import as_array, leaves_within, with_dtype
from udrl.environments.observation_conversions import channel_axis, is_image
from udrl.errors import InvalidData, UnsupportedEnvironment

Pixels = npt.NDArray[np.uint8]


class Downsample(gym.ObservationWrapper[Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Downsamples the images of observations, also those in a ``Dict`` or ``Tuple``.

    Values that are not in the environment's space are returned unchanged, and then refused by
    :class:`udrl.environments.adapter.Adapter`.

    Args:
        env: any environment.
        height: height of the smaller images in pixels, at most that of the environment's.
        width: width of the smaller images in pixels, likewise.

    Raises:
        UnsupportedEnvironment: there is no image, or this size does not fit.
    """

    def __init__(self, env: gym.Env[Any, Any], height: int, width: int) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, height=height, width=width)
        gym.ObservationWrapper.__init__(self, env)
        if height < 1 or width < 1:
            raise UnsupportedEnvironment(
                f"{height} x {width} pixels after downsampling; expected at least 1 x 1"
            )
        self._size = height, width
        self._averages: dict[tuple[int, ...], AreaAverage] = {}
        if not any(is_image(leaf) for _, leaf in leaves_within(env.observation_space)):
            raise UnsupportedEnvironment(
                f"its observations are {env.observation_space}, without an image; expected a Box "
                f"of uint8 with two or three dimensions"
            )
        self.observation_space = self._smaller_space(env.observation_space)

    def observation(self, observation: Any) -> Any:
        """Return the observation with smaller images."""
        return self._smaller(self.env.observation_space, observation)

    def _smaller_space(self, space: spaces.Space[Any]) -> spaces.Space[Any]:
        match space:
            case spaces.Dict():
                return spaces.Dict([(k, self._smaller_space(s)) for k, s in space.spaces.items()])
            case spaces.Tuple():
                return spaces.Tuple([self._smaller_space(inner) for inner in space.spaces])
            case spaces.Box() if is_image(space):
                return self._smaller_image(space)
        return space

    def _smaller_image(self, space: spaces.Box) -> spaces.Box:
        axis, (height, width) = channel_axis(space), self._size
        size = tuple(n for i, n in enumerate(space.shape) if i != axis)
        if size[0] < height or size[1] < width:
            raise UnsupportedEnvironment(
                f"an image has {size[0]} x {size[1]} pixels; expected at least {height} x {width}, "
                f"the size after downsampling; choose a smaller height or width"
            )
        shape = list(self._size)
        if axis is not None:
            shape.insert(axis, space.shape[axis])
        smaller = spaces.Box(0, 255, tuple(shape), np.uint8)
        if channel_axis(smaller) != axis:
            raise UnsupportedEnvironment(
                f"an image would have {height} x {width} pixels; expected more than its "
                f"{shape[axis or 0]} channels; choose a larger size"
            )
        self._averages[space.shape] = AreaAverage(size[0], size[1], height, width)
        return smaller

    def _smaller(self, space: spaces.Space[Any], value: Any) -> Any:
        match space:
            case spaces.Dict() if isinstance(value, Mapping):
                return {
                    key: self._smaller(space[key], inner) if key in space.spaces else inner
                    for key, inner in value.items()
                }
            case spaces.Tuple() if isinstance(value, tuple) and len(value) == len(space):
                pairs = zip(space.spaces, value, strict=True)
                return tuple(self._smaller(inner, part) for inner, part in pairs)
            case spaces.Box() if is_image(space) and (pixels := _pixels(value, space)) is not None:
                average = self._averages[space.shape]
                if channel_axis(space) == 0:
                    return np.moveaxis(average(np.moveaxis(pixels, 0, -1)), -1, 0)
                return average(pixels)
        return value


def _pixels(value: Any, space: spaces.Box) -> Pixels | None:
    """Return a value as an image of the space, as without this wrapper; None: it is none."""
    try:
        array = as_array("observation", value)
    except InvalidData:
        return None
    return with_dtype(array, np.dtype(np.uint8)) if array.shape == space.shape else None


class AreaAverage:
    """Averages the pixels that each pixel of a smaller image covers.

    A partly covered pixel is weighted by its covered part. The sums are exact, so the result does
    not depend on the processor; it is rounded to the nearest integer, halves up.

    Args:
        height, width: size of the input.
        to_height, to_width: size of the output, at most that of the input.
    """

    def __init__(self, height: int, width: int, to_height: int, to_width: int) -> None:
        self._area = height * width
        # Sums are at most 255 times the area; rounding doubles them and adds the area.
        exact = np.int32 if 511 * self._area < 2**31 else np.int64
        self._rows = _covered(height, to_height, exact)
        self._columns = _covered(width, to_width, exact)

    def __call__(self, image: Pixels) -> Pixels:
        """Return the smaller image.

        Args:
            image: uint8 [height, width] or [height, width, channels].

        Returns:
            uint8 [to_height, to_width] or [to_height, to_width, channels].
        """
        # Not a matrix product: BLAS threads spin while they wait for each other, and deadlock when
        # an environment in another thread starts a process.
        rows, shares = self._rows
        sums = np.einsum("kj,kj...->j...", shares, image[rows])
        columns, shares = self._columns
        sums = np.einsum("kj,ikj...->ij...", shares, sums[:, columns])
        out: Pixels = ((2 * sums + self._area) // (2 * self._area)).astype(np.uint8)
        return out


def _covered(
    size: int, to_size: int, exact: type[np.signedinteger[Any]]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[Any]]:
    """Return the pixels that each output pixel covers, and their weights, [most, to_size] each.

    Output pixels that cover fewer than ``most`` pixels also have neighbours of weight 0.
    """
    shares = _shares(size, to_size)
    most = int((shares > 0).sum(axis=1).max())
    first = np.minimum((shares > 0).argmax(axis=1), size - most)
    pixels = first + np.arange(most)[:, None]
    return pixels, shares[np.arange(to_size), pixels].astype(exact)


def _shares(size: int, to_size: int) -> npt.NDArray[np.int64]:
    """Return the overlaps of ``to_size`` output pixels and ``size`` pixels, [to_size, size].

    The unit makes all overlaps integers: a pixel is ``to_size`` long, an output pixel ``size``.
    """
    pixel = np.arange(size) * to_size
    larger = np.arange(to_size)[:, None] * size
    overlap = np.minimum(pixel + to_size, larger + size) - np.maximum(pixel, larger)
    shares: npt.NDArray[np.int64] = np.maximum(overlap, 0)
    return shares
