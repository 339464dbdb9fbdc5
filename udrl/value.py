"""A value function, and desired returns relative to it. Not in the paper, which has none.

An episode's return is mostly decided by the states that the agent was in and by luck, and hardly by
one action; so the behavior function learns little from it, and soon reads the desired return no
more. With ``baseline = "value"`` a second network, V(s), learns what return to expect from a state.
It serves twice:

- Examples are labelled with lambda-returns instead of observed ones: what follows later counts less
  than what V expects, by ``return_lambda`` a step.
- The behavior function reads how far the desired return is above V(s), in standard deviations. In
  training that is what an action gained (the generalised advantage estimate of Schulman et al.,
  2016); in acting it says to do better or worse than usual, until V(s) fits the command.
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from udrl.config import Config
from udrl.encoders import (
    PRECISIONS,
    Layers,
    convolutions,
    encode,
    fully_connected,
    image_features,
    stacked_shape,
    tensors,
)
from udrl.environments.making import EnvironmentSpec

_WIDTH = 64

#: Relative desired returns are kept within so many standard deviations.
_LIMIT = 2.0


class ValueFunction(nn.Module):
    """V(s): the scaled return to expect from an observation on.

    Args:
        spec: size of the observation space.
        config: ``frame_stack``, ``convolutions`` (of images), ``precision``.
    """

    def __init__(self, spec: EnvironmentSpec, config: Config) -> None:
        super().__init__()
        self._precision = PRECISIONS[config.precision]
        shape = stacked_shape(spec, config)
        if spec.is_image:
            self.encoder = convolutions(shape, config.convolutions)
            features = image_features(shape, config.convolutions)
        else:
            self.encoder = nn.ModuleList([fully_connected(shape[0], _WIDTH)])
            features = _WIDTH
        self.hidden = fully_connected(features, _WIDTH)
        self.expected = fully_connected(_WIDTH, 1)

    def forward(self, observation: Tensor) -> Tensor:
        """Return V(s), float32 [batch].

        Args:
            observation: s, [batch, *observation_shape]: float32 vectors or uint8 images.
        """
        return self._expected(self._tensors(), observation)

    def frozen(self) -> Callable[[Tensor], Tensor]:
        """Return :meth:`forward`, the same bits, without gradients or nn.Module."""
        layers = [(w.detach(), b.detach()) for w, b in self._tensors()]
        return lambda observation: self._expected(layers, observation)

    def _tensors(self) -> list[tuple[Tensor, Tensor]]:
        return tensors((*self.encoder, self.hidden, self.expected), self._precision)

    def _expected(self, layers: Layers, observation: Tensor) -> Tensor:
        *encoder, (weight, bias), (out_weight, out_bias) = layers
        features = encode(encoder, observation, torch.tanh_)
        features = torch.tanh_(torch.addmm(bias, features, weight))
        return torch.addmm(out_bias, features, out_weight)[:, 0].float()


def relative(command: Tensor, expected: Tensor, deviation: Tensor) -> Tensor:
    """Return scaled commands, [batch, 2], with the desired return relative to what is expected.

    Args:
        command: (desired return, desired horizon), each scaled, float32 [batch, 2].
        expected: V(s), float32 [batch].
        deviation: standard deviation of lambda-returns around V.
    """
    above = (command[:, 0] - expected) / deviation
    return torch.stack([above.clamp(-_LIMIT, _LIMIT), command[:, 1]], dim=1)
