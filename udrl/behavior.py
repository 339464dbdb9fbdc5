"""Section 2.3.2: the behavior function B(s, c; theta), which maps observation and command to P(a).

Its architecture is that of section 3.2. An encoder computes features of the observation. The
command, scaled by fixed factors, passes a fully connected sigmoid layer and is multiplied
element-wise with the features; fully connected layers follow. With a ``memory``, the features
summarise all observations of the episode so far (:mod:`udrl.recurrence`), and each network has a
state.
"""

from itertools import pairwise

import torch
from torch import Tensor, nn

from udrl.action_losses import negative_log_likelihood
from udrl.architecture import FORBIDDEN, GUIDANCE, layer_widths, n_features
from udrl.config import Config
from udrl.custom_networks import make_custom
from udrl.encoders import ACTIVATIONS, PRECISIONS, apply, fully_connected, make_encoder
from udrl.environments.specification import EnvironmentSpec
from udrl.initialisation import draw_weights
from udrl.recurrence import Memory
from udrl.setting_groups import NetworkSettings
from udrl.streams import Purpose, Stream, stream_key
from udrl.targets import ReturnInTime
from udrl.value import ValueFunction, relative, with_return


class BehaviorFunction(nn.Module):
    """B(s, c; theta).

    Args:
        spec: observation and action space.
        config: the settings of ``network``, and ``precision``.

    Attributes:
        value: value function that desired returns are relative to; None without a ``baseline``.
        guidance: g and the return of c', float32 [1, 2] (:mod:`udrl.guidance`); None without
            guidance.
    """

    def __init__(self, spec: EnvironmentSpec, config: Config) -> None:
        super().__init__()
        network, precision = config.network, PRECISIONS[config.arithmetic.precision]
        self._activation = ACTIVATIONS[network.activation]
        self.spec = spec
        self.custom: nn.Module | None = None
        self.memory: Memory | None = None
        if network.behavior is not None:
            self.custom = make_custom(network, spec)
        else:
            self._assemble(spec, network, precision)
        self.bound = network.advantage_bound
        self.guidance: Tensor | None
        self.register_buffer(GUIDANCE, torch.zeros(1, 2) if network.is_guided else None)
        self.value = None if network.baseline == "none" else ValueFunction(spec, network, precision)

    def _assemble(
        self, spec: EnvironmentSpec, network: NetworkSettings, precision: torch.dtype
    ) -> None:
        """Create the layers of section 3.2."""
        activation = self._activation
        first, *_ = widths = layer_widths(spec.observation_space, network)
        space, width = spec.observation_space, network.hidden[0]
        self.encoder = make_encoder(space, network, width, activation, precision)
        if network.memory != "none":
            n_in = n_features(space, network.convolutions, width)
            self.memory = Memory(n_in, network.memory_size)
        self.command = fully_connected(ReturnInTime.size, first)
        self.layers = nn.ModuleList(fully_connected(i, o) for i, o in pairwise(widths))
        self.action = fully_connected(widths[-1], spec.action_space.n_parameters)

    def forward(
        self, seen: tuple[Tensor, ...], command: Tensor, states: tuple[Tensor, ...] = ()
    ) -> Tensor:
        """Return the parameters of P(a | s, c), as in acting: with guidance.

        Args:
            seen: s, as the networks see it (:mod:`udrl.frame_stack`), [batch, *shape] for each
                leaf.
            command: (desired return, desired horizon), each scaled, float32 [batch, 2].
            states: with a memory, states of behavior and value function before the first step of
                each window, float32 [windows, size] each. A batch then consists of windows of
                consecutive steps.

        Returns:
            float32 [batch, n_parameters].
        """
        state, *others = states or (None, None)
        if self.value is not None:
            with torch.no_grad():
                command = relative(command, self.value(seen, others[0]), self.bound)
        parameters = self.forward_relative(seen, command, state)
        if self.guidance is None:
            return parameters
        factor, lowest = self.guidance[0].unbind()
        away = self.forward_relative(seen, with_return(command, lowest), state)
        return parameters + factor * (parameters - away)

    def forward_relative(
        self, seen: tuple[Tensor, ...], command: Tensor, state: Tensor | None = None
    ) -> Tensor:
        """Like :meth:`forward`, as in training: for commands relative to V(s), without guidance."""
        if self.custom is not None:
            return self._masked(seen, self.custom(*seen, command))
        features = self.encode(seen, state)[0]
        features = features * torch.sigmoid(apply(self.command, command.to(features.dtype)))
        for layer in self.layers:
            assert isinstance(layer, nn.Linear)
            features = self._activation(apply(layer, features))
        return self._masked(seen, apply(self.action, features).float())

    def _masked(self, seen: tuple[Tensor, ...], parameters: Tensor) -> Tensor:
        """Return parameters with a large negative number added to those of masked actions."""
        if self.spec.action_mask is None:
            return parameters
        allowed = seen[self.spec.action_mask][:, -self.spec.action_space.n_parameters :].float()
        return parameters - (allowed - 1.0) * FORBIDDEN

    def encode(
        self, seen: tuple[Tensor, ...], state: Tensor | None
    ) -> tuple[Tensor, Tensor | None]:
        """Return the features of observations, and the memory's state after each window."""
        features: Tensor = self.encoder(*seen)
        if self.memory is None:
            return features, None
        remembered: tuple[Tensor, Tensor] = self.memory(features, state)
        return remembered

    def loss(self, parameters: Tensor, action: Tensor) -> Tensor:
        """Return the mean of -ln P(a | s, c) over a batch.

        Args:
            parameters: float32 [batch, n_parameters], from :meth:`forward`.
            action: a, int64 [batch], or [batch, components].
        """
        return negative_log_likelihood(self.spec.action_space, parameters, action)


#: Index of the random stream that seeds torch's generator.
_TORCH_SEED = 2


def initialise(config: Config, spec: EnvironmentSpec) -> BehaviorFunction:
    """Return the behavior function of weights version 0, which depends only on the settings."""
    stream = Stream(stream_key(config.seed, Purpose.INITIALISE, index=_TORCH_SEED))
    with torch.random.fork_rng(devices=[]):
        # For custom networks, which draw their parameters themselves.
        torch.manual_seed(int(stream.integers(1, 0, 2**52)[0]))
        behavior = BehaviorFunction(spec, config)
    draw_weights(behavior, config, 0, ("command", "action", "value.expected"))
    return behavior
