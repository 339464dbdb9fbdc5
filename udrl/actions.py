"""Action spaces: how actions are chosen from the behavior function's outputs, and checked.

A ``Discrete`` action is one index. All other actions have several components, which are independent
given the observation and the command: the components of a ``MultiDiscrete``, the bits of a
``MultiBinary``, and the dimensions of a ``Box``, whose values are binned
(:mod:`udrl.environments.action_conversions`).
"""

from functools import lru_cache
from itertools import accumulate
from typing import Any

import numpy as np
import numpy.typing as npt

from udrl.architecture import FORBIDDEN
from udrl.spaces import IndexVectors, Indices

Actions = npt.NDArray[np.integer[Any]]
Numbers = npt.NDArray[np.float64]


class Categorical(Indices, frozen=True, tag="categorical"):
    """One of ``n`` actions, an index from 0; the behavior function outputs a logit for each.

    Sampling an action takes one uniform number.
    """

    @property
    def n_parameters(self) -> int:
        """Number of outputs of the behavior function."""
        return self.n

    @property
    def components(self) -> tuple[int, ...]:
        """Number of values of each component; the action is the only one."""
        return (self.n,)

    @property
    def dtype(self) -> np.dtype[Any]:
        """uint8 for at most 256 actions, otherwise int32."""
        return np.dtype(np.uint8 if self.n <= 256 else np.int32)

    def sample(self, logits: Numbers, temperature: Numbers, uniforms: Numbers) -> Actions:
        """Sample an action for each row, by inverse CDF in float64.

        Args:
            logits: logits of P(a | s, c), float64 [rows, n].
            temperature: divisor of the logits, float64 [rows, 1], above 0.
            uniforms: float64 [rows] in [0, 1).

        Returns:
            int64 [rows].
        """
        below = logits - np.maximum.reduce(logits, axis=1, keepdims=True)
        weights = np.exp(below / temperature)
        cumulative = np.add.accumulate(weights, axis=1)
        threshold = uniforms * cumulative[:, -1]
        actions: Actions = np.add.reduce(cumulative <= threshold[:, None], axis=1)
        np.minimum(actions, self.n - 1, out=actions)
        return actions

    def mode(self, logits: Numbers) -> Actions:
        """Return the most likely action of each row, int64 [rows], for float64 [rows, n]."""
        actions: Actions = logits.argmax(axis=1)
        return actions

    def uniform(self, uniforms: Numbers) -> Actions:
        """Return uniformly random actions, int64 [rows], for float64 [rows] in [0, 1)."""
        return (uniforms * self.n).astype(np.int64)

    def allowed(self, mask: npt.NDArray[Any], actions: Actions) -> npt.NDArray[np.bool_]:
        """Return whether masks, [rows, n], allow actions, [rows]; bool of the actions' shape."""
        ones: npt.NDArray[np.bool_] = mask[np.arange(len(mask)), actions] > 0
        return ones

    def probabilities(self, logits: Numbers, temperature: float) -> Numbers:
        """Return the distribution over actions, float64 [n].

        Args:
            logits: logits of P(a | s, c), float64 [n].
            temperature: divisor of the logits; 0 = probability 1 for the most likely action.
        """
        if temperature == 0:
            weights: Numbers = np.zeros(self.n)
            weights[logits.argmax()] = 1.0
        else:
            weights = np.exp((logits - logits.max()) / temperature)
        shares: Numbers = weights / weights.sum()
        return shares


