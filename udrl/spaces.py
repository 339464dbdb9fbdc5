"""What observations are to the algorithm: plain arrays of a few kinds.

What is stored and sent is compact: an index stays an index, a frame a frame. An encoder
(:mod:`udrl.encoders`, :mod:`udrl.graph`) makes features of each kind.
"""

import math
from typing import Annotated, Any

import msgspec
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from msgspec import Meta

from udrl.streams import Stream

#: float32 of vectors, uint8 of images, int32 of categories.
Observations = npt.NDArray[np.float32] | npt.NDArray[np.uint8] | npt.NDArray[np.int32]

#: Each has a vector of its own in the network.
MOST_CATEGORIES = 2**20

Size = Annotated[int, Meta(ge=1, le=2**20)]


class Space(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind"):
    """A set of arrays of one shape and dtype."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Of one of them."""
        raise NotImplementedError

    @property
    def dtype(self) -> np.dtype[Any]:
        """How they are stored and sent."""
        raise NotImplementedError

    @property
    def n_bytes(self) -> int:
        """Of one of them."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def gymnasium(self) -> spaces.Space[Any]:
        """A Gymnasium space of the same elements."""
        raise NotImplementedError

    def fault(self, values: npt.NDArray[Any], n: int) -> str | None:
        """Say in what way an array is not ``n`` elements of the space, or None."""
        expected = (n, *self.shape)
        if values.dtype != self.dtype or values.shape != expected:
            return f"{values.dtype} {values.shape}, expected {self.dtype} {expected}"
        return self._impossible(values)

    def _impossible(self, values: npt.NDArray[Any]) -> str | None:
        return None


class Indices(Space, frozen=True):
    """The whole numbers from 0 on, below ``n``."""

    n: Annotated[int, Meta(ge=1, le=2**31 - 1)]

    @property
    def shape(self) -> tuple[int, ...]:
        """[]."""
        return ()

    @property
    def gymnasium(self) -> spaces.Space[Any]:
        """``Discrete``."""
        return spaces.Discrete(self.n)

    def _impossible(self, values: npt.NDArray[Any]) -> str | None:
        if values.size == 0:
            return None
        least, greatest = int(values.min()), int(values.max())
        if least >= 0 and greatest < self.n:
            return None
        return f"from {least} to {greatest}, expected 0 to {self.n - 1}"


class Vector(Space, frozen=True, tag="vector"):
    """Numbers, float32 [size]."""

    size: Size

    @property
    def shape(self) -> tuple[int, ...]:
        """[size]."""
        return (self.size,)

    @property
    def dtype(self) -> np.dtype[Any]:
        """float32."""
        return np.dtype(np.float32)

    @property
    def gymnasium(self) -> spaces.Space[Any]:
        """A ``Box`` without bounds."""
        return spaces.Box(-np.inf, np.inf, self.shape, np.float32)

    def _impossible(self, values: npt.NDArray[Any]) -> str | None:
        return None if np.isfinite(values).all() else "not all finite numbers"


class Image(Space, frozen=True, tag="image"):
    """Bytes, uint8 [channels, height, width]."""

    channels: Size
    height: Size
    width: Size

    @property
    def shape(self) -> tuple[int, ...]:
        """[channels, height, width]."""
        return (self.channels, self.height, self.width)

    @property
    def dtype(self) -> np.dtype[Any]:
        """uint8."""
        return np.dtype(np.uint8)

    @property
    def gymnasium(self) -> spaces.Space[Any]:
        """A ``Box`` of bytes."""
        return spaces.Box(0, 255, self.shape, np.uint8)


class Category(Indices, frozen=True, tag="category"):
    """One of ``n``, an index from 0 on, int32 []."""

    n: Annotated[int, Meta(ge=1, le=MOST_CATEGORIES)]

    @property
    def dtype(self) -> np.dtype[Any]:
        """int32."""
        return np.dtype(np.int32)


ObservationSpace = Vector | Image | Category


def observation_space(space: spaces.Space[Any]) -> ObservationSpace:
    """Return what the algorithm calls an environment's observations, once they are plain."""
    if isinstance(space, spaces.Discrete):
        return Category(n=int(space.n))
    assert isinstance(space, spaces.Box)
    if len(space.shape) == 1:
        return Vector(size=space.shape[0])
    channels, height, width = space.shape
    return Image(channels=channels, height=height, width=width)


def noise(stream: Stream, dtype: np.dtype[Any], shape: tuple[int, ...]) -> Observations:
    """Return observations made of the next numbers of a stream.

    float32 in [-2, 2), bytes, or index 0, which every category has.
    """
    numbers = stream.uniforms(math.prod(shape)).reshape(shape)
    if dtype == np.uint8:
        return (numbers * 256).astype(np.uint8)
    if dtype == np.int32:
        return np.zeros(shape, np.int32)
    return (numbers * 4 - 2).astype(np.float32)
