"""From an observation to a vector of features (section 3.2, Appendix B.2).

A vector passes one fully connected layer; an image passes convolutions, each with a 3x3 filter and
a stride of 2. The behavior function and the value function (:mod:`udrl.value`) each have an
encoder of their own.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from udrl.architecture import FILTER, PADDING, STRIDE

#: Weight and bias of each layer, those of fully connected layers transposed.
Layers = Sequence[tuple[Tensor, Tensor]]

Activation = Callable[[Tensor], Tensor]

# In place, to touch less memory: the gradient of a layer needs its input only.
ACTIVATIONS: dict[str, Activation] = {"relu": torch.relu_, "tanh": torch.tanh_}

PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16}


def fully_connected(n_in: int, n_out: int) -> nn.Linear:
    """Return a layer whose values come from ``initialise`` or a checkpoint."""
    layer: nn.Linear = nn.utils.skip_init(nn.Linear, n_in, n_out)
    return layer


def convolutions(shape: tuple[int, ...], channels: Sequence[int]) -> nn.ModuleList:
    """Return an image encoder's layers, for images of ``shape`` (channels, height, width)."""
    return nn.ModuleList(
        nn.utils.skip_init(nn.Conv2d, i, o, FILTER, STRIDE, PADDING)
        for i, o in pairwise((shape[0], *channels))
    )


def tensors(layers: Sequence[nn.Module], precision: torch.dtype) -> list[tuple[Tensor, Tensor]]:
    """Return weights and biases as the functions below use them."""
    pairs = []
    for layer in layers:
        assert isinstance(layer, nn.Conv2d | nn.Linear)
        assert layer.bias is not None
        weight, bias = layer.weight.to(precision), layer.bias.to(precision)
        if isinstance(layer, nn.Conv2d):
            weight = weight.contiguous(memory_format=torch.channels_last)
        else:
            weight = weight.t()
        pairs.append((weight, bias))
    return pairs


def encode(layers: Layers, observation: Tensor, activation: Activation) -> Tensor:
    """Return the features of observations.

    Args:
        layers: of the encoder.
        observation: [batch, *shape]: float32 vectors or uint8 images.
        activation: after each layer.

    Returns:
        [batch, n_features], in the layers' dtype.
    """
    features = observation.to(layers[0][0].dtype)
    if observation.dim() == 2:
        ((weight, bias),) = layers
        return activation(torch.addmm(bias, features, weight))
    features = (features * (1 / 255)).contiguous(memory_format=torch.channels_last)
    for weight, bias in layers:
        features = activation(functional.conv2d(features, weight, bias, STRIDE, PADDING))
    return features.flatten(1)
