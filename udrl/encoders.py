"""From what is observed to a vector of features (section 3.2, Appendix B.2).

A vector passes one fully connected layer, a category has an embedding, an image passes
convolutions, each with a 3x3 filter and a stride of 2. The behavior function and the value function
(:mod:`udrl.value`) each have an encoder of their own. :mod:`udrl.graph` has the same for acting.
"""

from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from udrl.architecture import FILTER, PADDING, STRIDE
from udrl.memory import FrameStack
from udrl.setting_groups import NetworkSettings
from udrl.spaces import Category, Image, ObservationSpace

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

    def forward(self, observation: Tensor) -> Tensor:
        """Return features, [batch, n_features], of observations as the networks see them."""
        raise NotImplementedError


class VectorEncoder(Encoder):
    """One fully connected layer."""

    def __init__(
        self, size: int, width: int, activation: Activation, precision: torch.dtype
    ) -> None:
        super().__init__(activation, precision)
        self.layer = fully_connected(size, width)

    def forward(self, observation: Tensor) -> Tensor:
        """Return features, [batch, width], of float32 [batch, size]."""
        return self._activation(apply(self.layer, observation.to(self._precision)))


class CategoryEncoder(Encoder):
    """A learned vector for each category, at each place of the stack; their sum."""

    def __init__(
        self, n: int, length: int, width: int, activation: Activation, precision: torch.dtype
    ) -> None:
        super().__init__(activation, precision)
        self.embedding = nn.utils.skip_init(nn.Embedding, length * n, width)
        self.bias = nn.Parameter(torch.zeros(width))
        self.register_buffer("first", torch.arange(length) * n, persistent=False)
        self.first: Tensor

    def forward(self, observation: Tensor) -> Tensor:
        """Return features, [batch, width], of int32 [batch, length]."""
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

    def forward(self, observation: Tensor) -> Tensor:
        """Return features, [batch, n_features], of uint8 [batch, channels, height, width]."""
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
    shape = FrameStack(space, network.frame_stack).shape
    match space:
        case Image():
            return ImageEncoder(shape[0], network.convolutions, activation, precision)
        case Category(n=n):
            return CategoryEncoder(n, shape[0], width, activation, precision)
    return VectorEncoder(shape[0], width, activation, precision)
