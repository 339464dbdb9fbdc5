from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch

from udrl.actions import Categorical
from udrl.behavior import BehaviorFunction, initialise
from udrl.config import Config, build
from udrl.environments import EnvironmentSpec
from udrl.spaces import Vector

LANDER = EnvironmentSpec(
    observation_space=Vector(size=8), action_space=Categorical(n=4), max_episode_steps=1000
)

# Appendix B.1, and the references' [32 gated, 128, 128, 128].
ARCHITECTURES = [
    (32,),
    (32, 32),
    (32, 64),
    (32, 64, 64),
    (32, 64, 64, 64),
    (64,),
    (64, 64),
    (64, 128),
    (64, 128, 128),
    (64, 128, 128, 128),
    (32, 128, 128, 128),
]


def settings(**values: Any) -> Config:
    return build(Config, {"environment": "LunarLander-v3", **values})


def rows(n: int) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(n)
    return (
        torch.tensor(rng.standard_normal((n, 8)), dtype=torch.float32),
        torch.tensor(rng.standard_normal((n, 2)), dtype=torch.float32),
    )


def section_3_2(
    behavior: BehaviorFunction,
    observation: npt.NDArray[np.float64],
    command: npt.NDArray[np.float64],
    activation: str,
) -> npt.NDArray[np.float64]:
    """One row and one unit at a time, in float64."""
    f: Callable[[float], float] = np.tanh if activation == "tanh" else lambda x: max(x, 0.0)
    tensors = {n: t.numpy().astype(np.float64) for n, t in behavior.state_dict().items()}

    def affine(name: str, x: list[float]) -> list[float]:
        weight, bias = tensors[f"{name}.weight"], tensors[f"{name}.bias"]
        return [float(w @ np.array(x) + b) for w, b in zip(weight, bias, strict=True)]

    logits = []
    for s, c in zip(observation.tolist(), command.tolist(), strict=True):
        # "The command inputs were ... transformed by a fully-connected sigmoidal layer,
        gate = [1 / (1 + np.exp(-x)) for x in affine("command", c)]
        # and then multiplied element-wise with an embedding of the observed inputs (after the
        # first layer for fully-connected networks ...)."
        x = [g * f(e) for g, e in zip(gate, affine("encoder.layer", s), strict=True)]
        for i in range(len(behavior.layers)):
            x = [f(y) for y in affine(f"layers.{i}", x)]
        logits.append(affine("action", x))
    return np.array(logits)


@pytest.mark.parametrize("activation", ["relu", "tanh"])
@pytest.mark.parametrize("hidden", ARCHITECTURES, ids=str)
def test_logits_equal_the_formulas_of_section_3_2(hidden: tuple[int, ...], activation: str) -> None:
    config = settings(hidden=hidden, activation=activation, initialisation="uniform")
    behavior = initialise(config, LANDER)
    observation, command = rows(5)
    with torch.inference_mode():
        logits = behavior((observation,), command)
    assert logits.dtype == torch.float32
    assert logits.shape == (5, LANDER.action_space.n_parameters)
    expected = section_3_2(
        behavior,
        observation.numpy().astype(np.float64),
        command.numpy().astype(np.float64),
        activation,
    )
    np.testing.assert_allclose(logits.numpy(), expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("hidden", ARCHITECTURES, ids=str)
def test_layers_have_the_configured_widths(hidden: tuple[int, ...]) -> None:
    behavior = initialise(settings(hidden=hidden), LANDER)
    shapes = {n: tuple(t.shape) for n, t in behavior.state_dict().items() if "weight" in n}
    assert shapes == {
        "encoder.layer.weight": (hidden[0], 8),
        "command.weight": (hidden[0], 2),
        **{f"layers.{i}.weight": (hidden[i + 1], hidden[i]) for i in range(len(hidden) - 1)},
        "action.weight": (4, hidden[-1]),
    }


def test_closed_gate_hides_the_observation() -> None:
    behavior = initialise(settings(hidden=(16,)), LANDER)
    with torch.no_grad():
        behavior.command.bias.fill_(-1000.0)
    observation, command = rows(6)
    assert torch.equal(behavior((observation,), command), behavior((-observation,), command))


@pytest.mark.parametrize("initialisation", ["orthogonal", "uniform"])
def test_initial_weights_depend_on_the_runs_seed_only(initialisation: str) -> None:
    def weights(seed: int) -> list[torch.Tensor]:
        config = settings(seed=seed, initialisation=initialisation)
        return list(initialise(config, LANDER).state_dict().values())

    torch.manual_seed(1)
    first = weights(seed=7)
    torch.manual_seed(2)
    state = torch.random.get_rng_state()
    second = weights(seed=7)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert all(map(torch.equal, first, second))
    assert not torch.equal(weights(seed=8)[0], first[0])


@pytest.mark.parametrize(("activation", "gain"), [("relu", 2**0.5), ("tanh", 5 / 3)])
def test_orthogonal_initialisation_scales_hidden_layers_by_their_gain(
    activation: str, gain: float
) -> None:
    config = settings(hidden=(64, 32, 32), activation=activation, initialisation="orthogonal")
    tensors = initialise(config, LANDER).state_dict()
    for name, tensor in tensors.items():
        if name.endswith("bias"):
            assert not tensor.any()
            continue
        matrix = tensor if tensor.shape[0] <= tensor.shape[1] else tensor.T
        scale = gain if name.startswith(("encoder", "layers")) else 1.0
        torch.testing.assert_close(
            matrix @ matrix.T, scale**2 * torch.eye(len(matrix)), atol=1e-5, rtol=1e-5
        )


def test_uniform_initialisation_is_pytorchs_default() -> None:
    tensors = initialise(settings(hidden=(64, 128), initialisation="uniform"), LANDER).state_dict()
    for layer, inputs in [("encoder.layer", 8), ("command", 2), ("layers.0", 64), ("action", 128)]:
        for tensor in (tensors[f"{layer}.weight"], tensors[f"{layer}.bias"]):
            assert tensor.abs().max() <= inputs**-0.5
        spread = tensors[f"{layer}.weight"].std().item()
        assert spread == pytest.approx((3 * inputs) ** -0.5, rel=0.15)
