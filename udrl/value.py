"""A value function, and desired returns relative to it. Not in the paper, which has none.

One action changes an episode's return by little; states and luck decide most of it. So the behavior
function learns little from whole returns, and hardly reads the desired return. With ``baseline =
"value"`` a second network learns V(s), the return to expect from a state, and D(s), by how much
returns deviate from it. They serve twice:

- Examples are labelled with lambda-returns instead of observed ones: after a few steps V stands for
  the rewards that follow (``return_lambda``).
- The behavior function reads (desired return - V(s)) / D(s). In training that is what an action
  gained, the generalised advantage estimate of Schulman et al. (2016), in units that are alike in
  all states. In acting it asks for better or worse than usual, until V(s) is what is desired.

Where chance decides, what an action gained was luck for the most part, and an agent that is asked
for the best of it gambles. With ``baseline = "action_value"`` a third network, the critic, learns
Q(s, a), what an action brings on average. V and D are then learned from Q, and what the behavior
function reads in training is (Q(s, a) - V(s)) / D(s).
"""

import torch
from torch import Tensor, nn

from udrl.action_losses import of_action
from udrl.architecture import DEVIATIONS, LEAST_DEVIATION, SQUAREPLUS, VALUE_WIDTH, n_features
from udrl.encoders import apply, fully_connected, make_encoder
from udrl.environments.making import EnvironmentSpec
from udrl.recurrence import Memory
from udrl.setting_groups import NetworkSettings


class _Expectation(nn.Module):
    """What to expect of an observation: an encoder and two layers.

    Args:
        spec: observation space.
        network: ``frame_stack``, ``convolutions`` (of images).
        precision: that it computes in.
        n: numbers that are expected.
    """

    def __init__(
        self, spec: EnvironmentSpec, network: NetworkSettings, precision: torch.dtype, n: int
    ) -> None:
        super().__init__()
        space = spec.observation_space
        self.encoder = make_encoder(space, network, VALUE_WIDTH, torch.tanh_, precision)
        width = n_features(space, network.convolutions, VALUE_WIDTH)
        self.memory = None if network.memory == "none" else Memory(width, VALUE_WIDTH)
        self.hidden = fully_connected(width if self.memory is None else VALUE_WIDTH, VALUE_WIDTH)
        self.expected = fully_connected(VALUE_WIDTH, n)

    def expect(
        self, seen: tuple[Tensor, ...], state: Tensor | None
    ) -> tuple[Tensor, Tensor | None]:
        """Return what is expected, and with a memory its state after each window.

        Args:
            seen: s, as the networks see it, [batch, *shape] each.
            state: with a memory, before each window, float32 [windows, VALUE_WIDTH].

        Returns:
            float32 [batch, n], float32 [windows, VALUE_WIDTH].
        """
        features = self.encoder(*seen)
        if self.memory is not None:
            features, state = self.memory(features, state)
        features = torch.tanh_(apply(self.hidden, features))
        return apply(self.expected, features).float(), state


class ValueFunction(_Expectation):
    """V(s) and D(s): the scaled return to expect, and its mean absolute deviation.

    Args:
        spec: observation space.
        network: ``frame_stack``, ``convolutions`` (of images).
        precision: that it computes in.
    """

    def __init__(
        self, spec: EnvironmentSpec, network: NetworkSettings, precision: torch.dtype
    ) -> None:
        super().__init__(spec, network, precision, 2)

    def forward(self, seen: tuple[Tensor, ...], state: Tensor | None = None) -> Tensor:
        """Return (V(s), D(s)), float32 [batch, 2].

        Args:
            seen: s, as the networks see it (:mod:`udrl.memory`), [batch, *shape] of each leaf.
            state: with a memory, before each window, float32 [windows, VALUE_WIDTH].
        """
        return self.value_of(self.expect(seen, state)[0])

    def value_of(self, expected: Tensor) -> Tensor:
        """Return (V, D), float32 [batch, 2], from what is expected."""
        value, d = expected.unbind(1)
        deviation = (d + (d * d + SQUAREPLUS).sqrt()) * 0.5 + LEAST_DEVIATION
        return torch.stack([value, deviation], dim=1)


class Critic(_Expectation):
    """Q(s, .): the scaled return to expect after each action. Only the learner needs it.

    Args:
        spec: observation and action space.
        network: ``frame_stack``, ``convolutions`` (of images).
        precision: that it computes in.
    """

    def __init__(
        self, spec: EnvironmentSpec, network: NetworkSettings, precision: torch.dtype
    ) -> None:
        super().__init__(spec, network, precision, spec.action_space.n_parameters)
        self._actions = spec.action_space

    def forward(
        self, seen: tuple[Tensor, ...], action: Tensor, state: Tensor | None = None
    ) -> Tensor:
        """Return Q(s, a), float32 [batch].

        Args:
            seen: s, as the networks see it (:mod:`udrl.memory`), [batch, *shape] of each leaf.
            action: a, int64 [batch], or [batch, components].
            state: with a memory, before each window, float32 [windows, VALUE_WIDTH].
        """
        return self.value_of(self.expect(seen, state)[0], action)

    def value_of(self, expected: Tensor, action: Tensor) -> Tensor:
        """Return Q, float32 [batch], from what is expected of each action."""
        return of_action(self._actions, expected, action)


def value_loss(expected: Tensor, label: Tensor) -> Tensor:
    """Return the loss of (V(s), D(s)), [batch, 2], for lambda-returns, scaled, float32 [batch]."""
    error = label - expected[:, 0]
    return error.square().mean() + (error.detach().abs() - expected[:, 1]).square().mean()


def relative(command: Tensor, expected: Tensor) -> Tensor:
    """Return scaled commands, [..., 2], with the desired return relative to what is expected.

    Args:
        command: (desired return, desired horizon), each scaled, float32 [..., 2].
        expected: (V(s), D(s)), float32 [..., 2].
    """
    above = (command[..., 0] - expected[..., 0]) / expected[..., 1]
    return torch.stack([above.clamp(-DEVIATIONS, DEVIATIONS), command[..., 1]], dim=-1)
