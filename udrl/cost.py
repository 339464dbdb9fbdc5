"""About how long an iteration trains, so that one that takes minutes is no surprise."""

import math
from itertools import pairwise

from udrl.architecture import FILTER, VALUE_WIDTH, image_sizes, layer_widths, n_features
from udrl.config import Config
from udrl.environments.making import EnvironmentSpec
from udrl.memory import FrameStack
from udrl.setting_groups import NetworkSettings
from udrl.spaces import Image, LeafSpace, Record, leaves_of

#: Floating-point operations of a core per second in convolutions, as measured; machines differ by
#: a factor of two or three, and this is about minutes.
_PER_SECOND = 5e10
#: Operations of an update for each multiplication of acting: one forward, twice as many
#: backward, each with an addition.
_OF_AN_UPDATE = 6
#: Seconds of training in an iteration that are worth a word.
_LONG_S = 60.0


def training_s(config: Config, spec: EnvironmentSpec) -> float:
    """Return about how many seconds the updates of an iteration take on a CPU."""
    network, training = config.network, config.training
    space, first = spec.observation_space, network.hidden[0]
    widths = layer_widths(space, network)
    acting = _features(config, spec, first, network.memory_size)
    acting += sum(i * o for i, o in pairwise(widths))
    width = VALUE_WIDTH
    if network.memory == "none":
        width = n_features(space, network.convolutions, VALUE_WIDTH)
    expecting = _features(config, spec, VALUE_WIDTH, VALUE_WIDTH) + width * VALUE_WIDTH
    networks = {"none": 0, "value": 1, "action_value": 2}[network.baseline]
    examples = training.n_updates_per_iter * training.batch_size
    operations = _OF_AN_UPDATE * examples * (acting + networks * expecting)
    return operations / _PER_SECOND / config.arithmetic.training_threads


def slow(config: Config, spec: EnvironmentSpec) -> str:
    """Return a sentence about what makes training slow; empty where nothing does."""
    seconds, seen = training_s(config, spec), spec.observation_space
    if seconds < _LONG_S or config.arithmetic.device == "cuda":
        return ""
    training = config.training
    what = f"examples of {seen}"
    remedies = "n_updates_per_iter, batch_size or hidden"
    if any(isinstance(leaf.space, Image) for leaf in leaves_of(seen)):
        remedies = (
            "n_updates_per_iter, batch_size or convolutions, or make the pictures smaller "
            "(gymnasium.wrappers.ResizeObservation)"
        )
    return (
        f"every iteration will train for about {seconds / 60:.0f} minutes on a CPU "
        f"({training.n_updates_per_iter} updates of {training.batch_size} {what}); lower {remedies}"
    )


def _features(config: Config, spec: EnvironmentSpec, width: int, remembered: int) -> float:
    """Return multiplications of an encoder and of the memory behind it, for one observation."""
    network = config.network
    encoding = _encoder(config, spec, width)
    if network.memory == "none":
        return encoding
    n_in = n_features(spec.observation_space, network.convolutions, width)
    return encoding + 3 * remembered * (n_in + remembered)


def _encoder(config: Config, spec: EnvironmentSpec, width: int) -> float:
    """Return multiplications of an encoder for one observation."""
    space, network = spec.observation_space, config.network
    shapes = FrameStack(space, network.frame_stack).shapes
    leaves = [leaf.space for leaf in leaves_of(space)]
    encoding = sum(
        _leaf(leaf, shape[0], network, width) for leaf, shape in zip(leaves, shapes, strict=True)
    )
    if not isinstance(space, Record):
        return encoding
    return encoding + width * sum(n_features(leaf, network.convolutions, width) for leaf in leaves)


def _leaf(space: LeafSpace, depth: int, network: NetworkSettings, width: int) -> float:
    if not isinstance(space, Image):
        return depth * width
    channels = (depth, *network.convolutions)
    sizes = image_sizes(space, len(network.convolutions))
    return sum(
        math.prod(size) * FILTER**2 * n_in * n_out
        for size, (n_in, n_out) in zip(sizes, pairwise(channels), strict=True)
    )
