"""Section 2.3.2: the behavior function, B(s, c; theta), from observation and command to actions.

Its architecture is section 3.2's: the command, scaled by fixed factors, passes a fully connected
sigmoid layer and is multiplied element-wise with the embedding of the observation after the first
layer; fully connected layers follow.
"""

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import torch
from torch import Tensor, nn

from udrl.config import Config
from udrl.environments.making import EnvironmentSpec
from udrl.streams import Purpose, Stream, stream_key

#: From observation [n, observation_size] and scaled command [n, 2] to logits [n, n_actions].
Acting = Callable[[Tensor, Tensor], Tensor]

_Layers = list[tuple[Tensor, Tensor]]

# In place, to touch less memory: the gradient of a layer needs its input only.
_ACTIVATIONS = {"relu": torch.relu_, "tanh": torch.tanh_}


class BehaviorFunction(nn.Module):
    """B(s, c; theta) for vector observations and discrete actions.

    Args:
        spec: sizes of observation and action space.
        config: ``hidden``, ``activation``.
    """

    def __init__(self, spec: EnvironmentSpec, config: Config) -> None:
        super().__init__()
        first, *_ = widths = config.hidden
        self._activation = _ACTIVATIONS[config.activation]
        # skip_init: values come from `initialise` or a checkpoint, never from torch's global state.
        self.observation = nn.utils.skip_init(nn.Linear, spec.observation_size, first)
        self.command = nn.utils.skip_init(nn.Linear, 2, first)
        self.layers = nn.ModuleList(
            nn.utils.skip_init(nn.Linear, i, o) for i, o in pairwise(widths)
        )
        self.action = nn.utils.skip_init(nn.Linear, widths[-1], spec.n_actions)

    def forward(self, observation: Tensor, command: Tensor) -> Tensor:
        """Return the logits of P(a | s, c).

        Args:
            observation: s, float32 [batch, observation_size].
            command: (desired return, desired horizon), each scaled, float32 [batch, 2].

        Returns:
            float32 [batch, n_actions].
        """
        return _logits(self._activation, self._layers(), observation, command)

    def frozen(self) -> Acting:
        """Return what acts: :meth:`forward`, the same bits, without gradients or nn.Module.

        It shares the weights. On 16 rows it takes three quarters of the time.
        """
        layers = [(weight.detach(), bias.detach()) for weight, bias in self._layers()]
        return partial(_logits, self._activation, layers)

    def _layers(self) -> _Layers:
        layers = (self.observation, self.command, *self.layers, self.action)
        return [(layer.weight.t(), layer.bias) for layer in layers]


def _logits(
    activation: Callable[[Tensor], Tensor], layers: _Layers, observation: Tensor, command: Tensor
) -> Tensor:
    (weight, bias), (gate_weight, gate_bias), *hidden, (action_weight, action_bias) = layers
    embedding = activation(torch.addmm(bias, observation, weight))
    embedding = embedding * torch.sigmoid(torch.addmm(gate_bias, command, gate_weight))
    for weight, bias in hidden:
        embedding = activation(torch.addmm(bias, embedding, weight))
    return torch.addmm(action_bias, embedding, action_weight)


def initialise(config: Config, spec: EnvironmentSpec) -> BehaviorFunction:
    """Return the behavior function of weights version 0, a function of the run's seed."""
    behavior = BehaviorFunction(spec, config)
    stream = Stream(stream_key(config.seed, Purpose.INITIALISE))
    generator = torch.Generator().manual_seed(int(stream.integers(1, 0, 2**52)[0]))
    gain = nn.init.calculate_gain(config.activation)
    for name, layer in behavior.named_modules():
        if not isinstance(layer, nn.Linear):
            continue
        bound = layer.in_features**-0.5
        if config.initialisation == "orthogonal":
            hidden = name == "observation" or name.startswith("layers")
            nn.init.orthogonal_(layer.weight, gain if hidden else 1.0, generator)
            nn.init.zeros_(layer.bias)
        else:
            nn.init.uniform_(layer.weight, -bound, bound, generator)
            nn.init.uniform_(layer.bias, -bound, bound, generator)
    return behavior
