"""Between what an environment has and the plain arrays of the algorithm.

An image's channels are moved to the front, a ``Discrete`` space with an offset is shifted to 0,
``Dict`` and ``Tuple`` spaces become records, and everything has the dtype of :mod:`udrl.spaces`.
What an environment or a dataset holds goes through here, and is checked on the way: numpy would
broadcast, round and wrap without a word. :mod:`udrl.environments.action_conversions` has actions.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from udrl.errors import InvalidData, UnsupportedEnvironment
from udrl.spaces import (
    MOST_CATEGORIES,
    MOST_LEAVES,
    Bits,
    Categories,
    Category,
    Image,
    Key,
    Leaf,
    Record,
    Space,
    Vector,
)

Array = npt.NDArray[Any]
#: Keys of dictionaries and indices of tuples on the way to a leaf.
Path = tuple[Key, ...]

#: Of so many elements a table is kept.
_FEW = 1000
#: Levels of spaces within spaces.
_DEEPEST = 16


class Conversion(ABC):
    """Of the elements of a Gymnasium space.

    Args:
        name: what messages call them.
        declared: what the environment says they are.
        plain: what they are here.
    """

    def __init__(self, name: str, declared: spaces.Space[Any], plain: Space) -> None:
        self.name = name
        self.declared: Any = declared
        self.plain: Any = plain

    def one(self, value: Any) -> Array:
        """Return an element of the environment's, plain.

        Raises:
            InvalidData: it is none; the message has what was declared and what came.
        """
        return self.convert(value, ())

    @abstractmethod
    def convert(self, value: Any, leading: tuple[int, ...]) -> Array:
        """Return elements of the environment's, plain, [*leading, *shape].

        Raises:
            InvalidData: not all of them are.
        """

    @abstractmethod
    def back(self, values: Array) -> Any:
        """Return plain elements, [T, ...], as the environment has them, in arrays of T."""

    def back_one(self, value: Any) -> Any:
        """Return a plain element as the environment has it, of its own space's type."""
        return self.back(np.asarray(value)[None])[0]

    def _fault(self, value: Any) -> InvalidData:
        return InvalidData(f"{self.name} {describe(value)}, declared is {self.declared}")


class Boxed(Conversion):
    """Numbers in the same order: of a ``Box`` of any shape, or a ``MultiBinary``."""

    def __init__(self, name: str, declared: spaces.Space[Any], plain: Space) -> None:
        super().__init__(name, declared, plain)
        assert declared.shape is not None
        self._shape, self._dtype = declared.shape, plain.dtype
        self._is_whole = self._dtype.kind == "u"
        self._is_reshaped = self._shape != plain.shape

    def back(self, values: Array) -> Any:
        """As declared."""
        return values.astype(self.declared.dtype).reshape(-1, *self._shape)

    def convert(self, value: Any, leading: tuple[int, ...]) -> Array:
        """Plain."""
        array = value if type(value) is np.ndarray else as_array(self.name, value)
        if array.shape != leading + self._shape:
            raise self._fault(value)
        if array.dtype != self._dtype:
            if array.dtype.kind not in "biuf":
                raise self._fault(value)
            converted = array.astype(self._dtype)
            if self._is_whole and not (converted == array).all():
                raise self._fault(value)
            array = converted
        return array.reshape(*leading, *self.plain.shape) if self._is_reshaped else array


class _Pictures(Boxed):
    """Images; which dimension has the channels, nobody declares: it is the smallest."""

    def __init__(self, name: str, declared: spaces.Box) -> None:
        shape = declared.shape
        self._is_flat = len(shape) == 2
        self._is_last = len(shape) == 3 and shape[0] > min(shape)
        moved = (1, *shape) if self._is_flat else shape
        if self._is_last:
            moved = (shape[2], *shape[:2])
        super().__init__(name, declared, Image(*moved))
        self._is_reshaped = False

    def back(self, values: Array) -> Any:
        """As declared."""
        if self._is_flat:
            return values[:, 0]
        return np.moveaxis(values, -3, -1) if self._is_last else values

    def convert(self, value: Any, leading: tuple[int, ...]) -> Array:
        """Plain."""
        array = super().convert(value, leading)
        if self._is_flat:
            return np.expand_dims(array, len(leading))
        return np.moveaxis(array, -1, -3) if self._is_last else array


