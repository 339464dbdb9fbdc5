"""Weights and optimizer state as safetensors; never pickle.

A version's weights are one blob with its tensors by name. Its optimizer is another, with Adam's two
moments of each tensor and its step count, and with the critic, if there is one. What comes from
outside is validated for names, shapes, dtypes and finite values before it is used.
"""

from collections.abc import Mapping

import numpy as np
import safetensors
import safetensors.numpy

from udrl.architecture import is_trained
from udrl.errors import InvalidWeights
from udrl.graph import Weights, weight_shapes
from udrl.inference import ActingFunction

#: Adam's state of a tensor of the same shape.
MOMENTS = ("exp_avg", "exp_avg_sq")

Shapes = Mapping[str, tuple[int, ...]]


def encode_weights(weights: Weights) -> bytes:
    """Return tensors as safetensors."""
    return safetensors.numpy.save({n: np.asarray(t, order="C") for n, t in weights.items()})


def decode_weights(blob: bytes, shapes: Shapes) -> Weights:
    """Return the tensors that :func:`encode_weights` wrote.

    Args:
        blob: from outside.
        shapes: what is expected, by name (:func:`udrl.graph.weight_shapes`).

    Raises:
        InvalidWeights: the bytes are not that, or a value is not finite.
    """
    try:
        tensors = safetensors.numpy.load(blob)
    except (safetensors.SafetensorError, ValueError, KeyError, TypeError) as error:
        raise InvalidWeights(f"weights: not safetensors: {error}; fetch them again") from error
    if set(tensors) != set(shapes):
        odd = sorted(set(tensors) ^ set(shapes))
        raise InvalidWeights(
            f"weights: tensors {odd[:4]} are missing or surplus; "
            f"they belong to another architecture"
        )
    for name, tensor in tensors.items():
        if tensor.shape != shapes[name] or tensor.dtype != np.float32:
            raise InvalidWeights(
                f"weights: tensor {name!r} is {tensor.dtype} {tensor.shape}, expected float32 "
                f"{shapes[name]}; they belong to another architecture"
            )
        if not np.isfinite(tensor).all():
            raise InvalidWeights(
                f"weights: tensor {name!r} has values that are not finite; training diverged, "
                f"lower learning_rate"
            )
    return tensors


def decode_behavior(graph: bytes, blob: bytes) -> ActingFunction:
    """Return the behavior function of a run's graph and a version's weights.

    Raises:
        InvalidWeights: the bytes are no graph, or not the weights of it.
    """
    return ActingFunction(graph, decode_weights(blob, weight_shapes(graph)))


def optimizer_shapes(shapes: Shapes, critic: Shapes) -> dict[str, tuple[int, ...]]:
    """Return the shape of each tensor of an optimizer's state, by name.

    Args:
        shapes: of the weights.
        critic: of the critic's tensors, which only the learner needs, so that they are part of it
            (:func:`udrl.graph.critic_shapes`).
    """
    expected: dict[str, tuple[int, ...]] = dict(critic)
    for name, shape in (*shapes.items(), *critic.items()):
        if not is_trained(name):
            continue
        expected |= {f"{moment}.{name}": shape for moment in MOMENTS}
        expected[f"step.{name}"] = ()
    return expected
