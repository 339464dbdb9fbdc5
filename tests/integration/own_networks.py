"""Custom behavior functions, importable as ``own_networks:Concatenating``."""

from typing import Any

import torch
from torch import Tensor, nn

from udrl.environments.specification import EnvironmentSpec
from udrl.setting_groups import NetworkSettings


class Concatenating(nn.Module):
    """Concatenates observation and command; has a layer normalisation and a constant."""

    def __init__(self, spec: EnvironmentSpec, network: NetworkSettings) -> None:
        super().__init__()
        size, width = spec.observation_space.shape[0] * network.frame_stack, network.hidden[0]
        self.first = nn.Linear(size + 2, width)
        self.norm = nn.LayerNorm(width)
        self.last = nn.Linear(width, spec.action_space.n_parameters)
        self.register_buffer("unit", torch.tensor([0.5]), persistent=False)
        self.unit: Tensor

    def forward(self, *inputs: Tensor) -> Tensor:
        features = self.first(torch.cat(inputs, dim=1) * self.unit)
        logits: Tensor = self.last(torch.relu(self.norm(features)))
        return logits


class Initialised(nn.Module):
    """Draws its own weights; has a layer without biases, and one with the name of one of ours."""

    def __init__(self, spec: EnvironmentSpec, network: NetworkSettings) -> None:
        super().__init__()
        width = network.hidden[0]
        self.first = nn.Linear(spec.observation_space.shape[0] + 2, width)
        self.normaliser = nn.LayerNorm(width)
        self.last = nn.Linear(width, spec.action_space.n_parameters, bias=False)
        nn.init.eye_(self.first.weight)
        nn.init.constant_(self.first.bias, 0.5)

    def forward(self, *inputs: Tensor) -> Tensor:
        features = self.normaliser(self.first(torch.cat(inputs, dim=1)))
        logits: Tensor = self.last(torch.relu(features))
        return logits


class Idle(Concatenating):
    """Has an unused layer."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.idle = nn.Linear(2, 2)


class Narrow(Concatenating):
    """Returns too few logits."""

    def forward(self, *inputs: Tensor) -> Tensor:
        return super().forward(*inputs)[:, :1]


class Broken(Concatenating):
    """Raises an exception."""

    def forward(self, *inputs: Tensor) -> Tensor:
        raise RuntimeError("not today")


class Persistent(Concatenating):
    """Has a buffer, which its state dict lists like a parameter."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.register_buffer("kept", torch.zeros(1))


class NoModule:
    """Is no module."""

    def __init__(self, *given: Any) -> None:
        pass
