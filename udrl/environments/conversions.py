"""Conversion between an environment's values and the algorithm's plain arrays.

An image's channels are moved to the front, a ``Discrete`` space with an offset is shifted to 0,
``Dict`` and ``Tuple`` spaces become records, and arrays get the dtypes of :mod:`udrl.spaces`. All
values of environments and datasets are converted here and checked, because numpy would silently
broadcast, round and wrap. :mod:`udrl.environments.observation_conversions` and
:mod:`udrl.environments.action_conversions` choose the conversions of a space.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from udrl.errors import InvalidData
from udrl.spaces import Key, Space

Array = npt.NDArray[Any]
#: Keys of dictionaries and indices of tuples that lead to a leaf.
Path = tuple[Key, ...]

#: Maximum number of elements to list, in a lookup table or in a message.
_MAX_LISTED = 1000


class Conversion(ABC):
    """Converts elements of a Gymnasium space to plain arrays, and back.

    Args:
        name: name of the elements in messages.
        declared: the environment's space.
        plain: the algorithm's space.
    """

    def __init__(self, name: str, declared: spaces.Space[Any], plain: Space) -> None:
        self.name = name
        self.declared: Any = declared
        self.plain: Any = plain

    def one(self, value: Any) -> Array:
        """Convert one element to a plain array.

        Raises:
            InvalidData: it is not in the declared space.
        """
        return self.convert(value, ())

    @abstractmethod
    def convert(self, value: Any, leading: tuple[int, ...]) -> Array:
        """Convert elements to a plain array, [*leading, *shape].

        Raises:
            InvalidData: they are not in the declared space.
        """

    @abstractmethod
    def back(self, values: Array) -> Any:
        """Convert plain elements, [T, ...], back to arrays of T elements of the declared space."""

    def back_one(self, value: Any) -> Any:
        """Convert a plain element back to an element of the declared space."""
        return self.back(np.asarray(value)[None])[0]

    def _fault(self, value: Any) -> InvalidData:
        return InvalidData(
            f"{self.name}: {describe(value)}, expected an element of {self.declared}"
        )


class Boxed(Conversion):
    """Converts a ``Box`` or ``MultiBinary`` of any shape; the order of elements is unchanged."""

    def __init__(self, name: str, declared: spaces.Space[Any], plain: Space) -> None:
        super().__init__(name, declared, plain)
        assert declared.shape is not None
        self._shape, self._dtype = declared.shape, plain.dtype
        self._is_reshaped = self._shape != plain.shape

    def back(self, values: Array) -> Any:
        """Return elements of the declared space."""
        return values.astype(self.declared.dtype).reshape(-1, *self._shape)

    def convert(self, value: Any, leading: tuple[int, ...]) -> Array:
        """Return plain elements, [*leading, *shape]."""
        array = value if type(value) is np.ndarray else as_array(self.name, value)
        if array.shape != leading + self._shape:
            raise self._fault(value)
        if array.dtype != self._dtype:
            converted = with_dtype(array, self._dtype)
            if converted is None:
                raise self._fault(value)
            array = converted
        return array.reshape(*leading, *self.plain.shape) if self._is_reshaped else array


class Indexed(Conversion):
    """Converts a ``Discrete`` to indices from 0."""

    def __init__(self, name: str, declared: "spaces.Discrete[Any]", plain: Space) -> None:
        super().__init__(name, declared, plain)
        self._start, self._n = int(declared.start), int(declared.n)
        self._back = list(self.back(np.arange(self._n))) if self._n <= _MAX_LISTED else None

    def one(self, value: Any) -> Any:
        """Convert one element to an index, of the plain dtype; integers take a fast path."""
        if type(value) is int or isinstance(value, np.integer):
            index = int(value) - self._start
            if 0 <= index < self._n:
                return self.plain.dtype.type(index)
        return super().one(value)

    def back_one(self, value: Any) -> Any:
        """Return elements of the declared space."""
        return super().back_one(value) if self._back is None else self._back[value]

    def back(self, values: Array) -> Any:
        """Return elements of the declared space."""
        return values.astype(self.declared.dtype) + self._start

    def convert(self, value: Any, leading: tuple[int, ...]) -> Array:
        """Return plain elements, [*leading, *shape]."""
        array = as_array(self.name, value)
        if array.dtype.kind not in "iu" or array.size != np.prod(leading, dtype=int):
            raise self._fault(value)
        shifted = array.reshape(leading).astype(np.int64) - self._start
        invalid = (shifted < 0) | (shifted >= self._n)
        if invalid.any():
            raise self._fault(shifted[invalid].flat[0] + self._start)
        return shifted.astype(self.plain.dtype)


class MultiIndexed(Conversion):
    """Converts a ``MultiDiscrete`` of any shape to vectors of indices from 0."""

    def __init__(self, name: str, declared: spaces.MultiDiscrete, plain: Space) -> None:
        super().__init__(name, declared, plain)
        self._start = np.asarray(declared.start).reshape(-1)
        self._ns = np.asarray(declared.nvec).reshape(-1)

    def back(self, values: Array) -> Any:
        """Return elements of the declared space."""
        numbers = values.astype(self.declared.dtype) + self._start
        return numbers.astype(self.declared.dtype).reshape(-1, *self.declared.shape)

    def convert(self, value: Any, leading: tuple[int, ...]) -> Array:
        """Return plain elements, [*leading, *shape]."""
        array = as_array(self.name, value)
        if array.dtype.kind not in "biu" or array.shape != leading + self.declared.shape:
            raise self._fault(value)
        shifted = array.reshape(*leading, -1).astype(np.int64) - self._start
        if ((shifted < 0) | (shifted >= self._ns)).any():
            raise InvalidData(
                f"{self.name}: {array.tolist()}, expected an element of {self.declared}"
                if array.size <= _MAX_LISTED
                else f"{self.name}: an invalid index, expected an element of {self.declared}"
            )
        return shifted.astype(self.plain.dtype)


def nested(space: spaces.Space[Any], leaves: Iterator[Any]) -> Any:
    """Arrange leaves, in the order of the space's leaves, in its dictionaries and tuples."""
    if isinstance(space, spaces.Dict):
        return {key: nested(inner, leaves) for key, inner in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(nested(inner, leaves) for inner in space.spaces)
    return next(leaves)


def with_keys_ordered(space: spaces.Space[Any], model: spaces.Space[Any]) -> spaces.Space[Any]:
    """Return a space with the keys of its dictionaries in the order of another space's."""
    if isinstance(space, spaces.Dict) and isinstance(model, spaces.Dict):
        order = {key: k for k, key in enumerate(model.spaces)}
        if order.keys() == space.spaces.keys():
            keys = sorted(space.spaces, key=order.__getitem__)
            return spaces.Dict([(k, with_keys_ordered(space[k], model[k])) for k in keys])
    if (
        isinstance(space, spaces.Tuple)
        and isinstance(model, spaces.Tuple)
        and len(space) == len(model)
    ):
        return spaces.Tuple([*map(with_keys_ordered, space, model)])
    return space


def leaves_within(
    space: spaces.Space[Any], path: Path = ()
) -> Iterator[tuple[Path, spaces.Space[Any]]]:
    """Yield the leaves of nested ``Dict`` and ``Tuple`` spaces, with their paths."""
    inner: Mapping[Any, spaces.Space[Any]]
    if isinstance(space, spaces.Dict):
        inner = space.spaces
    elif isinstance(space, spaces.Tuple):
        inner = dict(enumerate(space.spaces))
    else:
        yield path, space
        return
    for key, child in inner.items():
        yield from leaves_within(child, (*path, key))


def with_dtype(array: Array, dtype: np.dtype[Any]) -> Array | None:
    """Return numbers in another dtype; None: they are no numbers, or integers cannot hold them."""
    if array.dtype.kind not in "biuf":
        return None
    converted = array.astype(dtype)
    return None if dtype.kind == "u" and not (converted == array).all() else converted


def as_array(name: str, value: Any) -> Array:
    """Return a value as an array.

    Raises:
        InvalidData: it cannot be converted to an array.
    """
    try:
        return np.asarray(value)
    except ValueError as error:  # lists of unequal lengths
        raise InvalidData(f"{name} {describe(value)}: {error}") from error


def describe(value: Any) -> str:
    """Describe a value in one line."""
    if isinstance(value, np.ndarray | np.generic) and value.ndim:
        return f"an array of {value.dtype}, shape {value.shape}"
    if isinstance(value, tuple | list):
        return f"a {type(value).__name__} of {len(value)}"
    if isinstance(value, dict):
        return f"a dict of {', '.join(map(repr, list(value)[:8])) or 'nothing'}"
    text = repr(value.item() if isinstance(value, np.generic) else value)
    return f"{text[:60]}{'...' if len(text) > 60 else ''} ({type(value).__name__})"
