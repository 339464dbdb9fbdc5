"""Sizes and constants of the network of section 3.2 and Appendix B.2, and of the value function.

The behavior function in torch (:mod:`udrl.behavior`) and the acting graph (:mod:`udrl.graph`) share
them.
"""

import math
from collections.abc import Sequence

from udrl.setting_groups import NetworkSettings
from udrl.spaces import Image, ObservationSpace

# Of convolutions, in pixels (Appendix B.2).
FILTER, STRIDE, PADDING = 3, 2, 1

#: Units in each hidden layer of the value function.
VALUE_WIDTH = 64

#: Lower bound of D(s), in scaled return. Without it, advantages would be infinite where V is exact.
MIN_DEVIATION = 3e-3

#: D(s) is a squareplus, (d + sqrt(d^2 + SQUAREPLUS)) / 2. Unlike softplus, it only has operations
#: whose rounding IEEE 754 defines, so the result does not depend on the processor's instructions.
SQUAREPLUS = 2.0

#: Normalised observations are clipped to this many standard deviations from their mean.
NORMAL_BOUND = 10.0

#: Added to the logits of masked actions.
FORBIDDEN = -1e9

#: Part of the names of tensors that are set once and not trained.
NORMALISER = "normaliser"
#: Name of the weight of guidance (:mod:`udrl.guidance`).
GUIDANCE = "guidance"
#: First part of the names of a custom network's tensors (:mod:`udrl.custom_networks`).
CUSTOM = "custom"


def is_custom(name: str) -> bool:
    """Return whether a layer or tensor of this name belongs to a custom network."""
    return name.split(".")[0] == CUSTOM


def is_trained(name: str) -> bool:
    """Return whether the optimizer updates a tensor of this name."""
    return is_custom(name) or (name != GUIDANCE and NORMALISER not in name.split("."))


def layer_widths(space: ObservationSpace, network: NetworkSettings) -> tuple[int, ...]:
    """Return the widths of the behavior function's features and of the layers after them.

    The convolutions of an image come before all layers of ``hidden``; any other encoder, including
    that of a record, is the first of these layers. With a memory, its state is the features.
    """
    if isinstance(space, Image):
        widths = (n_features(space, network.convolutions, 0), *network.hidden)
    else:
        widths = network.hidden
    return widths if network.memory == "none" else (network.memory_size, *widths[1:])


def state_sizes(network: NetworkSettings) -> tuple[int, ...]:
    """Return the state sizes of the behavior function's and the value function's memories."""
    if network.memory == "none":
        return ()
    own = (network.memory_size,)
    return own if network.baseline == "none" else (*own, VALUE_WIDTH)


def n_features(space: ObservationSpace, channels: Sequence[int], width: int) -> int:
    """Return the number of an encoder's features: for an image, the output of its convolutions."""
    if not isinstance(space, Image):
        return width
    return channels[-1] * math.prod(image_sizes(space, len(channels))[-1])


def image_sizes(space: Image, n_layers: int) -> list[tuple[int, int]]:
    """Return height and width after each of ``n_layers`` convolutions."""
    sizes = [(space.height, space.width)]
    for _ in range(n_layers):
        height, width = ((n + 2 * PADDING - FILTER) // STRIDE + 1 for n in sizes[-1])
        sizes.append((height, width))
    return sizes[1:]
