"""Section 2.3.2: the behavior function, B(s, c; theta), from observation and command to actions.

Its architecture is section 3.2's. The observation is embedded: a vector by a fully connected layer,
an image by convolutions. The command, scaled by fixed factors, passes a fully connected sigmoid
layer and is multiplied element-wise with the embedding; fully connected layers follow.
"""

from itertools import pairwise

import torch
from torch import Tensor, nn

from udrl.architecture import image_features, stacked_shape
from udrl.config import Config
from udrl.encoders import (
    ACTIVATIONS,
    PRECISIONS,
    convolutions,
    encode,
    fully_connected,
    tensors,
)
from udrl.environments.making import EnvironmentSpec
from udrl.streams import Purpose, Stream, stream_key
from udrl.value import ValueFunction, relative


class BehaviorFunction(nn.Module):
    """B(s, c; theta) for vectors or images, and discrete actions.

    Args:
        spec: sizes of observation and action space.
        config: ``frame_stack``, ``convolutions`` (of images), ``hidden``, ``activation``,
            ``precision``, ``baseline``.

    Attributes:
        value: what desired returns are relative to; None where ``baseline`` is ``none``.
    """

    def __init__(self, spec: EnvironmentSpec, config: Config) -> None:
        super().__init__()
        self._activation = ACTIVATIONS[config.activation]
        self._precision = PRECISIONS[config.precision]
        self.observation_shape = shape = stacked_shape(spec, config)
        if spec.is_image:
            self.convolutions = convolutions(shape, config.convolutions)
            first = image_features(shape, config.convolutions)
            widths = (first, *config.hidden)
        else:
            first, *_ = widths = config.hidden
            self.observation = fully_connected(shape[0], first)
        self.command = fully_connected(2, first)
        self.layers = nn.ModuleList(fully_connected(i, o) for i, o in pairwise(widths))
        self.action = fully_connected(widths[-1], spec.n_actions)
        self.value = ValueFunction(spec, config) if config.baseline == "value" else None

    def forward(self, observation: Tensor, command: Tensor) -> Tensor:
        """Return the logits of P(a | s, c).

        Args:
            observation: s, [batch, *observation_shape]: float32 vectors or uint8 images.
            command: (desired return, desired horizon), each scaled, float32 [batch, 2].

        Returns:
            float32 [batch, n_actions].
        """
        if self.value is not None:
            with torch.no_grad():
                expected = self.value(observation)
            command = relative(command, expected)
        encoder = tuple(self.convolutions) if self.is_convolutional else (self.observation,)
        features = encode(tensors(encoder, self._precision), observation, self._activation)
        (gate_weight, gate_bias), *hidden, (action_weight, action_bias) = tensors(
            (self.command, *self.layers, self.action), self._precision
        )
        gate = torch.sigmoid(torch.addmm(gate_bias, command.to(self._precision), gate_weight))
        features = features * gate
        for weight, bias in hidden:
            features = self._activation(torch.addmm(bias, features, weight))
        return torch.addmm(action_bias, features, action_weight).float()

    @property
    def is_convolutional(self) -> bool:
        """Whether observations are images."""
        return len(self.observation_shape) > 1


def initialise(config: Config, spec: EnvironmentSpec) -> BehaviorFunction:
    """Return the behavior function of weights version 0, a function of the run's seed."""
    behavior = BehaviorFunction(spec, config)
    stream = Stream(stream_key(config.seed, Purpose.INITIALISE))
    generator = torch.Generator().manual_seed(int(stream.integers(1, 0, 2**52)[0]))
    gain = nn.init.calculate_gain(config.activation)
    for name, layer in behavior.named_modules():
        if not isinstance(layer, nn.Linear | nn.Conv2d):
            continue
        bound = layer.weight[0].numel() ** -0.5
        assert layer.bias is not None
        if config.initialisation == "orthogonal":
            hidden = name not in ("command", "action", "value.expected")
            nn.init.orthogonal_(layer.weight, gain if hidden else 1.0, generator)
            nn.init.zeros_(layer.bias)
        else:
            nn.init.uniform_(layer.weight, -bound, bound, generator)
            nn.init.uniform_(layer.bias, -bound, bound, generator)
    return behavior
