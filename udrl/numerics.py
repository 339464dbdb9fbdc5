"""Arithmetic that does not depend on company, and how we make sure.

A run is exact when a row's result does not depend on its place in a batch or on its neighbours
(:func:`check_batch_invariance`), when the environment replays exactly
(:func:`environment_replays`), and when all machines round alike: they do when their *numerics
class*, the digest of a fixed probe, is the same (:func:`acting_class`, :func:`training_class`).
"""

import hashlib
import math
import os
from pathlib import Path

import msgspec
import numpy as np
import torch

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.behavior import BehaviorFunction, initialise
from udrl.commands import TRAINING_SEEDS, Command
from udrl.config import Config
from udrl.digests import arrays_digest, episode_digest, tensors_digest
from udrl.encoders import stacked_shape
from udrl.environments.making import EnvironmentSpec
from udrl.episode import Episode, Observations, action_dtype
from udrl.errors import InexactArithmetic
from udrl.segments import Experience
from udrl.streams import Purpose, Stream, stream_key
from udrl.training import train, untrained

#: Environment variable that makes Intel's MKL round alike everywhere, at half the speed. It is read
#: when torch is loaded.
STRICT_MKL = {"MKL_CBWR": "AVX2,STRICT"}

_PROBE_STEPS = 64


def use_one_thread() -> None:
    """Let torch compute deterministically in one thread, as every role of a run does."""
    if torch.get_num_threads() != 1:
        torch.set_num_threads(1)
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # CUDA's matrix products too
    torch.use_deterministic_algorithms(mode=True)


def settle(config: Config) -> Config:
    """Return the settings of a new run: what says ``auto`` is chosen for this machine."""
    device, precision = config.device, config.precision
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    if precision == "auto":
        precision = "bfloat16" if _is_fast_in_bfloat16() else "float32"
    return msgspec.structs.replace(config, device=device, precision=precision)


def settle_as(held: Config, config: Config) -> Config:
    """Return settings with what they leave open as it was chosen for another run."""
    chosen = {n: getattr(held, n) for n in ("device", "precision") if getattr(config, n) == "auto"}
    if config.dataset is not None and config.dataset == held.dataset:
        chosen["n_warm_up_episodes"] = held.n_warm_up_episodes
        chosen["dataset_sha256"] = config.dataset_sha256 or held.dataset_sha256
    return msgspec.structs.replace(config, **chosen)


def _is_fast_in_bfloat16() -> bool:
    """Say whether this processor has instructions for it; where nobody tells, it has not.

    Acting is done on the CPU, also where a GPU trains.
    """
    try:
        flags = Path("/proc/cpuinfo").read_text(encoding="utf-8").split()
    except OSError:
        return False
    return not {"avx512_bf16", "amx_bf16", "bf16"}.isdisjoint(flags)


def _probe_stream(index: int) -> Stream:
    return Stream(stream_key(0, Purpose.PROBE, 0, index))


def _probe_observations(
    stream: Stream, n: int, shape: tuple[int, ...], *, images: bool
) -> Observations:
    """Return noise: bytes, or numbers in [-2, 2)."""
    uniforms = stream.uniforms(n * math.prod(shape)).reshape(n, *shape)
    return (uniforms * 256).astype(np.uint8) if images else (uniforms * 4 - 2).astype(np.float32)


def _probe_rows(config: Config, spec: EnvironmentSpec) -> tuple[torch.Tensor, torch.Tensor]:
    rows = config.inference_rows
    observation = _probe_observations(
        _probe_stream(0), rows, stacked_shape(spec, config), images=spec.is_image
    )
    command = _probe_stream(1).uniforms(rows * 2) * 4 - 2
    return (
        torch.tensor(observation),
        torch.tensor(command.reshape(rows, 2), dtype=torch.float32),
    )


def check_batch_invariance(config: Config, spec: EnvironmentSpec, tries: int = 8) -> None:
    """Permute rows and change their neighbours; every row's logits must stay the same bits.

    Raises:
        InexactArithmetic: they do not.
    """
    behavior = initialise(config, spec).frozen()
    rows = config.inference_rows
    observation, command = _probe_rows(config, spec)
    with torch.inference_mode():
        expected = behavior(observation, command)
        for index in range(tries):
            order = torch.from_numpy(np.argsort(_probe_stream(2 + index).uniforms(rows)))
            changed = behavior(observation[order].clone(), command[order].clone())
            kept = order % 2 == 0
            others = torch.where(kept, torch.arange(rows), torch.arange(rows).flip(0))
            neighbours = behavior(observation[others].clone(), command[others].clone())
            if not (
                torch.equal(changed, expected[order])
                and torch.equal(neighbours[kept], expected[kept])
            ):
                raise InexactArithmetic(
                    f"a row's logits depend on the other {rows - 1} rows of the batch, so episodes "
                    f"would depend on chance; set the environment variable "
                    f"{'='.join(next(iter(STRICT_MKL.items())))} or run on another machine"
                )


def acting_class(config: Config, generator: EpisodeGenerator) -> str:
    """Return the numerics class of acting: digest of initial logits and of a short episode."""
    spec = generator.spec
    behavior = initialise(config, spec)
    with torch.inference_mode():
        logits = behavior.frozen()(*_probe_rows(config, spec))
    episode = _short_episode(config, generator, behavior, index=0)
    sha = hashlib.sha256(arrays_digest({"logits": logits.numpy()}))
    sha.update(episode_digest(episode))
    return sha.hexdigest()[:16]


def training_class(config: Config, spec: EnvironmentSpec) -> str:
    """Return the numerics class of training: digest of the weights after two updates."""
    small = msgspec.structs.replace(
        config, n_updates_per_iter=2, replay_size=1, recent_size=0, last_few=1
    )
    stream = _probe_stream(1000)
    length = min(_PROBE_STEPS, spec.max_episode_steps)
    observations = _probe_observations(stream, length, spec.observation_shape, images=spec.is_image)
    episode = Episode(
        command_id=0,
        observations=observations,
        actions=stream.integers(length, 0, spec.n_actions).astype(action_dtype(spec.n_actions)),
        rewards=stream.uniforms(length).astype(np.float32),
        terminated=True,
        truncated=False,
    )
    experience = Experience(small, msgspec.structs.replace(spec, max_episode_steps=length))
    experience.add(episode)
    state = untrained(small, spec)
    train(state, experience.by_rank([0]), small)
    return tensors_digest(state.behavior.state_dict()).hex()[:16]


def environment_replays(config: Config, generator: EpisodeGenerator) -> bool:
    """Say whether an episode is the same again after another one ran in the same instance."""
    first = _short_episode(config, generator, None, index=0)
    _short_episode(config, generator, None, index=1)
    again = _short_episode(config, generator, None, index=0)
    return episode_digest(first) == episode_digest(again)


def _short_episode(
    config: Config, generator: EpisodeGenerator, behavior: BehaviorFunction | None, index: int
) -> Episode:
    steps = min(_PROBE_STEPS, generator.spec.max_episode_steps)
    command = Command(
        id=index,
        kind="explore",
        desired_return=1.0 / config.return_scale,
        desired_horizon=steps,
        environment_seed=TRAINING_SEEDS[0] + index,
        stream_key=stream_key(0, Purpose.PROBE, 1, index),
        weights_version=0 if behavior is None else 1,
        max_steps=steps,
    )
    return generate_episodes(generator, [command], behavior)[0]
