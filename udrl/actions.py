"""What actions are: how they are chosen from the behavior function's outputs, and checked."""

from typing import Any

import numpy as np
import numpy.typing as npt

from udrl.spaces import Indices

Actions = npt.NDArray[np.integer[Any]]
Numbers = npt.NDArray[np.float64]


class Categorical(Indices, frozen=True, tag="categorical"):
    """One of ``n`` actions, an index from 0 on; the behavior function gives a logit for each.

    An action takes one uniform number.
    """

    @property
    def n_parameters(self) -> int:
        """Outputs of the behavior function."""
        return self.n

    @property
    def dtype(self) -> np.dtype[Any]:
        """The smaller of uint8 and int32 that holds them."""
        return np.dtype(np.uint8 if self.n <= 256 else np.int32)

    def sample(self, logits: Numbers, temperature: Numbers, uniforms: Numbers) -> Actions:
        """Return an action of each row, by inverse CDF in float64.

        Args:
            logits: of P(a | s, c), float64 [rows, n].
            temperature: logits are divided by it, float64 [rows, 1], more than 0.
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
        """Return the likeliest action of each row, int64 [rows], for float64 [rows, n]."""
        actions: Actions = logits.argmax(axis=1)
        return actions

    def uniform(self, uniforms: Numbers) -> Actions:
        """Return actions that are all as likely, int64 [rows], for float64 [rows] in [0, 1)."""
        return (uniforms * self.n).astype(np.int64)

    def probabilities(self, logits: Numbers, temperature: float) -> Numbers:
        """Return the distribution over actions, float64 [n], for logits of the same shape.

        Args:
            logits: of P(a | s, c).
            temperature: logits are divided by it; 0: all on the mode.
        """
        if temperature == 0:
            weights: Numbers = np.zeros(self.n)
            weights[logits.argmax()] = 1.0
        else:
            weights = np.exp((logits - logits.max()) / temperature)
        shares: Numbers = weights / weights.sum()
        return shares

    def choose(self, logits: Numbers, temperature: float, uniform: float) -> int:
        """Return the action that Algorithm 2 takes in one row.

        Args:
            logits: of P(a | s, c), float64 [n].
            temperature: logits are divided by it; 0: take the mode.
            uniform: the number in [0, 1) that decides.
        """
        if temperature == 0:
            return int(self.mode(logits[None])[0])
        divisor = np.array([[temperature]])
        return int(self.sample(logits[None], divisor, np.array([uniform]))[0])


#: The kinds there are.
ActionSpace = Categorical
