"""Whether two machines round alike, and what a run leaves to the machine that creates it.

A run is exact when the environment replays exactly (:func:`environment_replays`) and when all
machines round alike: they do when their *numerics class*, the digest of a fixed probe, is the same
(:func:`acting_class`, :func:`udrl.training_class.training_class`).
"""

import ctypes
import hashlib
from pathlib import Path

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.commands import TRAINING_SEEDS, Command
from udrl.config import Config, change, flat
from udrl.digests import arrays_digest, episode_digest
from udrl.episode import Episode
from udrl.inference import Acting, ActingFunction, probe_rows, probe_weights
from udrl.streams import Purpose, stream_key

#: Steps of an episode of the probe, and rows of its logits.
PROBE_STEPS = 64
PROBE_ROWS = 16


def settle(config: Config) -> Config:
    """Return the settings of a new run: what says ``auto`` is chosen for this machine."""
    device, precision = config.arithmetic.device, config.arithmetic.precision
    if device == "auto":
        device = "cuda" if _has_cuda() else "cpu"
    if precision == "auto":
        precision = "bfloat16" if _is_fast_in_bfloat16() else "float32"
    return change(config, device=device, precision=precision)


def settle_as(held: Config, config: Config) -> Config:
    """Return settings with what they leave open as it was chosen for another run."""
    asked, known = flat(config), flat(held)
    chosen = {name: known[name] for name in ("device", "precision") if asked[name] == "auto"}
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


def _has_cuda() -> bool:
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


def acting_class(config: Config, generator: EpisodeGenerator, graph: bytes) -> str:
    """Return the numerics class of acting: digest of the probe's logits and of a short episode."""
    function = ActingFunction(graph, probe_weights(graph))
    logits = function.logits(*probe_rows(function, PROBE_ROWS))
    episode = _short_episode(config, generator, function, index=0)
    sha = hashlib.sha256(arrays_digest({"logits": logits}))
    sha.update(episode_digest(episode))
    return sha.hexdigest()[:16]


def environment_replays(config: Config, generator: EpisodeGenerator) -> bool:
    """Say whether an episode is the same again after another one ran in the same instance."""
    first = _short_episode(config, generator, None, index=0)
    _short_episode(config, generator, None, index=1)
    again = _short_episode(config, generator, None, index=0)
    return episode_digest(first) == episode_digest(again)


def _short_episode(
    config: Config, generator: EpisodeGenerator, behavior: Acting | None, index: int
) -> Episode:
    steps = min(PROBE_STEPS, generator.spec.max_episode_steps)
    command = Command(
        id=index,
        kind="explore",
        desired_return=1.0 / config.network.return_scale,
        desired_horizon=steps,
        environment_seed=TRAINING_SEEDS[0] + index,
        stream_key=stream_key(0, Purpose.PROBE, 1, index),
        weights_version=0 if behavior is None else 1,
        max_steps=steps,
    )
    return generate_episodes(generator, [command], behavior)[0]