class Indexed(Conversion):
    """Numbers of a ``Discrete``, from 0 on."""

    def __init__(self, name: str, declared: "spaces.Discrete[Any]", plain: Space) -> None:
        super().__init__(name, declared, plain)
        self._start, self._n = int(declared.start), int(declared.n)
        self._back = list(self.back(np.arange(self._n))) if self._n <= _FEW else None

    def one(self, value: Any) -> Any:
        """Plain, without delay where it is an integer."""
        if type(value) is int or isinstance(value, np.integer):  # as nearly all of them are
            index = int(value) - self._start
            if 0 <= index < self._n:
                return self.plain.dtype.type(index)
        return super().one(value)

    def back_one(self, value: Any) -> Any:
        """As declared."""
        return super().back_one(value) if self._back is None else self._back[value]

    def back(self, values: Array) -> Any:
        """As declared."""
        return values.astype(self.declared.dtype) + self._start

    def convert(self, value: Any, leading: tuple[int, ...]) -> Array:
        """Plain."""
        array = as_array(self.name, value)
        if array.dtype.kind not in "iu" or array.size != np.prod(leading, dtype=int):
            raise self._fault(value)
        shifted = array.reshape(leading).astype(np.int64) - self._start
        impossible = (shifted < 0) | (shifted >= self._n)
        if impossible.any():
            raise self._fault(shifted[impossible].flat[0] + self._start)
        return shifted.astype(self.plain.dtype)


class MultiIndexed(Conversion):
    """Numbers of a ``MultiDiscrete`` of any shape, from 0 on, in one dimension."""

    def __init__(self, name: str, declared: spaces.MultiDiscrete, plain: Space) -> None:
        super().__init__(name, declared, plain)
        self._start = np.asarray(declared.start).reshape(-1)
        self._ns = np.asarray(declared.nvec).reshape(-1)

    def back(self, values: Array) -> Any:
        """As declared."""
        numbers = values.astype(self.declared.dtype) + self._start
        return numbers.astype(self.declared.dtype).reshape(-1, *self.declared.shape)

    def convert(self, value: Any, leading: tuple[int, ...]) -> Array:
        """Plain."""
        array = as_array(self.name, value)
        if array.dtype.kind not in "biu" or array.shape != leading + self.declared.shape:
            raise self._fault(value)
        shifted = array.reshape(*leading, -1).astype(np.int64) - self._start
        if ((shifted < 0) | (shifted >= self._ns)).any():
            raise InvalidData(
                f"{self.name} {array.tolist()}, declared is {self.declared}"
                if array.size <= _FEW
                else f"{self.name} with an impossible index, declared is {self.declared}"
            )
        return shifted.astype(self.plain.dtype)


class _Records(Conversion):
    """Structures of a ``Dict`` or ``Tuple``, however deep."""

    def __init__(
        self,
        name: str,
        declared: spaces.Space[Any],
        parts: list[tuple[tuple[Key, ...], Conversion]],
    ) -> None:
        leaves = tuple(Leaf(path, conversion.plain) for path, conversion in parts)
        super().__init__(name, declared, Record(leaves))
        self._parts = [(leaf, c) for leaf, (_, c) in zip(leaves, parts, strict=True)]

    def back(self, values: Array) -> Any:
        """As declared."""
        return nested(self.declared, iter([c.back(values[leaf.name]) for leaf, c in self._parts]))

    def back_one(self, value: Any) -> Any:
        """As declared."""
        return nested(
            self.declared, iter([c.back_one(value[leaf.name]) for leaf, c in self._parts])
        )

    def convert(self, value: Any, leading: tuple[int, ...]) -> Array:
        """Plain."""
        record: Array = np.empty(leading, self.plain.dtype)
        for leaf, conversion in self._parts:
            try:
                found = leaf.find(value)
            except LookupError:
                raise InvalidData(
                    f"{self.name} {describe(value)}, without {conversion.name}, declared is "
                    f"{self.declared}"
                ) from None
            record[leaf.name] = (
                conversion.convert(found, leading) if leading else conversion.one(found)
            )
        return record


