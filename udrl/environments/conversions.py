"""Between an environment's own observations and actions and the plain arrays of the algorithm.

An image's channels are moved to the front, a ``Discrete`` space with an offset is shifted to 0, and
everything has the dtype of :mod:`udrl.spaces`. What an environment or a dataset holds goes through
here, and is checked on the way: numpy would broadcast, round and wrap without a word.
"""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from udrl.actions import Categorical
from udrl.errors import InvalidData
from udrl.spaces import MOST_CATEGORIES, Category, Image, Space, Vector

Array = npt.NDArray[Any]

#: Of so many elements a table is kept.
_FEW = 1000


class Conversion(ABC):
    """Of the elements of a Gymnasium space.

    Attributes:
        declared: what the environment says its elements are.
        plain: what they are here.
    """

    declared: spaces.Space[Any]
    plain: Space

    def one(self, value: Any) -> Array:
        """Return an element of the environment's, plain.

        Raises:
            InvalidData: it is none; the message has what was declared and what came.
        """
        return self._convert(value, ())

    def all(self, values: Any) -> Array:
        """Return elements of the environment's, plain, [T, ...].

        Raises:
            InvalidData: not all of them are.
        """
        return self._convert(values, (len(values),))

    @abstractmethod
    def back(self, values: Array) -> Array:
        """Return plain elements, [T, ...], as the environment has them."""

    def back_one(self, value: Any) -> Any:
        """Return a plain element as the environment has it, of its own space's type."""
        return self.back(np.asarray(value)[None])[0]

    @abstractmethod
    def _convert(self, value: Any, leading: tuple[int, ...]) -> Array: ...

    def _fault(self, value: Any) -> InvalidData:
        return InvalidData(f"{describe(value)}, declared is {self.declared}")


class _Boxed(Conversion):
    """Numbers of a ``Box``, in the same order."""

    def __init__(self, declared: spaces.Box, plain: Space) -> None:
        self.declared: spaces.Box = declared
        self.plain = plain
        self._shape, self._dtype = declared.shape, plain.dtype
        self._is_whole = self._dtype.kind == "u"

    def back(self, values: Array) -> Array:
        return values.astype(self.declared.dtype)

    def _convert(self, value: Any, leading: tuple[int, ...]) -> Array:
        array = value if type(value) is np.ndarray else _array(value)
        if array.shape != leading + self._shape:
            raise self._fault(value)
        if array.dtype == self._dtype:
            return array
        if array.dtype.kind not in "biuf":
            raise self._fault(value)
        converted = array.astype(self._dtype)
        if self._is_whole and not (converted == array).all():
            raise self._fault(value)
        return converted


class _Pictures(_Boxed):
    """Images; which dimension has the channels, nobody declares: it is the smallest."""

    def __init__(self, declared: spaces.Box) -> None:
        shape = declared.shape
        self._is_flat = len(shape) == 2
        self._is_last = len(shape) == 3 and shape[0] > min(shape)
        moved = (1, *shape) if self._is_flat else shape
        if self._is_last:
            moved = (shape[2], *shape[:2])
        super().__init__(declared, Image(channels=moved[0], height=moved[1], width=moved[2]))

    def back(self, values: Array) -> Array:
        if self._is_flat:
            return values[:, 0]
        return np.moveaxis(values, -3, -1) if self._is_last else values

    def _convert(self, value: Any, leading: tuple[int, ...]) -> Array:
        array = super()._convert(value, leading)
        if self._is_flat:
            return np.expand_dims(array, len(leading))
        return np.moveaxis(array, -1, -3) if self._is_last else array


class _Indices(Conversion):
    """Numbers of a ``Discrete``, from 0 on."""

    def __init__(self, declared: "spaces.Discrete[Any]", plain: Space) -> None:
        self.declared: spaces.Discrete[Any] = declared
        self.plain = plain
        self._start, self._n = int(declared.start), int(declared.n)
        self._back = list(self.back(np.arange(self._n))) if self._n <= _FEW else None

    def one(self, value: Any) -> Any:
        if type(value) is int or isinstance(value, np.integer):  # as nearly all of them are
            index = int(value) - self._start
            if 0 <= index < self._n:
                return self.plain.dtype.type(index)
        return super().one(value)

    def back_one(self, value: Any) -> Any:
        return super().back_one(value) if self._back is None else self._back[value]

    def back(self, values: Array) -> Array:
        return values.astype(self.declared.dtype) + self._start

    def _convert(self, value: Any, leading: tuple[int, ...]) -> Array:
        array = _array(value)
        if array.dtype.kind not in "iu" or array.size != np.prod(leading, dtype=int):
            raise self._fault(value)
        shifted = array.reshape(leading).astype(np.int64) - self._start
        impossible = (shifted < 0) | (shifted >= self._n)
        if impossible.any():
            raise self._fault(shifted[impossible].flat[0] + self._start)
        return shifted.astype(self.plain.dtype)


def _array(value: Any) -> Array:
    try:
        return np.asarray(value)
    except ValueError as error:  # lists of unequal lengths
        raise InvalidData(f"{describe(value)}: {error}") from error


def describe(value: Any) -> str:
    """Say what a value is, in a line."""
    if isinstance(value, np.ndarray | np.generic) and value.ndim:
        return f"an array of {value.dtype}, shape {value.shape}"
    if isinstance(value, tuple | list):
        return f"a {type(value).__name__} of {len(value)}"
    if isinstance(value, dict):
        return f"a dict of {', '.join(map(repr, list(value)[:8])) or 'nothing'}"
    text = repr(value.item() if isinstance(value, np.generic) else value)
    return f"{text[:60]}{'...' if len(text) > 60 else ''} ({type(value).__name__})"


def observation_conversion(space: spaces.Space[Any]) -> Conversion | None:
    """Return how observations of a space become plain; None: they are not supported."""
    if isinstance(space, spaces.Discrete) and space.n <= MOST_CATEGORIES:
        return _Indices(space, Category(n=int(space.n)))
    if isinstance(space, spaces.Box) and min(space.shape, default=0) > 0:
        if len(space.shape) == 1:
            return _Boxed(space, Vector(size=space.shape[0]))
        if len(space.shape) in (2, 3) and space.dtype == np.uint8:
            return _Pictures(space)
    return None


def action_conversion(space: spaces.Space[Any]) -> Conversion | None:
    """Return how actions of a space become plain, and back; None: they are not supported."""
    if isinstance(space, spaces.Discrete):
        return _Indices(space, Categorical(n=int(space.n)))
    return None
