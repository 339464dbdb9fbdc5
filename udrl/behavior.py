"""Section 2.3.2: the behavior function, B(s, c; theta), from observation and command to actions.

Its architecture is section 3.2's: the command, scaled by fixed factors, passes a fully connected
sigmoid layer and is multiplied element-wise with the embedding of the observation after the first
layer; fully connected layers follow.
"""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from udrl.config import Config
from udrl.environments.making import EnvironmentSpec
from udrl.streams import Purpose, Stream, stream_key

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
        # The same parameters, without nn.Module's lookups and calls: those cost more than a third
        # of the time of a call on 16 rows.
        self._parts = tuple(
            (layer.weight, layer.bias)
            for layer in (self.observation, self.command, *self.layers, self.action)
        )

    def forward(self, observation: Tensor, command: Tensor) -> Tensor:
        """Return the logits of P(a | s, c).

        Args:
            observation: s, float32 [batch, observation_size].
            command: (desired return, desired horizon), each scaled, float32 [batch, 2].

        Returns:
            float32 [batch, n_actions].
        """
        first, gate, *layers, action = self._parts
        activation = self._activation
        embedding = activation(linear(observation, *first))
        embedding = embedding * torch.sigmoid(linear(command, *gate))
        for layer in layers:
            embedding = activation(linear(embedding, *layer))
        return linear(embedding, *action)


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
