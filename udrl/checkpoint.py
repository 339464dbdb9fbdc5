"""Weights and optimizer state as safetensors; never pickle.

A behavior function is one blob with its tensors by name; the optimizer is another, with Adam's two
moments of each tensor and its step count, and with the trained weights where their moving average
acts. What comes from outside is validated for names, shapes,
dtypes and finite values before it is used.
"""

import copy
from collections.abc import Mapping

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from udrl.behavior import BehaviorFunction
from udrl.config import Config
from udrl.environments.making import EnvironmentSpec
from udrl.errors import InvalidWeights
from udrl.training import TrainingState, make_optimizer

_MOMENTS = ("exp_avg", "exp_avg_sq")


def encode_weights(behavior: BehaviorFunction) -> bytes:
    """Return a behavior function's parameters as safetensors."""
    return safetensors.torch.save({n: t.contiguous() for n, t in behavior.state_dict().items()})


def decode_weights(blob: bytes, config: Config, spec: EnvironmentSpec) -> BehaviorFunction:
    """Return the behavior function that :func:`encode_weights` wrote.

    Raises:
        InvalidWeights: the bytes are not that.
    """
    behavior = BehaviorFunction(spec, config)
    expected = behavior.state_dict()
    behavior.load_state_dict(_decode(blob, expected))
    return behavior


def encode_optimizer(state: TrainingState) -> bytes:
    """Return Adam's state as safetensors; empty at version 0, when there is none."""
    tensors: dict[str, Tensor] = {}
    for name, parameter in state.trained.named_parameters():
        held = state.optimizer.state.get(parameter)
        if held:
            tensors |= {f"{moment}.{name}": held[moment] for moment in (*_MOMENTS, "step")}
    if tensors and state.trained is not state.behavior:
        tensors |= {f"trained.{n}": t.contiguous() for n, t in state.trained.state_dict().items()}
    return safetensors.torch.save(tensors)


def decode_state(
    version: int, weights: bytes, optimizer: bytes, config: Config, spec: EnvironmentSpec
) -> TrainingState:
    """Return the training state of a version >= 1.

    Raises:
        InvalidWeights: the bytes are not those of such a state.
    """
    behavior = decode_weights(weights, config, spec).to(config.device)
    expected: dict[str, Tensor] = {}
    for name, parameter in behavior.named_parameters():
        expected |= {f"{moment}.{name}": parameter.detach() for moment in _MOMENTS}
        expected[f"step.{name}"] = torch.zeros(())
    if config.ema_decay:
        expected |= {f"trained.{name}": t for name, t in behavior.state_dict().items()}
    tensors = _decode(optimizer, expected)
    trained = behavior
    if config.ema_decay:
        trained = copy.deepcopy(behavior)
        trained.load_state_dict({n: tensors[f"trained.{n}"] for n in behavior.state_dict()})
    adam = make_optimizer(trained, config)
    for name, parameter in trained.named_parameters():
        adam.state[parameter] = {
            k: tensors[f"{k}.{name}"].to(config.device) for k in ("step", *_MOMENTS)
        }
    return TrainingState(version, trained, behavior, adam)


def _decode(blob: bytes, expected: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors in ``blob``, which must be named, shaped and typed like ``expected``."""
    try:
        tensors = safetensors.torch.load(blob)
    except (safetensors.SafetensorError, ValueError, KeyError, TypeError) as error:
        raise InvalidWeights(f"weights: not safetensors: {error}; fetch them again") from error
    if set(tensors) != set(expected):
        odd = sorted(set(tensors) ^ set(expected))
        raise InvalidWeights(
            f"weights: tensors {odd[:4]} are missing or surplus; "
            f"they belong to another architecture"
        )
    for name, tensor in tensors.items():
        like = expected[name]
        if tensor.shape != like.shape or tensor.dtype != like.dtype:
            raise InvalidWeights(
                f"weights: tensor {name!r} is {tensor.dtype} {tuple(tensor.shape)}, expected "
                f"{like.dtype} {tuple(like.shape)}; they belong to another architecture"
            )
        if not bool(torch.isfinite(tensor).all()):
            raise InvalidWeights(
                f"weights: tensor {name!r} has values that are not finite; training diverged, "
                f"lower learning_rate"
            )
    # safetensors' memory is not aligned as torch's own is; rounding may depend on that.
    return {name: tensor.clone() for name, tensor in tensors.items()}
