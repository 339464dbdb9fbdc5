"""From what is observed to a vector of features (section 3.2, Appendix B.2).

A vector passes one fully connected layer, a category has an embedding, an image passes
convolutions, each with a 3x3 filter and a stride of 2. The leaves of a record have an encoder each,
and a fully connected layer joins their features. The behavior function and the value function
(:mod:`udrl.value`) each have an encoder of their own. :mod:`udrl.graph` has the same for acting.
"""

from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from udrl.architecture import FILTER, NORMAL_BOUND, PADDING, STRIDE, n_features
from udrl.memory import FrameStack
from udrl.setting_groups import NetworkSettings
from udrl.spaces import Categories, Category, Image, LeafSpace, ObservationSpace, Record, Vector

Activation = Callable[[Tensor], Tensor]

# In place, to touch less memory: the gradient of a layer needs its input only.
ACTIVATIONS: dict[str, Activation] = {"relu": torch.relu_, "tanh": torch.tanh_}

PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16}


def fully_connected(n_in: int, n_out: int) -> nn.Linear:
    """Return a layer whose values come from ``initialise`` or a checkpoint."""
    layer: nn.Linear = nn.utils.skip_init(nn.Linear, n_in, n_out)
    return layer


def apply(layer: nn.Linear, features: Tensor) -> Tensor:
    """Return a layer's output, [batch, n_out], computed in the precision of the features."""
    dtype = features.dtype
    return torch.addmm(layer.bias.to(dtype), features, layer.weight.to(dtype).t())


class Encoder(nn.Module):
    """Features of observations of one kind.

    Args:
        activation: after each layer.
        precision: that it computes in.
    """

    def __init__(self, activation: Activation, precision: torch.dtype) -> None:
        super().__init__()
        self._activation = activation
        self._precision = precision

    def forward(self, *seen: Tensor) -> Tensor:
        """Return features, [batch, n_features], of what the networks see (:mod:`udrl.memory`)."""
        raise NotImplementedError

    def normalise(self, leaf: int, mean: Tensor, deviation: Tensor) -> None:
        """Set what the numbers of a leaf are relative to, float64 [size]."""
        raise NotImplementedError


class Normaliser(nn.Module):
    """Numbers relative to their mean in the warm-up, in units of their deviation there.

    Args:
        size: of the vectors.
    """

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))
        self.mean: Tensor
        self.scale: Tensor

    def set(self, mean: Tensor, deviation: Tensor) -> None:
        """Set both, float64 [size]; what does not vary keeps its unit."""
        self.mean.copy_(mean)
        self.scale.copy_(1 / torch.where(deviation > 0, deviation, 1))

    def forward(self, observation: Tensor) -> Tensor:
        """Return float32 [batch, size], bounded."""
        return ((observation - self.mean) * self.scale).clamp(-NORMAL_BOUND, NORMAL_BOUND)


class VectorEncoder(Encoder):
    """One fully connected layer, of normalised numbers if that is wanted."""

    def __init__(
        self,
        size: int,
        width: int,
        activation: Activation,
        precision: torch.dtype,
        *,
        normalised: bool,
    ) -> None:
        super().__init__(activation, precision)
        self.normaliser = Normaliser(size) if normalised else None
        self.layer = fully_connected(size, width)

    def forward(self, *seen: Tensor) -> Tensor:
        """Return features, [batch, width], of numbers, [batch, size]."""
        (observation,) = seen
        if self.normaliser is not None:
            observation = self.normaliser(observation)
        return self._activation(apply(self.layer, observation.to(self._precision)))

    def normalise(self, leaf: int, mean: Tensor, deviation: Tensor) -> None:
        """Set what the numbers are relative to, float64 [size]."""
        assert self.normaliser is not None, leaf
        self.normaliser.set(mean, deviation)


