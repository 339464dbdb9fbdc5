"""Sizes and constants of the network of section 3.2 and Appendix B.2, and of the value function.

They are what the behavior function in torch (:mod:`udrl.behavior`) and the acting graph
(:mod:`udrl.graph`) have in common.
"""

import math
from collections.abc import Sequence

from udrl.setting_groups import NetworkSettings
from udrl.spaces import Image, ObservationSpace

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


#: Normalised observations are kept within so many deviations of their mean.
NORMAL_BOUND = 10.0

#: Added to the logits of actions that are not allowed.
FORBIDDEN = -1e9

#: In the names of tensors that are set once and not trained.
NORMALISER = "normaliser"


def is_trained(name: str) -> bool:
    """Say whether training changes a tensor of this name at every update."""
    return NORMALISER not in name.split(".")


def layer_widths(space: ObservationSpace, network: NetworkSettings) -> tuple[int, ...]:
    """Return the widths of the behavior function: of its features, and of the layers that follow.

    An image's convolutions stand before all layers of ``hidden``; any other encoder, also the one
    of a record, is the first. Where there is a memory, its state is the features.
    """
    if isinstance(space, Image):
        widths = (n_features(space, network.convolutions, 0), *network.hidden)
    else:
        widths = network.hidden
    return widths if network.memory == "none" else (network.memory_size, *widths[1:])


def state_sizes(network: NetworkSettings) -> tuple[int, ...]:
    """Return how many numbers the behavior function and the value function remember."""
    if network.memory == "none":
        return ()
    own = (network.memory_size,)
    return own if network.baseline == "none" else (*own, VALUE_WIDTH)


def n_features(space: ObservationSpace, channels: Sequence[int], width: int) -> int:
    """Return how many features an encoder makes: of an image what its convolutions leave."""
    if not isinstance(space, Image):
        return width
    return channels[-1] * math.prod(image_sizes(space, len(channels))[-1])


def image_sizes(space: Image, n_layers: int) -> list[tuple[int, int]]:
    """Return height and width behind each of so many convolutions."""
    sizes = [(space.height, space.width)]
    for _ in range(n_layers):
        height, width = ((n + 2 * PADDING - FILTER) // STRIDE + 1 for n in sizes[-1])
        sizes.append((height, width))
    return sizes[1:]
