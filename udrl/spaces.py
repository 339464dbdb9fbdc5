"""Observation spaces of the algorithm: plain arrays of a few kinds, and records of them.

Observations are stored and sent in compact form: an index as one integer, a bit as a byte, a frame
as a single frame. An encoder (:mod:`udrl.encoders`, :mod:`udrl.graph`) computes features of each
kind. A record is one structured array, so code that only stores or forwards observations handles
all kinds alike.
"""

import functools
import math
from typing import Annotated, Any

import msgspec
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from msgspec import Meta

from udrl.streams import Stream

#: float32 for vectors, uint8 for images and bits, int32 for categories, structured for records.
Observations = npt.NDArray[Any]

#: Maximum number of categories. The network learns an embedding vector for each.
MAX_CATEGORIES = 2**20
#: Maximum number of leaves of a record.
MAX_LEAVES = 256

#: Maximum length of a key that is a string.
MAX_KEY_LENGTH = 200
#: Maximum number of numbers in an array of one dimension.
MAX_SIZE = 2**20

#: Key of a dictionary, or index in a tuple.
Key = Annotated[str, Meta(max_length=MAX_KEY_LENGTH)] | Annotated[int, Meta(ge=0, le=MAX_LEAVES)]

Size = Annotated[int, Meta(ge=1, le=MAX_SIZE)]


