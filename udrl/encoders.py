"""Encoders: from observations to feature vectors (section 3.2, Appendix B.2).

A vector passes one fully connected layer, a category has an embedding, an image passes convolutions
with 3x3 filters and a stride of 2. Each leaf of a record has its own encoder, and a fully connected
layer joins their features. The behavior function, the value function and the critic
(:mod:`udrl.value`) each have their own encoder. :mod:`udrl.graph` has the same encoders for acting.
"""

from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from udrl.architecture import FILTER, NORMAL_BOUND, PADDING, STRIDE, n_features
from udrl.frame_stack import FrameStack
from udrl.setting_groups import NetworkSettings
from udrl.spaces import Categories, Category, Image, LeafSpace, ObservationSpace, Record, Vector

Activation = Callable[[Tensor], Tensor]

# In place, to save memory: a layer's gradient needs only its input.
ACTIVATIONS: dict[str, Activation] = {"relu": torch.relu_, "tanh": torch.tanh_}

PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16}


def fully_connected(n_in: int, n_out: int) -> nn.Linear:
    """Return an uninitialised layer; ``initialise`` or a checkpoint sets its parameters."""
    layer: nn.Linear = nn.utils.skip_init(nn.Linear, n_in, n_out)
    return layer


def apply(layer: nn.Linear, features: Tensor) -> Tensor:
    """Return a layer's output, [batch, n_out], computed in the precision of the features."""
    dtype = features.dtype
    return torch.addmm(layer.bias.to(dtype), features, layer.weight.to(dtype).t())


class Encoder(nn.Module):
    """Features of observations of one kind.

    Args:
        activation: activation after each layer.
        precision: dtype of the arithmetic.
    """

    def __init__(self, activation: Activation, precision: torch.dtype) -> None:
        super().__init__()
        self._activation = activation
        self._precision = precision

    def forward(self, *seen: Tensor) -> Tensor:
        """Return features, [batch, n_features], of observations (:mod:`udrl.frame_stack`)."""
        raise NotImplementedError

    def normalise(self, leaf: int, mean: Tensor, deviation: Tensor) -> None:
        """Set mean and standard deviation for the normalisation of a leaf, float64 [size] each.

        Args:
            leaf: index of the leaf in the observation space; it must be a vector.
            mean: mean of the leaf's elements.
            deviation: their standard deviation.
        """
        raise NotImplementedError


class Normaliser(nn.Module):
    """Normalises vectors by their mean and standard deviation in the warm-up.

    Args:
        size: size of the vectors.
    """

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))
        self.mean: Tensor
        self.scale: Tensor

    def set(self, mean: Tensor, deviation: Tensor) -> None:
        """Set mean and standard deviation, float64 [size]; constant elements are not rescaled."""
        self.mean.copy_(mean)
        self.scale.copy_(1 / torch.where(deviation > 0, deviation, 1))

    def forward(self, observation: Tensor) -> Tensor:
        """Return normalised and clipped vectors, float32 [batch, size]."""
        return ((observation - self.mean) * self.scale).clamp(-NORMAL_BOUND, NORMAL_BOUND)


class VectorEncoder(Encoder):
    """One fully connected layer, with optional normalisation of its input.

    Args:
        size: size of the vectors.
        width: number of features.
        activation: activation after the layer.
        precision: dtype of the arithmetic.
        normalised: whether the input is normalised.
    """

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
        """Return features, [batch, width], of vectors, [batch, size]."""
        (observation,) = seen
        if self.normaliser is not None:
            observation = self.normaliser(observation)
        return self._activation(apply(self.layer, observation.to(self._precision)))

    def normalise(self, leaf: int, mean: Tensor, deviation: Tensor) -> None:
        """Set mean and deviation for the normalisation, float64 [size]."""
        assert self.normaliser is not None, leaf
        self.normaliser.set(mean, deviation)


class CategoryEncoder(Encoder):
    """Sum of learned vectors: one per component and position in the stack, for its category.

    Args:
        ns: number of categories of each component.
        length: length of the stack.
        width: size of the vectors.
        activation: activation after the sum.
        precision: dtype of the features.
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
        # Not skip_init: it imports torch's compiler if it makes an embedding.
        vectors = torch.empty(int(sizes.sum()), width)
        self.embedding = nn.Embedding.from_pretrained(vectors, freeze=False)
        self.bias = nn.Parameter(torch.zeros(width))
        self.register_buffer("first", sizes.cumsum(0) - sizes, persistent=False)
        self.first: Tensor

    def forward(self, *seen: Tensor) -> Tensor:
        """Return features, [batch, width], of int32 [batch, length * components]."""
        (observation,) = seen
        vectors: Tensor = self.embedding(observation + self.first)
        return self._activation((vectors.sum(1) + self.bias).to(self._precision))


class ImageEncoder(Encoder):
    """Convolutions of images whose values are scaled to [0, 1].

    Args:
        n_channels: channels of the input: those of an image, times the length of the stack.
        channels: output channels of each layer.
        activation: activation after each layer.
        precision: dtype of the arithmetic.
    """

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
    """An encoder for each leaf, and a fully connected layer over all their features.

    Args:
        encoders: encoders of the leaves.
        n_features: total number of their features.
        width: width of the layer.
        activation: activation after the layer.
        precision: dtype of the arithmetic.
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
        """Set mean and deviation for the normalisation of a leaf, float64 [size]."""
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
    """Return the encoder for an observation space.

    Args:
        space: space of single observations.
        network: ``frame_stack``, ``convolutions``, ``normalise_observations``.
        width: number of features. Ignored for images: there, the convolutions determine it.
        activation: activation after each layer.
        precision: dtype of the arithmetic.
    """
    if not isinstance(space, Record):
        return _leaf_encoder(space, network, width, activation, precision)
    leaves = [leaf.space for leaf in space.leaves]
    encoders = [_leaf_encoder(leaf, network, width, activation, precision) for leaf in leaves]
    together = sum(n_features(leaf, network.convolutions, width) for leaf in leaves)
    return RecordEncoder(encoders, together, width, activation, precision)


def _leaf_encoder(
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