class CategoryEncoder(Encoder):
    """A learned vector for each category of each component, at each place of the stack; their sum.

    Args:
        ns: categories of each component.
        length: of the stack.
        width: of the vectors.
        activation: of the sum.
        precision: that it computes in.
    """

    def __init__(
        self,
        ns: tuple[int, ...],
        length: int,
        width: int,
        activation: Activation,
        precision: torch.dtype,
    ) -> None:
        super().__init__(activation, precision)
        sizes = torch.tensor(ns * length)
        self.embedding = nn.utils.skip_init(nn.Embedding, int(sizes.sum()), width)
        self.bias = nn.Parameter(torch.zeros(width))
        self.register_buffer("first", sizes.cumsum(0) - sizes, persistent=False)
        self.first: Tensor

    def forward(self, *seen: Tensor) -> Tensor:
        """Return features, [batch, width], of int32 [batch, length * components]."""
        (observation,) = seen
        vectors: Tensor = self.embedding(observation + self.first)
        return self._activation((vectors.sum(1) + self.bias).to(self._precision))


class ImageEncoder(Encoder):
    """Convolutions."""

    def __init__(
        self,
        n_channels: int,
        channels: tuple[int, ...],
        activation: Activation,
        precision: torch.dtype,
    ) -> None:
        super().__init__(activation, precision)
        self.layers = nn.ModuleList(
            nn.utils.skip_init(nn.Conv2d, i, o, FILTER, STRIDE, PADDING)
            for i, o in pairwise((n_channels, *channels))
        )

    def forward(self, *seen: Tensor) -> Tensor:
        """Return features, [batch, n_features], of uint8 [batch, channels, height, width]."""
        (observation,) = seen
        features = observation.to(self._precision) * (1 / 255)
        features = features.contiguous(memory_format=torch.channels_last)
        for layer in self.layers:
            assert isinstance(layer, nn.Conv2d)
            assert layer.bias is not None
            weight, bias = layer.weight.to(self._precision), layer.bias.to(self._precision)
            weight = weight.contiguous(memory_format=torch.channels_last)
            convolved = functional.conv2d(features, weight, bias, STRIDE, PADDING)
            features = self._activation(convolved)
        return features.flatten(1)


class RecordEncoder(Encoder):
    """An encoder for each leaf, and a fully connected layer from all their features.

    Args:
        encoders: of the leaves.
        n_features: that they make together.
        width: of the layer.
        activation: after it.
        precision: that it computes in.
    """

    def __init__(
        self,
        encoders: list[Encoder],
        n_features: int,
        width: int,
        activation: Activation,
        precision: torch.dtype,
    ) -> None:
        super().__init__(activation, precision)
        self.leaves = nn.ModuleList(encoders)
        self.joined = fully_connected(n_features, width)

    def forward(self, *seen: Tensor) -> Tensor:
        """Return features, [batch, width], of all leaves."""
        features = [leaf(one) for leaf, one in zip(self.leaves, seen, strict=True)]
        return self._activation(apply(self.joined, torch.cat(features, 1)))

    def normalise(self, leaf: int, mean: Tensor, deviation: Tensor) -> None:
        """Set what the numbers of a leaf are relative to, float64 [size]."""
        encoder = self.leaves[leaf]
        assert isinstance(encoder, Encoder)
        encoder.normalise(leaf, mean, deviation)


def make_encoder(
    space: ObservationSpace,
    network: NetworkSettings,
    width: int,
    activation: Activation,
    precision: torch.dtype,
) -> Encoder:
    """Return an encoder of a kind of observations.

    Args:
        space: of single observations.
        network: ``frame_stack``, ``convolutions``.
        width: of the features; what an image's convolutions leave is as wide as it is.
        activation: after each layer.
        precision: that it computes in.
    """
    if not isinstance(space, Record):
        return _of_leaf(space, network, width, activation, precision)
    leaves = [leaf.space for leaf in space.leaves]
    encoders = [_of_leaf(leaf, network, width, activation, precision) for leaf in leaves]
    together = sum(n_features(leaf, network.convolutions, width) for leaf in leaves)
    return RecordEncoder(encoders, together, width, activation, precision)


def _of_leaf(
    space: LeafSpace,
    network: NetworkSettings,
    width: int,
    activation: Activation,
    precision: torch.dtype,
) -> Encoder:
    length = network.frame_stack
    (shape,) = FrameStack(space, length).shapes
    match space:
        case Image():
            return ImageEncoder(shape[0], network.convolutions, activation, precision)
        case Category(n=n):
            return CategoryEncoder((n,), length, width, activation, precision)
        case Categories(ns=ns):
            return CategoryEncoder(ns, length, width, activation, precision)
    normalised = network.normalise_observations and isinstance(space, Vector)
    return VectorEncoder(shape[0], width, activation, precision, normalised=normalised)
