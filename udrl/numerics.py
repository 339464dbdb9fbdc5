"""Whether two machines round alike, and what a run leaves to the machine that creates it.

A run is exact when its environment repeats itself (:mod:`udrl.repeating`) and when all machines
round alike: they do when their *numerics class*, the digest of a fixed probe, is the same
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

#: Rows of the probe's logits, and choices among actions.
PROBE_ROWS = 16
PROBE_CHOICES = 64


def settle(config: Config) -> Config:
    """Return the settings of a new run: what says ``auto`` is chosen for this machine."""
    device, precision = config.arithmetic.device, config.arithmetic.precision
    if device == "auto":
        device = "cuda" if has_cuda() else "cpu"
    if precision == "auto":
        precision = "bfloat16" if _is_fast_in_bfloat16() else "float32"
    return change(config, device=device, precision=precision)


def settle_as(held: Config, config: Config) -> Config:
    """Return settings with what they leave open as it was chosen for another run."""
    asked, known = flat(config), flat(held)
    open_ = ("device", "precision")
    chosen = {name: known[name] for name in open_ if asked[name] == "auto"}
    if asked["dataset"] is not None and asked["dataset"] == known["dataset"]:
        chosen["n_warm_up_episodes"] = known["n_warm_up_episodes"]
        chosen["dataset_sha256"] = asked["dataset_sha256"] or known["dataset_sha256"]
    return change(config, **chosen)


def _is_fast_in_bfloat16() -> bool:
    """Say whether this processor has instructions for it; where nobody tells, it has not."""
    try:
        flags = Path("/proc/cpuinfo").read_text(encoding="utf-8").split()
    except OSError:
        return False
    return not {"avx512_bf16", "amx_bf16", "bf16"}.isdisjoint(flags)


def has_cuda() -> bool:
    """Ask the driver for GPUs; whoever creates a run may have no torch."""
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
    """Return the numerics class of acting: digest of the probe's logits and choices.

    Args:
        graph: the acting graph.
        space: of the actions.
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
