"""Conversion between an environment's actions and the algorithm's indices (:mod:`udrl.actions`).

A ``Box`` is divided into bins: each dimension has a number of evenly spaced values, from the lowest
to the highest. The environment only receives these values; actions of a dataset are rounded to the
nearest.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from udrl.actions import Categorical, Product
from udrl.environments.conversions import (
    Array,
    Conversion,
    Indexed,
    MultiIndexed,
    as_array,
    leaves_within,
    nested,
)
from udrl.errors import UnsupportedEnvironment
from udrl.setting_groups import ActionSettings

#: Maximum number of the network's outputs.
_MAX_PARAMETERS = 2**16


class _Bits(MultiIndexed):
    """Converts a ``MultiBinary``."""

    def __init__(self, name: str, declared: spaces.MultiBinary, plain: Product) -> None:
        super().__init__(name, spaces.MultiDiscrete(np.full(declared.shape, 2)), plain)
        self.declared = declared


class _Bins(Conversion):
    """Converts a ``Box`` to bins.

    Args:
        name: name of the actions in messages.
        declared: the environment's space.
        values: values of each dimension, in increasing order.
    """

    def __init__(self, name: str, declared: spaces.Box, values: Sequence[Array]) -> None:
        super().__init__(name, declared, Product(ns=tuple(len(v) for v in values)))
        self._values = values
        # One row per dimension; the padding is never read.
        self._table = np.zeros((len(values), max(self.plain.ns)), declared.dtype)
        for row, known in zip(self._table, values, strict=True):
            row[: len(known)] = known
        self._dimensions = np.arange(len(values))

    def back(self, values: Array) -> Any:
        return self._table[self._dimensions, values].reshape(-1, *self.declared.shape)

    def back_one(self, value: Any) -> Any:
        return self._table[self._dimensions, value].reshape(self.declared.shape)

    def convert(self, value: Any, leading: tuple[int, ...]) -> Array:
        array = as_array(self.name, value)
        shape = leading + self.declared.shape
        if array.dtype.kind not in "biuf" or array.shape != shape or not np.isfinite(array).all():
            raise self._fault(value)
        flat = array.reshape(*leading, -1)
        nearest = [
            np.searchsorted((known[1:] + known[:-1]) / 2.0, flat[..., k])
            for k, known in enumerate(np.asarray(v, np.float64) for v in self._values)
        ]
        return np.stack(nearest, axis=-1).astype(self.plain.dtype)


class _Joined(Conversion):
    """Converts a ``Dict`` or ``Tuple`` to the concatenated components of its leaves."""

    def __init__(
        self, name: str, declared: spaces.Space[Any], parts: Sequence[tuple[Any, Conversion]]
    ) -> None:
        ns = tuple(n for _, c in parts for n in c.plain.components)
        super().__init__(name, declared, Product(ns=ns))
        self._parts = parts
        ends = np.cumsum([len(c.plain.components) for _, c in parts])
        self._where = [
            slice(int(end) - len(c.plain.components), int(end))
            for end, (_, c) in zip(ends, parts, strict=True)
        ]

    def back(self, values: Array) -> Any:
        return nested(self.declared, iter([c.back(v) for c, v in self._split(values)]))

    def back_one(self, value: Any) -> Any:
        split = self._split(np.asarray(value))
        return nested(self.declared, iter([c.back_one(v) for c, v in split]))

    def convert(self, value: Any, leading: tuple[int, ...]) -> Array:
        converted: Array = np.empty((*leading, *self.plain.shape), self.plain.dtype)
        for (path, conversion), where in zip(self._parts, self._where, strict=True):
            found = value
            for key in path:
                try:
                    found = found[key]
                except (LookupError, TypeError) as error:
                    raise self._fault(value) from error
            part = conversion.convert(found, leading)
            converted[..., where] = part.reshape(*leading, -1)
        return converted

    def _split(self, values: Array) -> list[tuple[Conversion, Array]]:
        """Return each leaf's conversion and its part of the values."""
        return [
            (c, values[..., where] if isinstance(c.plain, Product) else values[..., where.start])
            for (_, c), where in zip(self._parts, self._where, strict=True)
        ]


