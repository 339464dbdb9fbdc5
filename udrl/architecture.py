"""Sizes and constants of the network of section 3.2 and Appendix B.2, and of the value function.

They are what the behavior function in torch (:mod:`udrl.behavior`) and the acting graph
(:mod:`udrl.graph`) have in common.
"""

import math
from collections.abc import Sequence

from udrl.config import Config
from udrl.environments.making import EnvironmentSpec

# Appendix B.2.
FILTER, STRIDE, PADDING = 3, 2, 1

#: Units in each hidden layer of the value function.
VALUE_WIDTH = 64

#: D(s) is at least this, in scaled return: where V fits perfectly, every gain would be infinite.
LEAST_DEVIATION = 3e-3

#: D(s) is a squareplus, (d + sqrt(d^2 + this)) / 2: what softplus is for, of operations that IEEE
#: 754 rounds in one way only, so that it does not matter which instructions compute them.
SQUAREPLUS = 2.0

#: Relative desired returns are kept within so many deviations.
DEVIATIONS = 2.0


def stacked_shape(spec: EnvironmentSpec, config: Config) -> tuple[int, ...]:
    """Return the shape of what the network observes: the most recent frames, one after another."""
    first, *rest = spec.observation_shape
    return (config.frame_stack * first, *rest)


def image_features(shape: tuple[int, ...], channels: Sequence[int]) -> int:
    """Return how many features the convolutions make of an image of shape [channels, h, w]."""
    _, *size = shape
    for _ in channels:
        size = [(n + 2 * PADDING - FILTER) // STRIDE + 1 for n in size]
    return channels[-1] * math.prod(size)
