"""Adam."""

import torch
from torch import nn

from udrl.adam import Adam


def test_updates_equal_those_of_torch() -> None:
    networks = []
    for kind in (torch.optim.Adam, Adam):
        torch.manual_seed(1)
        network = nn.Linear(5, 3)
        optimizer = kind(network.parameters(), lr=0.01, fused=True)
        before = network.weight.detach().clone()
        for _ in range(4):
            optimizer.zero_grad()
            network(torch.randn(7, 5)).square().mean().backward()
            optimizer.step()
        assert not torch.equal(network.weight, before)
        networks.append(network)
    one, other = networks
    assert torch.equal(one.weight, other.weight)
    assert torch.equal(one.bias, other.bias)