def action_conversion(space: spaces.Space[Any], settings: ActionSettings) -> Conversion:
    """Return the conversion for actions of a space.

    Args:
        space: the environment's action space.
        settings: ``action_bins``, ``action_low``, ``action_high``.

    Raises:
        UnsupportedEnvironment: the space is not supported; the message lists all problems.
    """
    leaves = list(leaves_within(space))
    dimensions = sum(int(np.prod(s.shape)) for _, s in leaves if isinstance(s, spaces.Box))
    bins = settings.action_bins or default_bins(dimensions)
    parts: list[tuple[Any, Conversion]] = []
    problems = []
    for path, inner in leaves:
        name = "action" + "".join(f"[{key!r}]" for key in path)
        try:
            parts.append((path, _leaf_conversion(name, inner, settings, bins)))
        except UnsupportedEnvironment as error:
            problems.append(str(error))
    if not leaves:
        problems.append(
            f"its action space {space} has no parts, so there is nothing to choose; expected at "
            f"least one Discrete, MultiDiscrete, MultiBinary or Box"
        )
    elif (
        not problems
        and (n := sum(n for _, c in parts for n in c.plain.components)) > _MAX_PARAMETERS
    ):
        problems.append(
            f"its actions are {space}, for which the network would have {n:,} outputs, at most "
            f"{_MAX_PARAMETERS:,} are supported; offer fewer actions with "
            f"gymnasium.wrappers.TransformAction, or for Box actions lower action_bins"
        )
    if problems:
        raise UnsupportedEnvironment("; also, ".join(problems))
    if [path for path, _ in leaves] == [()]:
        return parts[0][1]
    return _Joined("action", space, parts)


def default_bins(dimensions: int) -> int:
    """Return the default number of values per dimension: fewer if there are many dimensions.

    The number is odd, so that the middle is one of the values.
    """
    return 11 if dimensions <= 2 else 7


def _leaf_conversion(
    name: str, space: spaces.Space[Any], settings: ActionSettings, bins: int
) -> Conversion:
    match space:
        case spaces.Discrete(n=n):
            return Indexed(name, space, Categorical(n=int(n)))
        case spaces.MultiDiscrete() if space.nvec.size:
            return MultiIndexed(name, space, Product(ns=tuple(space.nvec.reshape(-1).tolist())))
        case spaces.MultiBinary() if np.prod(space.shape) > 0:
            return _Bits(name, space, Product(ns=(2,) * int(np.prod(space.shape))))
        case spaces.Box() if np.prod(space.shape) > 0:
            return _box_conversion(name, space, settings, bins)
    raise UnsupportedEnvironment(
        f"its {name} is {space}; supported are Discrete, MultiDiscrete, MultiBinary, Box, and Dict "
        f"and Tuple of these; wrap it in gymnasium.wrappers.TransformAction"
    )


def _box_conversion(
    name: str, space: spaces.Box, settings: ActionSettings, bins: int
) -> Conversion:
    low, high = _bounds(space, settings)
    missing = np.isnan(low) | np.isnan(high)
    if missing.any():
        place = np.argwhere(missing)[0].tolist()
        raise UnsupportedEnvironment(
            f"its {name}{place} has no bounds ({space}), which are needed to divide it into bins; "
            f"set them, e.g. --set action_low=-1 --set action_high=1"
        )
    if (low >= high).any():
        place = np.argwhere(low >= high)[0].tolist()
        raise UnsupportedEnvironment(
            f"its {name}{place} is from {low[tuple(place)]:g} to {high[tuple(place)]:g}; "
            f"expected a lower bound below the upper one; correct the space, or action_low and "
            f"action_high"
        )
    whole = np.issubdtype(space.dtype, np.integer)
    if whole:
        limits = np.iinfo(space.dtype.name)
        outside = (np.rint(low) < limits.min) | (np.rint(high) >= float(limits.max) + 1)
        if outside.any():
            place = np.argwhere(outside)[0].tolist()
            raise UnsupportedEnvironment(
                f"its {name}{place} is from {low[tuple(place)]:g} to {high[tuple(place)]:g}; "
                f"expected numbers that its dtype {space.dtype} can hold, {limits.min} to "
                f"{limits.max}; set action_low and action_high accordingly"
            )
    values = [
        np.unique(np.rint(v)) if whole else v
        for v in np.linspace(low.reshape(-1), high.reshape(-1), bins, axis=1)
    ]
    return _Bins(name, space, [v.astype(space.dtype) for v in values])


def _bounds(space: spaces.Box, settings: ActionSettings) -> tuple[Array, Array]:
    """Return the bounds of each dimension, float64; NaN if it is neither declared nor set."""
    below, above = space.bounded_below.copy(), space.bounded_above.copy()
    if space.dtype.kind in "iu" and space.dtype.itemsize >= 4:
        # Gymnasium replaces infinite bounds of integers by the limits of their dtype, and a wrapper
        # that copies them loses the flags. Only small integers may really have these bounds.
        limits = np.iinfo(space.dtype.name)
        above &= space.high.astype(np.float64) < float(limits.max)
        if limits.min < 0:
            below &= space.low > limits.min
    elif space.dtype.kind == "f":  # some environments declare the limits of a dtype instead
        largest = float(np.finfo(space.dtype.name).max)
        above &= space.high < largest
        below &= space.low > -largest
    low, high = (
        np.where(declared & np.isfinite(bound), bound, np.nan if given is None else float(given))
        for declared, bound, given in (
            (below, space.low, settings.action_low),
            (above, space.high, settings.action_high),
        )
    )
    return low.astype(np.float64), high.astype(np.float64)
