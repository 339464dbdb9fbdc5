"""A value function as the baseline of desired returns. Not in the paper.

A single action has little effect on an episode's return, compared to the state and to chance.
Whole returns therefore teach the behavior function little, and it hardly uses the desired return.
With ``baseline = "value"`` a second network learns V(s), the expected return from a state, and
D(s), the mean absolute deviation of returns from V(s). They are used in two ways:

- Examples are labelled with lambda-returns instead of observed returns: after some steps, V
  replaces the rewards that follow (``return_lambda``).
- The behavior function reads (desired return - V(s)) / D(s). In training this is the generalised
  advantage estimate of Schulman et al. (2016), in units comparable between states. In acting it
  demands better or worse results than usual, until V(s) equals the desired return. Values are
  clipped to ``advantage_bound``; the larger it is, the further the agent goes beyond what it has
  usually done.

In stochastic environments, advantages are mostly luck, and an agent that is commanded to obtain
high ones takes risks. With ``baseline = "action_value"`` a third network, the critic, learns
Q(s, a), the expected return after an action. V and D are then learned from Q, and in training the
behavior function reads (Q(s, a) - V(s)) / D(s).
"""

import torch
from torch import Tensor, nn

from udrl.action_losses import of_action
from udrl.architecture import MIN_DEVIATION, SQUAREPLUS, VALUE_WIDTH, n_features
from udrl.encoders import apply, fully_connected, make_encoder
from udrl.environments.specification import EnvironmentSpec
from udrl.recurrence import Memory
from udrl.setting_groups import NetworkSettings


class _Expectation(nn.Module):
    """Common base of value function and critic: an encoder and two layers.

    Args:
        spec: specification of the environment.
        network: settings of the encoder, and ``memory``.
        precision: dtype of the arithmetic.
        n: number of outputs.
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
        """Return the outputs, and with a memory, its state after each window.

        Args:
            seen: s, as the networks see it (:mod:`udrl.frame_stack`), [batch, *shape] for each
                leaf.
            state: with a memory, its state before each window, float32 [windows, VALUE_WIDTH].

        Returns:
            float32 [batch, n], float32 [windows, VALUE_WIDTH].
        """
        features = self.encoder(*seen)
        if self.memory is not None:
            features, state = self.memory(features, state)
        features = torch.tanh_(apply(self.hidden, features))
        return apply(self.expected, features).float(), state


class ValueFunction(_Expectation):
    """V(s) and D(s): the expected scaled return, and its mean absolute deviation.

    Args:
        spec: specification of the environment.
        network: settings of the encoder, and ``memory``.
        precision: dtype of the arithmetic.
    """

    def __init__(
        self, spec: EnvironmentSpec, network: NetworkSettings, precision: torch.dtype
    ) -> None:
        super().__init__(spec, network, precision, 2)

    def forward(self, seen: tuple[Tensor, ...], state: Tensor | None = None) -> Tensor:
        """Return (V(s), D(s)), float32 [batch, 2]; see :meth:`expect` for the arguments."""
        return self.value_of(self.expect(seen, state)[0])

    def value_of(self, expected: Tensor) -> Tensor:
        """Return (V, D), float32 [batch, 2], from the network's outputs, [batch, 2]."""
        value, d = expected.unbind(1)
        deviation = (d + (d * d + SQUAREPLUS).sqrt()) * 0.5 + MIN_DEVIATION
        return torch.stack([value, deviation], dim=1)


class Critic(_Expectation):
    """Q(s, .): the expected scaled return after each action. Only the learner needs it.

    Args:
        spec: specification of the environment.
        network: settings of the encoder, and ``memory``.
        precision: dtype of the arithmetic.
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
            seen: s, as the networks see it (:mod:`udrl.frame_stack`), [batch, *shape] for each
                leaf.
            action: a, int64 [batch], or [batch, components].
            state: with a memory, its state before each window, float32 [windows, VALUE_WIDTH].
        """
        return self.value_of(self.expect(seen, state)[0], action)

    def value_of(self, expected: Tensor, action: Tensor) -> Tensor:
        """Return Q, float32 [batch], from the network's outputs, [batch, n_parameters]."""
        return of_action(self._actions, expected, action)


def value_loss(expected: Tensor, label: Tensor) -> Tensor:
    """Return the loss of (V(s), D(s)), [batch, 2], for scaled returns ``label``, [batch]."""
    error = label - expected[:, 0]
    return error.square().mean() + (error.detach().abs() - expected[:, 1]).square().mean()


def with_return(command: Tensor, desired_return: float | Tensor) -> Tensor:
    """Return commands, [..., 2], with another desired return, the same for all."""
    other = torch.zeros_like(command[..., 0]) + desired_return
    return torch.stack([other, command[..., 1]], dim=-1)


def relative(command: Tensor, expected: Tensor, bound: float) -> Tensor:
    """Return scaled commands, [..., 2], with the desired return relative to V(s) and D(s).

    Args:
        command: (desired return, desired horizon), each scaled, float32 [..., 2].
        expected: (V(s), D(s)), float32 [..., 2].
        bound: largest absolute value of relative returns (``advantage_bound``).
    """
    above = (command[..., 0] - expected[..., 0]) / expected[..., 1]
    return torch.stack([above.clamp(-bound, bound), command[..., 1]], dim=-1)
