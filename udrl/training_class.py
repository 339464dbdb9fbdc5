"""The numerics class of training: machines of one class compute bit-identical weights."""

import math

import msgspec
import numpy as np

from udrl.config import Config, change
from udrl.determinism import PROBE_STEPS
from udrl.digests import arrays_digest
from udrl.environments.specification import EnvironmentSpec
from udrl.episode import Episode
from udrl.experience import Experience
from udrl.spaces import noise, parts_of
from udrl.streams import Purpose, Stream, stream_key
from udrl.training import train, untrained

#: Index of the probe's stream for the episode.
_EPISODE = 1000


def training_class(config: Config, spec: EnvironmentSpec) -> str:
    """Return the digest of the weights after two updates on a random episode."""
    small = change(config, n_updates_per_iter=2, replay_size=1, recent_size=0, last_few=1)
    stream = Stream(stream_key(0, Purpose.PROBE, 0, _EPISODE))
    length = min(PROBE_STEPS, spec.max_episode_steps)
    seen, acted = spec.observation_space, spec.action_space
    observations = np.empty((length, *seen.shape), seen.dtype)
    for part in parts_of(observations):
        part[:] = noise(stream, part.dtype, part.shape)
    shape = (length, *acted.shape)
    numbers = stream.uniforms(math.prod(shape)).reshape(shape)
    episode = Episode(
        command_id=0,
        observations=observations,
        actions=acted.uniform(numbers).astype(acted.dtype),
        rewards=stream.uniforms(length).astype(np.float32),
        terminated=True,
        truncated=False,
    )
    experience = Experience(small, msgspec.structs.replace(spec, max_episode_steps=length))
    experience.add(episode)
    state = untrained(small, spec)
    train(state, experience.by_rank([0]), small)
    return arrays_digest(state.weights).hex()[:16]
