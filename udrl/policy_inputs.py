"""Observations and commands that are passed to a policy: checked, as the network's inputs."""

from typing import Any

import numpy as np
import numpy.typing as npt

from udrl.config import Config
from udrl.environments.conversions import as_array, describe
from udrl.environments.specification import EnvironmentSpec
from udrl.errors import InvalidData
from udrl.frame_stack import FrameStack, Seen
from udrl.spaces import Leaf, Observations, leaves_of, parts_of


class PolicyInputs:
    """Converts what callers pass to a :class:`~udrl.policy.Policy`.

    Args:
        spec: specification of the environment.
        config: settings of the run.
    """

    def __init__(self, spec: EnvironmentSpec, config: Config) -> None:
        self._space = spec.observation_space
        self._environment = config.environment
        self._stack = FrameStack(spec.observation_space, config.network.frame_stack)

    def convert(
        self,
        observation: npt.ArrayLike,
        desired_return: npt.ArrayLike,
        desired_horizon: npt.ArrayLike,
    ) -> tuple[Seen, npt.NDArray[np.float64], int | None]:
        """Return the network's inputs.

        Args:
            observation: an observation, or a batch (:meth:`udrl.policy.Policy.logits`).
            desired_return: a number, or one for each observation of the batch.
            desired_horizon: likewise.

        Returns:
            An array for each leaf of the observation, [n, *shape]; the commands, [n, 2]; and n. For
            a single observation the first dimension is 1, and n is None.

        Raises:
            InvalidData: the observation's shape differs from that in training, the numbers of
                observations and commands differ, or a value is not finite or impossible in
                training.
        """
        desired, n = _commands(desired_return, desired_horizon)
        return self._stack.join(self._plain(observation, n)), desired, n

    def _plain(self, observation: Any, n: int | None) -> Observations:
        """Return observations as an array, [n or 1, frame_stack, *observation_shape]."""
        space, length = self._space, self._stack.length
        plain: Observations = np.empty((n or 1, length, *space.shape), space.dtype)
        parts = zip(leaves_of(space), parts_of(plain), self._stack.shapes, strict=True)
        rows = () if n is None else (n,)
        for leaf, part, joined in parts:
            seen = as_array(f"observation{leaf.name}", _find(leaf, observation))
            stacked = part.shape[1:]
            expected = stacked[1:] if length == 1 else joined
            if seen.shape not in ((*rows, *expected), (*rows, *stacked)):
                if found := _count_mismatch(seen.shape, n, (expected, stacked)):
                    raise InvalidData(found)
                raise InvalidData(
                    f"an observation{leaf.name} of shape {seen.shape}: expected "
                    f"{(*rows, *expected)}, as in training ({self._environment})"
                )
            values, found = _converted(seen, part.dtype)
            values = values.reshape(-1, *leaf.space.shape)
            if found := found or leaf.space.fault(values, len(values)):
                raise InvalidData(
                    f"observation{leaf.name}: {found}; pass observations like those in training"
                )
            part[:] = values.reshape(part.shape)
        return plain


def _commands(
    desired_return: npt.ArrayLike, desired_horizon: npt.ArrayLike
) -> tuple[npt.NDArray[np.float64], int | None]:
    """Return commands, float64 [n, 2], and n; for a single command [1, 2], and None."""
    try:
        values = np.asarray(desired_return, np.float64), np.asarray(desired_horizon, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidData(
            f"desired return {describe(desired_return)}, desired horizon "
            f"{describe(desired_horizon)}: {error}; pass numbers, or one for each observation of a "
            f"batch"
        ) from error
    try:
        desired = np.stack(np.broadcast_arrays(*values), axis=-1)
    except ValueError:
        desired = np.empty(())
    if desired.ndim not in (1, 2) or desired.size == 0:
        raise InvalidData(
            f"desired returns of shape {values[0].shape} and desired horizons of shape "
            f"{values[1].shape}: expected numbers, or one for each observation of a batch"
        )
    if not np.isfinite(desired).all():
        raise InvalidData(
            f"desired return {values[0]}, desired horizon {values[1]}: expected finite numbers"
        )
    return (desired[None], None) if desired.ndim == 1 else (desired, len(desired))


def _count_mismatch(
    shape: tuple[int, ...], n: int | None, singles: tuple[tuple[int, ...], ...]
) -> str | None:
    """Return a message if valid observations are not as many as the commands, else None.

    Args:
        shape: shape of the observations.
        n: number of commands; None: a single one, not a batch.
        singles: possible shapes of a single observation.
    """
    if shape in singles:
        return (
            f"a single observation, but {n} desired returns and horizons; pass one of each, or a "
            f"batch of {n} observations"
        )
    if shape[1:] not in singles:
        return None
    given = "one desired return and horizon" if n is None else f"{n} desired returns and horizons"
    return (
        f"a batch of {shape[0]} observations, but {given}; pass arrays of {shape[0]}, one of each "
        f"for every observation"
    )


def _find(leaf: Leaf, observation: Any) -> Any:
    """Return a leaf of an observation, in the environment's form or as a structured array."""
    try:
        if isinstance(observation, np.ndarray | np.void) and observation.dtype.names:
            return observation[leaf.name]
        return leaf.find(observation)
    except (LookupError, ValueError) as error:
        raise InvalidData(
            f"observation{leaf.name} is missing in {describe(observation)}; pass observations like "
            f"those in training, which policy.make_environment() returns"
        ) from error


def _converted(seen: npt.NDArray[Any], dtype: np.dtype[Any]) -> tuple[npt.NDArray[Any], str | None]:
    """Return values in another dtype, and why this changes them; None: it only rounds them."""
    if seen.dtype == dtype:
        return seen, None
    if seen.dtype.kind not in "biuf":
        return seen, f"an array of {seen.dtype}, expected numbers"
    with np.errstate(over="ignore", invalid="ignore"):
        converted = seen.astype(dtype)
    if dtype.kind in "iu" and not np.array_equal(converted, seen):
        limits = np.iinfo(dtype)
        return converted, f"not all whole numbers from {limits.min} to {limits.max}"
    return converted, None
