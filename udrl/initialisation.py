"""Initial weights of the networks (Appendix B.2), which depend only on the run's settings."""

from collections.abc import Collection

import torch
from torch import nn

from udrl.architecture import is_custom
from udrl.config import Config
from udrl.streams import Purpose, Stream, stream_key


def draw_weights(
    module: nn.Module, config: Config, number: int, without_activation: Collection[str]
) -> None:
    """Draw all weights of a network, except for those that a custom network has drawn itself.

    Args:
        module: the network.
        config: ``seed``, ``initialisation``, ``activation``.
        number: number of the network in the run, from 0; each has its own random stream.
        without_activation: names of layers without an activation after them.
    """
    stream = Stream(stream_key(config.seed, Purpose.INITIALISE, index=number))
    generator = torch.Generator().manual_seed(int(stream.integers(1, 0, 2**52)[0]))
    gain = nn.init.calculate_gain(config.network.activation)
    for name, layer in module.named_modules():
        if is_custom(name):
            continue
        if isinstance(layer, nn.Embedding):
            # Vectors as different as possible, with the norm that a first layer with one-hot input
            # would give.
            nn.init.orthogonal_(layer.weight, 1.0, generator)
            with torch.no_grad():
                layer.weight.mul_(gain / layer.weight.norm(dim=1, keepdim=True))
        if isinstance(layer, nn.GRU):
            _draw_gates(layer, generator)
        if not isinstance(layer, nn.Linear | nn.Conv2d):
            continue
        bound = layer.weight[0].numel() ** -0.5
        assert layer.bias is not None
        if config.network.initialisation == "orthogonal":
            active = name not in without_activation
            nn.init.orthogonal_(layer.weight, gain if active else 1.0, generator)
            nn.init.zeros_(layer.bias)
        else:
            nn.init.uniform_(layer.weight, -bound, bound, generator)
            nn.init.uniform_(layer.bias, -bound, bound, generator)


def _draw_gates(layer: nn.GRU, generator: torch.Generator) -> None:
    """Draw the weights of a gated recurrent unit: each gate's are orthogonal, biases are 0."""
    for name, tensor in layer.named_parameters():
        if name.startswith("bias"):
            nn.init.zeros_(tensor)
            continue
        with torch.no_grad():
            for gate in tensor.chunk(3):
                nn.init.orthogonal_(gate, 1.0, generator)
