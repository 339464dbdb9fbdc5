"""The state of training as weights and optimizer (:mod:`udrl.weights`), and back."""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import torch

from udrl.behavior import BehaviorFunction
from udrl.config import Config
from udrl.environments.making import EnvironmentSpec
from udrl.graph import Weights
from udrl.training import TrainingState, make_optimizer
from udrl.weights import MOMENTS, decode_weights, encode_weights, optimizer_shapes


def encode_optimizer(state: TrainingState) -> bytes:
    """Return Adam's state as safetensors; empty at version 0, when there is none."""
    tensors: dict[str, npt.NDArray[np.float32]] = {}
    for name, parameter in state.behavior.named_parameters():
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
        InvalidWeights: the bytes are not those of such a state.
    """
    behavior = BehaviorFunction(spec, config)
    shapes = {n: tuple(t.shape) for n, t in behavior.state_dict().items()}
    behavior.load_state_dict(_tensors(decode_weights(weights, shapes)))
    behavior.to(config.arithmetic.device)
    tensors = _tensors(decode_weights(optimizer, optimizer_shapes(shapes)))
    adam = make_optimizer(behavior, config.training)
    for name, parameter in behavior.named_parameters():
        adam.state[parameter] = {
            k: tensors[f"{k}.{name}"].to(config.arithmetic.device) for k in ("step", *MOMENTS)
        }
    return TrainingState(version, behavior, adam)


def _tensors(weights: Weights) -> Mapping[str, torch.Tensor]:
    # torch's own memory is aligned, which safetensors' is not; rounding may depend on that.
    return {name: torch.from_numpy(array).clone() for name, array in weights.items()}
