"""A rough estimate of an iteration's training time, to warn of iterations that take minutes."""

import math
from itertools import pairwise

from udrl.architecture import FILTER, VALUE_WIDTH, image_sizes, layer_widths, n_features
from udrl.config import Config
from udrl.environments.specification import EnvironmentSpec
from udrl.frame_stack import FrameStack
from udrl.setting_groups import NetworkSettings
from udrl.spaces import Image, LeafSpace, Record, leaves_of

#: Floating-point operations per second and core, measured in convolutions. Machines differ by a
#: factor of two or three, which is good enough to estimate minutes.
_OPERATIONS_PER_S = 5e10
#: Operations of an update per multiplication of a forward pass: the backward pass has twice as
#: many, and each comes with an addition.
_UPDATE_OPERATIONS = 6
#: Training time per iteration above which there is a warning, in seconds.
_LONG_S = 60.0


def training_s(config: Config, spec: EnvironmentSpec) -> float:
    """Estimate the time of an iteration's updates on a CPU, in seconds."""
    network, training = config.network, config.training
    space, first = spec.observation_space, network.hidden[0]
    widths = layer_widths(space, network)
    # Multiplications per example: of the behavior function, and of a value function or critic.
    behavior = _feature_multiplications(config, spec, first, network.memory_size)
    behavior += sum(i * o for i, o in pairwise(widths))
    width = VALUE_WIDTH
    if network.memory == "none":
        width = n_features(space, network.convolutions, VALUE_WIDTH)
    value = _feature_multiplications(config, spec, VALUE_WIDTH, VALUE_WIDTH) + width * VALUE_WIDTH
    n_values = {"none": 0, "value": 1, "action_value": 2}[network.baseline]
    examples = training.n_updates_per_iter * training.batch_size
    operations = _UPDATE_OPERATIONS * examples * (behavior + n_values * value)
    return operations / _OPERATIONS_PER_S / config.arithmetic.training_threads


def slow_training_warning(config: Config, spec: EnvironmentSpec) -> str:
    """Return a warning if training is slow, with its cause and remedy; otherwise ""."""
    seconds, seen = training_s(config, spec), spec.observation_space
    if seconds < _LONG_S or config.arithmetic.device == "cuda":
        return ""
    training = config.training
    what = f"examples of {seen}"
    remedies = "n_updates_per_iter, batch_size or hidden"
    if any(isinstance(leaf.space, Image) for leaf in leaves_of(seen)):
        remedies = (
            "n_updates_per_iter, batch_size or convolutions, or make the images smaller "
            """(--set 'wrappers=["udrl.environments:Downsample(height=60, width=80)"]')"""
        )
    return (
        f"every iteration will train for about {seconds / 60:.0f} minutes on a CPU "
        f"({training.n_updates_per_iter} updates of {training.batch_size} {what}); lower {remedies}"
    )


def _feature_multiplications(
    config: Config, spec: EnvironmentSpec, width: int, remembered: int
) -> float:
    """Return the multiplications of an encoder and the memory after it, per observation."""
    network = config.network
    encoding = _encoder_multiplications(config, spec, width)
    if network.memory == "none":
        return encoding
    n_in = n_features(spec.observation_space, network.convolutions, width)
    return encoding + 3 * remembered * (n_in + remembered)


def _encoder_multiplications(config: Config, spec: EnvironmentSpec, width: int) -> float:
    """Return the multiplications of an encoder, per observation."""
    space, network = spec.observation_space, config.network
    shapes = FrameStack(space, network.frame_stack).shapes
    leaves = [leaf.space for leaf in leaves_of(space)]
    encoding = sum(
        _leaf_multiplications(leaf, shape[0], network, width)
        for leaf, shape in zip(leaves, shapes, strict=True)
    )
    if not isinstance(space, Record):
        return encoding
    return encoding + width * sum(n_features(leaf, network.convolutions, width) for leaf in leaves)


def _leaf_multiplications(
    space: LeafSpace, depth: int, network: NetworkSettings, width: int
) -> float:
    """Return the multiplications of a leaf's encoder; ``depth`` is the input's first dimension."""
    if not isinstance(space, Image):
        return depth * width
    channels = (depth, *network.convolutions)
    sizes = image_sizes(space, len(network.convolutions))
    return sum(
        math.prod(size) * FILTER**2 * n_in * n_out
        for size, (n_in, n_out) in zip(sizes, pairwise(channels), strict=True)
    )
