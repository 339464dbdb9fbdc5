"""Encoding and decoding of the training state, as weights and optimizer (:mod:`udrl.weights`)."""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import torch

from udrl.behavior import BehaviorFunction
from udrl.config import Config
from udrl.environments.specification import EnvironmentSpec
from udrl.graph import Weights, critic_shapes
from udrl.training import TrainingState, assemble, make_critic
from udrl.weights import MOMENTS, decode_weights, encode_weights, optimizer_shapes


def encode_optimizer(state: TrainingState) -> bytes:
    """Return Adam's state and the critic as safetensors; at version 0, Adam has no state."""
    tensors: dict[str, npt.NDArray[np.float32]] = {}
    if state.critic is not None:
        for name, tensor in state.critic.state_dict().items():
            tensors[f"critic.{name}"] = tensor.detach().cpu().numpy()
    for name, parameter in state.parameters().items():
        held = state.optimizer.state.get(parameter)
        if held:
            for key in (*MOMENTS, "step"):
                tensors[f"{key}.{name}"] = held[key].detach().cpu().numpy()
    return encode_weights(tensors)


def decode_state(
    version: int, weights: bytes, optimizer: bytes, config: Config, spec: EnvironmentSpec
) -> TrainingState:
    """Return the training state of a version >= 1.

    Raises:
        InvalidWeights: the bytes are not a state of this configuration.
    """
    behavior, critic = BehaviorFunction(spec, config), make_critic(config, spec)
    shapes = {n: tuple(t.shape) for n, t in behavior.state_dict().items()}
    behavior.load_state_dict(_tensors(decode_weights(weights, shapes)))
    expected = optimizer_shapes(shapes, critic_shapes(config.network, spec))
    tensors = _tensors(decode_weights(optimizer, expected))
    if critic is not None:
        critic.load_state_dict({n: tensors[f"critic.{n}"] for n in critic.state_dict()})
    state = assemble(version, behavior, critic, config)
    for name, parameter in state.parameters().items():
        state.optimizer.state[parameter] = {
            k: tensors[f"{k}.{name}"].to(config.arithmetic.device) for k in ("step", *MOMENTS)
        }
    return state


def _tensors(weights: Weights) -> Mapping[str, torch.Tensor]:
    # Rounding may depend on alignment: torch aligns its memory, safetensors does not.
    return {name: torch.from_numpy(array).clone() for name, array in weights.items()}