def nested(space: spaces.Space[Any], leaves: Iterator[Any]) -> Any:
    """Return leaves, in the order of a space's, in its dictionaries and tuples."""
    if isinstance(space, spaces.Dict):
        return {key: nested(inner, leaves) for key, inner in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(nested(inner, leaves) for inner in space.spaces)
    return next(leaves)


def leaves_within(
    space: spaces.Space[Any], path: Path = ()
) -> Iterator[tuple[Path, spaces.Space[Any]]]:
    """Yield the spaces in dictionaries and tuples of spaces, with the way to each."""
    inner: Mapping[Any, spaces.Space[Any]]
    if isinstance(space, spaces.Dict):
        inner = space.spaces
    elif isinstance(space, spaces.Tuple):
        inner = dict(enumerate(space.spaces))
    else:
        yield path, space
        return
    for key, one in inner.items():
        yield from leaves_within(one, (*path, key))


def as_array(name: str, value: Any) -> Array:
    """Return a value as an array.

    Raises:
        InvalidData: it is none.
    """
    try:
        return np.asarray(value)
    except ValueError as error:  # lists of unequal lengths
        raise InvalidData(f"{name} {describe(value)}: {error}") from error


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


def observation_conversion(space: spaces.Space[Any]) -> Conversion:
    """Return how observations of a space become plain.

    Raises:
        UnsupportedEnvironment: they are not supported; the message names what is not, and why.
    """
    leaves = list(leaves_within(space))
    if [path for path, _ in leaves] == [()]:
        return _of_leaf("observation", space)
    if not 1 <= len(leaves) <= MOST_LEAVES or max(len(path) for path, _ in leaves) > _DEEPEST:
        raise UnsupportedEnvironment(
            f"its observations have {len(leaves)} parts; supported are 1 to {MOST_LEAVES}, at most "
            f"{_DEEPEST} levels deep"
        )
    parts, problems = [], []
    for path, inner in leaves:
        name = "observation" + "".join(f"[{key!r}]" for key in path)
        try:
            parts.append((path, _of_leaf(name, inner)))
        except UnsupportedEnvironment as error:
            problems.append(str(error))
    if problems:
        raise UnsupportedEnvironment("; besides, ".join(problems))
    return _Records("observation", space, parts)


def _of_leaf(name: str, space: spaces.Space[Any]) -> Conversion:
    match space:
        case spaces.Discrete(n=n) if n <= MOST_CATEGORIES:
            return Indexed(name, space, Category(n=int(n)))
        case spaces.Discrete(n=n):
            raise UnsupportedEnvironment(
                f"its {name} is one of {n:,} states, and the network would learn a vector for "
                f"each; at most {MOST_CATEGORIES:,} are supported; wrap it, so that it shows "
                f"numbers that describe a state"
            )
        case spaces.MultiDiscrete() if space.nvec.size and space.nvec.sum() <= MOST_CATEGORIES:
            return MultiIndexed(name, space, Categories(ns=tuple(space.nvec.reshape(-1).tolist())))
        case spaces.MultiBinary() if np.prod(space.shape) > 0:
            return Boxed(name, space, Bits(size=int(np.prod(space.shape))))
        case spaces.Box() if len(space.shape) in (2, 3) and space.dtype == np.uint8:
            if min(space.shape) > 0:
                return _Pictures(name, space)
        case spaces.Box() if np.prod(space.shape) > 0:
            return Boxed(name, space, Vector(size=int(np.prod(space.shape))))
    raise UnsupportedEnvironment(
        f"its {name} is {space}; supported are Box, Discrete, MultiDiscrete, MultiBinary, and Dict "
        f"and Tuple of these; {_help(name, space)}"
    )


def _help(name: str, space: spaces.Space[Any]) -> str:
    """Return what helps with an unsupported space."""
    drop = ""
    if name.endswith("']"):
        drop = ", or leave it out with gymnasium.wrappers.FilterObservation"
    differ = ""
    if isinstance(space, spaces.Text | spaces.Sequence | spaces.Graph | spaces.OneOf):
        differ = "its elements differ in size; "
    return f"{differ}make arrays of it with gymnasium.wrappers.TransformObservation{drop}"
