"""Numerics classes of machines, and settings that depend on the machine that creates a run.

A run is exact if its environment is deterministic (:mod:`udrl.determinism`) and all machines
compute the same bits. The latter is checked by their *numerics class*, the digest of a fixed probe
(:func:`acting_class`, :func:`udrl.training_class.training_class`).
"""

import ctypes
import math
from pathlib import Path

import numpy as np

from udrl.actions import ActionSpace
from udrl.config import Config, change, flat
from udrl.digests import arrays_digest
from udrl.inference import ActingFunction, probe_rows, probe_weights
from udrl.streams import Purpose, Stream, stream_key

#: Number of rows of logits in the probe, and of actions sampled from them.
PROBE_ROWS = 16
PROBE_CHOICES = 64


def resolve_arithmetic(config: Config) -> Config:
    """Return settings with ``device`` and ``precision`` chosen for this machine if ``auto``."""
    device, precision = config.arithmetic.device, config.arithmetic.precision
    if device == "auto":
        device = "cuda" if has_cuda() else "cpu"
    if precision == "auto":
        precision = "bfloat16" if _is_fast_in_bfloat16() else "float32"
    return change(config, device=device, precision=precision)


def resolve_as(held: Config, config: Config) -> Config:
    """Return settings with the choices of an existing run for what ``config`` does not specify.

    Args:
        held: settings of the existing run.
        config: settings with ``auto``, or with a dataset without digest.
    """
    given, known = flat(config), flat(held)
    chosen = {name: known[name] for name in ("device", "precision") if given[name] == "auto"}
    if given["dataset"] is not None and given["dataset"] == known["dataset"]:
        chosen["n_warm_up_episodes"] = known["n_warm_up_episodes"]
        chosen["dataset_sha256"] = given["dataset_sha256"] or known["dataset_sha256"]
    return change(config, **chosen)


def _is_fast_in_bfloat16() -> bool:
    """Return whether this processor has bfloat16 instructions; False if that is unknown."""
    try:
        flags = Path("/proc/cpuinfo").read_text(encoding="utf-8").split()
    except OSError:
        return False
    return not {"avx512_bf16", "amx_bf16", "bf16"}.isdisjoint(flags)


def has_cuda() -> bool:
    """Return whether the CUDA driver finds a GPU; torch may not be installed here."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    count = ctypes.c_int()
    return bool(
        driver.cuInit(0) == 0
        and driver.cuDeviceGetCount(ctypes.byref(count)) == 0
        and count.value > 0
    )


def acting_class(graph: bytes, space: ActionSpace) -> str:
    """Return the numerics class of acting: the digest of a probe's logits and actions.

    Args:
        graph: the acting graph.
        space: the action space.
    """
    function = ActingFunction(graph, probe_weights(graph))
    logits, state = function.advance(*probe_rows(function, PROBE_ROWS))
    shape = (PROBE_CHOICES, *space.shape)
    stream = Stream(stream_key(0, Purpose.PROBE, 3, 0))
    numbers = stream.uniforms(math.prod(shape)).reshape(shape)
    rows = logits[np.arange(PROBE_CHOICES) % PROBE_ROWS].astype(np.float64)
    actions = space.sample(rows, np.ones((PROBE_CHOICES, 1)), numbers).astype(space.dtype)
    probed = {"actions": actions, "logits": logits}
    return arrays_digest(probed | ({"next_state": state} if state.size else {})).hex()[:16]
