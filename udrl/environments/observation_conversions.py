"""Conversion between an environment's observations and plain arrays (:mod:`udrl.spaces`)."""

import math
from typing import Any

import numpy as np
from gymnasium import spaces

from udrl.environments.conversions import (
    Array,
    Boxed,
    Conversion,
    Indexed,
    MultiIndexed,
    describe,
    leaves_within,
    nested,
)
from udrl.errors import InvalidData, UnsupportedEnvironment
from udrl.spaces import (
    MAX_CATEGORIES,
    MAX_KEY_LENGTH,
    MAX_LEAVES,
    MAX_SIZE,
    Bits,
    Categories,
    Category,
    Image,
    Key,
    Leaf,
    Record,
    Vector,
)

#: Maximum levels of nested spaces.
_MAX_DEPTH = 16


def observation_conversion(space: spaces.Space[Any]) -> Conversion:
    """Return the conversion for observations of a space.

    Raises:
        UnsupportedEnvironment: the space is not supported; the message lists all problems.
    """
    leaves = list(leaves_within(space))
    if [path for path, _ in leaves] == [()]:
        return _leaf_conversion("observation", space)
    if not 1 <= len(leaves) <= MAX_LEAVES or max(len(path) for path, _ in leaves) > _MAX_DEPTH:
        raise UnsupportedEnvironment(
            f"its observations have {len(leaves)} parts; supported are 1 to {MAX_LEAVES}, at most "
            f"{_MAX_DEPTH} levels deep"
        )
    parts, problems = [], []
    for path, inner in leaves:
        name = "observation" + "".join(f"[{key!r}]" for key in path)
        try:
            _check_keys(name, path)
            parts.append((path, _leaf_conversion(name, inner)))
        except UnsupportedEnvironment as error:
            problems.append(str(error))
    if problems:
        raise UnsupportedEnvironment("; also, ".join(problems))
    return _Records("observation", space, parts)


def _check_keys(name: str, path: tuple[Any, ...]) -> None:
    for key in path:
        named = type(key) is str and len(key) <= MAX_KEY_LENGTH
        if not named and not (type(key) is int and 0 <= key <= MAX_LEAVES):
            raise UnsupportedEnvironment(
                f"its {name} has the key {describe(key)}, expected a string of at most "
                f"{MAX_KEY_LENGTH} characters or an integer from 0 to {MAX_LEAVES}; rename it with "
                f"gymnasium.wrappers.TransformObservation"
            )


def _size(name: str, shape: tuple[int, ...]) -> int:
    size = math.prod(shape)
    if size > MAX_SIZE:
        raise UnsupportedEnvironment(
            f"its {name} has {size:,} numbers, at most {MAX_SIZE:,} are supported; make it "
            f"smaller with gymnasium.wrappers.TransformObservation, or if it is an image, declare "
            f"it as uint8 with bounds 0 and 255"
        )
    return size


def _leaf_conversion(name: str, space: spaces.Space[Any]) -> Conversion:
    match space:
        case spaces.Discrete(n=n) if n <= MAX_CATEGORIES:
            return Indexed(name, space, Category(n=int(n)))
        case spaces.Discrete(n=n):
            raise _too_many(f"its {name} is one of {n:,} states")
        case spaces.MultiDiscrete() if space.nvec.size:
            if (total := int(space.nvec.sum())) > MAX_CATEGORIES:
                raise _too_many(f"its {name} has {total:,} values in all components together")
            return MultiIndexed(name, space, Categories(ns=tuple(space.nvec.reshape(-1).tolist())))
        case spaces.MultiBinary() if np.prod(space.shape) > 0:
            return Boxed(name, space, Bits(size=_size(name, space.shape)))
        case spaces.Box() if is_image(space):
            if min(space.shape) > 0:
                return _Images(name, space)
        case spaces.Box() if np.prod(space.shape) > 0:
            return Boxed(name, space, Vector(size=_size(name, space.shape)))
    raise UnsupportedEnvironment(
        f"its {name} is {space}; supported are Box, Discrete, MultiDiscrete, MultiBinary, and Dict "
        f"and Tuple of these; {_remedy(name, space)}"
    )


def _too_many(what: str) -> UnsupportedEnvironment:
    """Return the error for a space with too many categories."""
    return UnsupportedEnvironment(
        f"{what}, and the network would learn a vector for each; at most {MAX_CATEGORIES:,} are "
        f"supported; use a wrapper that returns numbers that describe a state"
    )


def _remedy(name: str, space: spaces.Space[Any]) -> str:
    """Return the remedy for an unsupported space."""
    drop = ""
    if name.endswith("']"):
        drop = ", or leave it out with gymnasium.wrappers.FilterObservation"
    cause = ""
    if isinstance(space, spaces.Text | spaces.Sequence | spaces.Graph | spaces.OneOf):
        cause = "its elements vary in size; "
    return f"{cause}convert it to arrays with gymnasium.wrappers.TransformObservation{drop}"


class _Images(Boxed):
    """Converts images."""

    def __init__(self, name: str, declared: spaces.Box) -> None:
        shape, axis = declared.shape, channel_axis(declared)
        self._is_flat = axis is None
        self._is_last = axis == 2
        moved = (1, *shape) if self._is_flat else shape
        if self._is_last:
            moved = (shape[2], *shape[:2])
        super().__init__(name, declared, Image(*moved))
        self._is_reshaped = False

    def back(self, values: Array) -> Any:
        """Return elements of the declared space."""
        if self._is_flat:
            return values[:, 0]
        return np.moveaxis(values, -3, -1) if self._is_last else values

    def convert(self, value: Any, leading: tuple[int, ...]) -> Array:
        """Return plain elements, [*leading, *shape]."""
        array = super().convert(value, leading)
        if self._is_flat:
            return np.expand_dims(array, len(leading))
        return np.moveaxis(array, -1, -3) if self._is_last else array


class _Records(Conversion):
    """Converts a ``Dict`` or ``Tuple``, possibly nested, to records."""

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
        """Return elements of the declared space."""
        return nested(self.declared, iter([c.back(values[leaf.name]) for leaf, c in self._parts]))

    def back_one(self, value: Any) -> Any:
        """Return elements of the declared space."""
        return nested(
            self.declared, iter([c.back_one(value[leaf.name]) for leaf, c in self._parts])
        )

    def convert(self, value: Any, leading: tuple[int, ...]) -> Array:
        """Return plain elements, [*leading, *shape]."""
        record: Array = np.empty(leading, self.plain.dtype)
        for leaf, conversion in self._parts:
            try:
                found = leaf.find(value)
            except LookupError:
                raise InvalidData(
                    f"{self.name}: {describe(value)}, without {conversion.name}, expected an "
                    f"element of {self.declared}"
                ) from None
            record[leaf.name] = (
                conversion.convert(found, leading) if leading else conversion.one(found)
            )
        return record


def is_image(space: spaces.Space[Any]) -> bool:
    """Return whether a space is one of images: a ``Box`` of bytes with two or three dimensions."""
    return isinstance(space, spaces.Box) and len(space.shape) in (2, 3) and space.dtype == np.uint8


def channel_axis(space: spaces.Box) -> int | None:
    """Return the dimension of an image that holds its channels, 0 or 2; None: it has no channels.

    Spaces do not declare it: it is 0 if no dimension is smaller than the first, otherwise 2.
    """
    if len(space.shape) == 2:
        return None
    return 2 if space.shape[0] > min(space.shape) else 0
