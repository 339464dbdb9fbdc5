"""Weights and optimizer state as safetensors, without pickle.

A version's weights are one blob, with tensors by name. Its optimizer state is another, with Adam's
two moments and step count of each tensor, and with the critic, if there is one. Names, shapes,
dtypes and finiteness of external data are checked before use.
"""

from collections.abc import Mapping

import numpy as np
import safetensors
import safetensors.numpy

from udrl.architecture import is_trained
from udrl.errors import InvalidWeights
from udrl.graph import Weights, weight_shapes
from udrl.inference import ActingFunction

#: Names of Adam's moments, which have the shape of their tensor.
MOMENTS = ("exp_avg", "exp_avg_sq")

Shapes = Mapping[str, tuple[int, ...]]


def encode_weights(weights: Weights) -> bytes:
    """Return tensors as safetensors."""
    return safetensors.numpy.save({n: np.asarray(t, order="C") for n, t in weights.items()})


def decode_weights(blob: bytes, shapes: Shapes) -> Weights:
    """Decode tensors that :func:`encode_weights` encoded.

    Args:
        blob: untrusted bytes.
        shapes: expected shapes by name (:func:`udrl.graph.weight_shapes`).

    Raises:
        InvalidWeights: names, shapes or dtypes are wrong, or a value is not finite.
    """
    try:
        tensors = safetensors.numpy.load(blob)
    except (safetensors.SafetensorError, ValueError, KeyError, TypeError) as error:
        raise InvalidWeights(
            f"weights: not safetensors: {error}; the data are damaged, use another copy"
        ) from error
    if set(tensors) != set(shapes):
        odd = sorted(set(tensors) ^ set(shapes))
        raise InvalidWeights(
            f"weights: tensors {odd[:4]} are missing or surplus; the weights belong to another "
            f"architecture"
        )
    for name, tensor in tensors.items():
        if tensor.shape != shapes[name] or tensor.dtype != np.float32:
            raise InvalidWeights(
                f"weights: tensor {name!r} is {tensor.dtype} {tensor.shape}, expected float32 "
                f"{shapes[name]}; the weights belong to another architecture"
            )
        if not np.isfinite(tensor).all():
            raise InvalidWeights(
                f"weights: tensor {name!r} has values that are not finite; training diverged, "
                f"lower learning_rate"
            )
    return tensors


def decode_behavior(graph: bytes, blob: bytes) -> ActingFunction:
    """Return the behavior function of a run's graph and a version's encoded weights.

    Raises:
        InvalidWeights: the graph is invalid, or the weights do not belong to it.
    """
    return ActingFunction(graph, decode_weights(blob, weight_shapes(graph)))


def optimizer_shapes(shapes: Shapes, critic: Shapes) -> dict[str, tuple[int, ...]]:
    """Return the shapes of an optimizer's state by name.

    Args:
        shapes: shapes of the weights.
        critic: shapes of the critic's tensors (:func:`udrl.graph.critic_shapes`). Only the learner
            needs them, so they are part of the optimizer's state.
    """
    expected: dict[str, tuple[int, ...]] = dict(critic)
    for name, shape in (*shapes.items(), *critic.items()):
        if not is_trained(name):
            continue
        expected |= {f"{moment}.{name}": shape for moment in MOMENTS}
        expected[f"step.{name}"] = ()
    return expected