class Product(IndexVectors, frozen=True, tag="product"):
    """Several indices, component i one of ``ns[i]``, each with its own categorical distribution.

    The behavior function's outputs are the concatenated logits of all components. Sampling an
    action takes one uniform number per component.
    """

    @property
    def n_parameters(self) -> int:
        """Number of outputs of the behavior function."""
        return sum(self.ns)

    @property
    def components(self) -> tuple[int, ...]:
        """Number of values of each component."""
        return self.ns

    @property
    def dtype(self) -> np.dtype[Any]:
        """uint8 if all components have at most 256 values, otherwise int32."""
        return np.dtype(np.uint8 if max(self.ns) <= 256 else np.int32)

    def sample(self, logits: Numbers, temperature: Numbers, uniforms: Numbers) -> Actions:
        """Sample an action for each row, by inverse CDF in float64.

        Args:
            logits: logits of P(a | s, c), float64 [rows, n_parameters].
            temperature: divisor of the logits, float64 [rows, 1], above 0.
            uniforms: float64 [rows, components] in [0, 1).

        Returns:
            int64 [rows, components].
        """
        weights = self._weights(logits, temperature[:, :, None])
        cumulative = np.add.accumulate(weights, axis=2)
        threshold = uniforms * cumulative[:, :, -1]
        actions: Actions = np.add.reduce(cumulative <= threshold[:, :, None], axis=2)
        np.minimum(actions, np.array(self.ns) - 1, out=actions)
        return actions

    def mode(self, logits: Numbers) -> Actions:
        """Return the most likely action of each row, int64 [rows, components].

        Args:
            logits: float64 [rows, n_parameters].
        """
        actions: Actions = self._padded(logits).argmax(axis=2)
        return actions

    def uniform(self, uniforms: Numbers) -> Actions:
        """Return uniformly random actions, int64, for float64 [rows, components] in [0, 1)."""
        actions: Actions = (uniforms * np.array(self.ns)).astype(np.int64)
        return actions

    def allowed(self, mask: npt.NDArray[Any], actions: Actions) -> npt.NDArray[np.bool_]:
        """Return whether masks, [rows, n_parameters], allow actions, [rows, components]; bool."""
        places = actions.astype(np.int64) + np.array(self.ends) - np.array(self.ns)
        ones: npt.NDArray[np.bool_] = mask[np.arange(len(mask))[:, None], places] > 0
        return ones

    def probabilities(self, logits: Numbers, temperature: float) -> Numbers:
        """Return the concatenated distributions of all components, float64 [n_parameters].

        Args:
            logits: logits of P(a | s, c), float64 [n_parameters].
            temperature: divisor of the logits; 0 = probability 1 for the most likely action.
        """
        parts = np.split(logits, self.ends[:-1])
        shares = [
            Categorical(n).probabilities(part, temperature)
            for n, part in zip(self.ns, parts, strict=True)
        ]
        return np.concatenate(shares)

    @property
    def ends(self) -> tuple[int, ...]:
        """End of each component's logits, exclusive."""
        return tuple(accumulate(self.ns))

    def _weights(self, logits: Numbers, temperature: Numbers) -> Numbers:
        """Return unnormalised probabilities, [rows, components, max(ns)]."""
        padded = self._padded(logits)
        padded -= np.maximum.reduce(padded, axis=2, keepdims=True)
        weights: Numbers = np.exp(padded / temperature)
        return weights

    def _padded(self, logits: Numbers) -> Numbers:
        """Return logits by component, [rows, components, max(ns)], padded with -inf."""
        places, padding = _places(self.ns)
        padded: Numbers = logits[:, places]
        padded[:, padding] = -np.inf
        return padded


@lru_cache
def _places(ns: tuple[int, ...]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Return the indices of each component's logits, [components, max(ns)], and the padding."""
    number = np.arange(max(ns))[None, :]
    sizes = np.array(ns)[:, None]
    first = np.cumsum(sizes)[:, None] - sizes
    return first + np.minimum(number, sizes - 1), number >= sizes


ActionSpace = Categorical | Product


def choose(space: ActionSpace, logits: Numbers, temperature: float, uniforms: Numbers) -> Actions:
    """Choose an action for each row, int64 [rows, *shape], as in Algorithm 2.

    Args:
        space: the action space.
        logits: logits of P(a | s, c), float64 [rows, n_parameters].
        temperature: divisor of the logits; 0 = the most likely action.
        uniforms: random numbers in [0, 1), float64 [rows, *shape].
    """
    if temperature == 0:
        return space.mode(logits)
    return space.sample(logits, np.full((len(logits), 1), temperature), uniforms)


def random_actions(space: ActionSpace, mask: npt.NDArray[Any] | None, uniforms: Numbers) -> Actions:
    """Return uniformly random allowed actions, int64 [rows, *shape].

    Args:
        space: the action space.
        mask: 1 for allowed actions, otherwise 0, [rows, n_parameters]; None: all are allowed.
        uniforms: float64 [rows, *shape] in [0, 1).
    """
    if mask is None:
        return space.uniform(uniforms)
    logits: Numbers = (1.0 - mask) * FORBIDDEN
    return space.sample(logits, np.ones((len(mask), 1)), uniforms)