class Space(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind"):
    """A set of arrays of one shape and dtype."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of an element."""
        raise NotImplementedError

    @property
    def dtype(self) -> np.dtype[Any]:
        """Dtype of the elements, in memory, messages and stores."""
        raise NotImplementedError

    @property
    def n_bytes(self) -> int:
        """Size of an element in bytes."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def gymnasium(self) -> spaces.Space[Any]:
        """The Gymnasium space with the same elements."""
        raise NotImplementedError

    def fault(self, values: npt.NDArray[Any], n: int) -> str | None:
        """Return why an array is not ``n`` elements of the space; None: it is."""
        expected = (n, *self.shape)
        if values.dtype != self.dtype or values.shape != expected:
            return f"{values.dtype} {values.shape}, expected {self.dtype} {expected}"
        return self._invalid(values)

    def _invalid(self, values: npt.NDArray[Any]) -> str | None:
        """Return why values, of the right dtype and shape, are invalid; None: they are valid."""
        return None


class Indices(Space, frozen=True):
    """The integers from 0 to ``n`` - 1."""

    n: Annotated[int, Meta(ge=1, le=2**31 - 1)]

    @property
    def shape(self) -> tuple[int, ...]:
        """[]."""
        return ()

    @property
    def gymnasium(self) -> spaces.Space[Any]:
        """``Discrete``."""
        return spaces.Discrete(self.n)

    def _invalid(self, values: npt.NDArray[Any]) -> str | None:
        if values.size == 0:
            return None
        least, greatest = int(values.min()), int(values.max())
        if least >= 0 and greatest < self.n:
            return None
        return f"from {least} to {greatest}, expected 0 to {self.n - 1}"


class IndexVectors(Space, frozen=True):
    """Vectors of integers, component i from 0 to ``ns[i]`` - 1."""

    ns: Annotated[tuple[Annotated[int, Meta(ge=1, le=2**20)], ...], Meta(min_length=1)]

    @property
    def shape(self) -> tuple[int, ...]:
        """[components]."""
        return (len(self.ns),)

    @property
    def gymnasium(self) -> spaces.Space[Any]:
        """``MultiDiscrete``."""
        return spaces.MultiDiscrete(np.array(self.ns))

    def _invalid(self, values: npt.NDArray[Any]) -> str | None:
        for k, n in enumerate(self.ns):
            if found := Indices(n)._invalid(values[:, k]):
                return f"{found} in component {k}"
        return None


class Sized(Space, frozen=True):
    """Arrays of one dimension, with ``size`` numbers."""

    size: Size

    @property
    def shape(self) -> tuple[int, ...]:
        """[size]."""
        return (self.size,)


class Vector(Sized, frozen=True, tag="vector"):
    """Vectors of finite numbers, float32 [size]."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """float32."""
        return np.dtype(np.float32)

    @property
    def gymnasium(self) -> spaces.Space[Any]:
        """A ``Box`` without bounds."""
        return spaces.Box(-np.inf, np.inf, self.shape, np.float32)

    def _invalid(self, values: npt.NDArray[Any]) -> str | None:
        return None if np.isfinite(values).all() else "not all finite numbers"


class Bits(Sized, frozen=True, tag="bits"):
    """Vectors of zeros and ones, uint8 [size]."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """uint8."""
        return np.dtype(np.uint8)

    @property
    def gymnasium(self) -> spaces.Space[Any]:
        """``MultiBinary``."""
        return spaces.MultiBinary(self.size)

    def _invalid(self, values: npt.NDArray[Any]) -> str | None:
        return None if (values <= 1).all() else "not all 0 or 1"


class Image(Space, frozen=True, tag="image"):
    """Images, uint8 [channels, height, width]."""

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
    """One of ``n`` categories, an index from 0, int32 []."""

    n: Annotated[int, Meta(ge=1, le=MAX_CATEGORIES)]

    @property
    def dtype(self) -> np.dtype[Any]:
        """int32."""
        return np.dtype(np.int32)


class Categories(IndexVectors, frozen=True, tag="categories"):
    """Several categories, int32 [components]."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """int32."""
        return np.dtype(np.int32)


#: Spaces with an encoder of their own.
LeafSpace = Vector | Bits | Image | Category | Categories


class Leaf(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A part of a record.

    Attributes:
        path: keys of dictionaries and indices of tuples that lead to it, outermost first.
        space: space of its elements.
    """

    path: Annotated[tuple[Key, ...], Meta(max_length=16)]
    space: LeafSpace

    @property
    def name(self) -> str:
        """The path as a Python subscript of the observation, e.g. ``['inventory'][2]``."""
        return "".join(f"[{key!r}]" for key in self.path)

    def find(self, observation: Any) -> Any:
        """Return the leaf's value in an observation of the environment.

        Raises:
            LookupError: the observation does not contain it.
        """
        for key in self.path:
            try:
                observation = observation[key]
            except (TypeError, ValueError) as error:  # the type has no such keys
                raise LookupError(key) from error
        return observation


class Record(Space, frozen=True, tag="record"):
    """Several observations at once: Gymnasium's ``Dict`` and ``Tuple``, possibly nested.

    An element is a structure of its leaves, in order and without padding.
    """

    leaves: Annotated[tuple[Leaf, ...], Meta(min_length=1, max_length=MAX_LEAVES)]

    def __str__(self) -> str:
        return ", ".join(f"{leaf.name}: {leaf.space}" for leaf in self.leaves)

    def __post_init__(self) -> None:
        if len({leaf.name for leaf in self.leaves}) < len(self.leaves):
            raise ValueError("two leaves have the same name")

    @property
    def shape(self) -> tuple[int, ...]:
        """[]."""
        return ()

    @property
    def dtype(self) -> np.dtype[Any]:
        """A structure with one field per leaf, with its name, dtype and shape."""
        return _structure(self.leaves)

    @property
    def gymnasium(self) -> spaces.Space[Any]:
        """Dictionaries and tuples with the leaves at their paths."""
        return _nested([(leaf.path, leaf.space.gymnasium) for leaf in self.leaves])

    def _invalid(self, values: npt.NDArray[Any]) -> str | None:
        for leaf in self.leaves:
            if found := leaf.space._invalid(values[leaf.name]):
                return f"{found} in {leaf.name}"
        return None


@functools.lru_cache
def _structure(leaves: tuple[Leaf, ...]) -> np.dtype[Any]:
    return np.dtype([(leaf.name, leaf.space.dtype, leaf.space.shape) for leaf in leaves])


def _nested(leaves: list[tuple[tuple[Key, ...], spaces.Space[Any]]]) -> spaces.Space[Any]:
    """Return a space that contains the given spaces at the given paths."""
    if len(leaves) == 1 and not leaves[0][0]:
        return leaves[0][1]
    inner: dict[Key, list[tuple[tuple[Key, ...], spaces.Space[Any]]]] = {}
    for (key, *path), space in leaves:
        inner.setdefault(key, []).append((tuple(path), space))
    parts = [(key, _nested(below)) for key, below in inner.items()]
    if list(inner) == list(range(len(inner))):
        return spaces.Tuple([space for _, space in parts])
    return spaces.Dict(parts)  # type: ignore[arg-type]  # Gymnasium accepts keys of all types


ObservationSpace = LeafSpace | Record


def leaves_of(space: ObservationSpace) -> tuple[Leaf, ...]:
    """Return the leaves of a record; for any other space, one leaf with an empty name."""
    return space.leaves if isinstance(space, Record) else (Leaf((), space),)


def parts_of(values: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], ...]:
    """Return views of the leaves of elements, [..., *leaf_shape] each."""
    if values.dtype.names is None:
        return (values,)
    return tuple(values[name] for name in values.dtype.names)


def noise(stream: Stream, dtype: np.dtype[Any], shape: tuple[int, ...]) -> npt.NDArray[Any]:
    """Return random observations of a leaf, from the next numbers of a stream.

    Uniform float32 in [-2, 2), uniform bytes, or category 0, depending on the dtype.
    """
    numbers = stream.uniforms(math.prod(shape)).reshape(shape)
    if dtype == np.uint8:
        return (numbers * 256).astype(np.uint8)
    if dtype == np.int32:
        return np.zeros(shape, np.int32)
    return (numbers * 4 - 2).astype(np.float32)
