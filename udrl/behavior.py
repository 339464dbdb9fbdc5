"""Section 2.3.2: the behavior function, B(s, c; theta), from observation and command to actions.

Its architecture is section 3.2's. The observation is embedded: a vector by a fully connected layer,
an image by convolutions. The command, scaled by fixed factors, passes a fully connected sigmoid
layer and is multiplied element-wise with the embedding; fully connected layers follow.
"""

import math
from collections.abc import Callable
from functools import partial
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from udrl.config import Config
from udrl.environments.making import EnvironmentSpec
from udrl.streams import Purpose, Stream, stream_key

#: From observation [n, *observation_shape] and scaled command [n, 2] to logits [n, n_actions].
Acting = Callable[[Tensor, Tensor], Tensor]

_Layers = list[tuple[Tensor, Tensor]]

# In place, to touch less memory: the gradient of a layer needs its input only.
_ACTIVATIONS = {"relu": torch.relu_, "tanh": torch.tanh_}

_PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16}

# Appendix B.2.
_FILTER, _STRIDE, _PADDING = 3, 2, 1


class BehaviorFunction(nn.Module):
    """B(s, c; theta) for vectors or images, and discrete actions.

    Args:
        spec: sizes of observation and action space.
        config: ``frame_stack``, ``convolutions`` (of images), ``hidden``, ``activation``,
            ``precision``.
    """

    def __init__(self, spec: EnvironmentSpec, config: Config) -> None:
        super().__init__()
        self._activation = _ACTIVATIONS[config.activation]
        self._precision = _PRECISIONS[config.precision]
        self.observation_shape = stacked_shape(spec, config)
        # skip_init: values come from `initialise` or a checkpoint, never from torch's global state.
        if spec.is_image:
            channels = (self.observation_shape[0], *config.convolutions)
            self.convolutions = nn.ModuleList(
                nn.utils.skip_init(nn.Conv2d, i, o, _FILTER, _STRIDE, _PADDING)
                for i, o in pairwise(channels)
            )
            first = _embedding_size(self.observation_shape, config.convolutions)
            widths = (first, *config.hidden)
        else:
            first, *_ = widths = config.hidden
            self.observation = nn.utils.skip_init(nn.Linear, self.observation_shape[0], first)
        self.command = nn.utils.skip_init(nn.Linear, 2, first)
        self.layers = nn.ModuleList(
            nn.utils.skip_init(nn.Linear, i, o) for i, o in pairwise(widths)
        )
        self.action = nn.utils.skip_init(nn.Linear, widths[-1], spec.n_actions)

    def forward(self, observation: Tensor, command: Tensor) -> Tensor:
        """Return the logits of P(a | s, c).

        Args:
            observation: s, [batch, *observation_shape]: float32 vectors or uint8 images.
            command: (desired return, desired horizon), each scaled, float32 [batch, 2].

        Returns:
            float32 [batch, n_actions].
        """
        return self._logits(self._tensors(), observation, command)

    def frozen(self) -> Acting:
        """Return what acts: :meth:`forward`, the same bits, without gradients or nn.Module.

        It shares the weights, unless they are rounded. On 16 vectors it takes three quarters of
        the time.
        """
        return partial(self._logits, [(w.detach(), b.detach()) for w, b in self._tensors()])

    def _tensors(self) -> _Layers:
        """Return weights and biases as they are used: fully connected ones transposed."""
        embedding = self.convolutions if self.is_convolutional else (self.observation,)
        tensors = []
        for layer in (*embedding, self.command, *self.layers, self.action):
            assert isinstance(layer, nn.Conv2d | nn.Linear)
            assert layer.bias is not None
            weight, bias = layer.weight.to(self._precision), layer.bias.to(self._precision)
            if isinstance(layer, nn.Conv2d):
                weight = weight.contiguous(memory_format=torch.channels_last)
            else:
                weight = weight.t()
            tensors.append((weight, bias))
        return tensors

    @property
    def is_convolutional(self) -> bool:
        """Whether observations are images."""
        return len(self.observation_shape) > 1

    def _logits(self, layers: _Layers, observation: Tensor, command: Tensor) -> Tensor:
        activation = self._activation
        n_embedding = len(self.convolutions) if self.is_convolutional else 1
        embedding_layers, others = layers[:n_embedding], layers[n_embedding:]
        (gate_weight, gate_bias), *hidden, (action_weight, action_bias) = others
        embedding = observation.to(self._precision)
        if self.is_convolutional:
            embedding = (embedding * (1 / 255)).contiguous(memory_format=torch.channels_last)
            for weight, bias in embedding_layers:
                embedding = activation(
                    functional.conv2d(embedding, weight, bias, _STRIDE, _PADDING)
                )
            embedding = embedding.flatten(1)
        else:
            ((weight, bias),) = embedding_layers
            embedding = activation(torch.addmm(bias, embedding, weight))
        gate = torch.sigmoid(torch.addmm(gate_bias, command.to(self._precision), gate_weight))
        embedding = embedding * gate
        for weight, bias in hidden:
            embedding = activation(torch.addmm(bias, embedding, weight))
        return torch.addmm(action_bias, embedding, action_weight).float()


def stacked_shape(spec: EnvironmentSpec, config: Config) -> tuple[int, ...]:
    """Return the shape of what the network observes: the most recent frames, one after another."""
    first, *rest = spec.observation_shape
    return (config.frame_stack * first, *rest)


def _embedding_size(shape: tuple[int, ...], convolutions: tuple[int, ...]) -> int:
    _, *size = shape
    for _ in convolutions:
        size = [(n + 2 * _PADDING - _FILTER) // _STRIDE + 1 for n in size]
    return convolutions[-1] * math.prod(size)


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
            hidden = name not in ("command", "action")
            nn.init.orthogonal_(layer.weight, gain if hidden else 1.0, generator)
            nn.init.zeros_(layer.bias)
        else:
            nn.init.uniform_(layer.weight, -bound, bound, generator)
            nn.init.uniform_(layer.bias, -bound, bound, generator)
    return behavior
