"""Checking an episode that arrives, before the run sees it."""

from typing import NamedTuple

import msgspec
import numpy as np

from udrl.digests import episode_digest
from udrl.environments import EnvironmentSpec
from udrl.episode import Episode, action_dtype
from udrl.errors import InvalidMessage
from udrl.replay import Entry
from udrl_proto.codec import decode_episode, encode
from udrl_proto.messages import EpisodeMessage


class Arrival(msgspec.Struct, frozen=True, kw_only=True):
    """An episode that is well formed; whether it is wanted is for the run to say.

    Attributes:
        actor: who sent it.
        entry: its place in the buffer; the return is computed here, from its rewards.
        digest: of its content.
        body: the message, as the store keeps it and the learner gets it.
    """

    actor: str
    entry: Entry
    digest: bytes
    body: bytes


class Malformed(NamedTuple):
    """An episode that is not well formed, and who sent it."""

    actor: str
    error: InvalidMessage


def inspect(message: EpisodeMessage, spec: EnvironmentSpec) -> Arrival:
    """Return what the run needs to know of an episode.

    Raises:
        InvalidMessage: a shape, dtype, length or value is impossible in this environment.
    """
    episode = decode_episode(message)
    _check(episode, spec)
    return Arrival(
        actor=message.actor,
        entry=Entry(episode.episode_return, episode.command_id, episode.length),
        digest=episode_digest(episode),
        body=encode(message),
    )


def _check(episode: Episode, spec: EnvironmentSpec) -> None:
    length = len(episode.rewards) if episode.rewards.ndim == 1 else -1
    if not 1 <= length <= spec.max_episode_steps:
        raise InvalidMessage(
            f"episode {episode.command_id}: rewards of shape {episode.rewards.shape}, expected one "
            f"dimension of 1 to {spec.max_episode_steps} steps"
        )
    expected = {
        "observations": (np.dtype(spec.observation_dtype), (length, *spec.observation_shape)),
        "actions": (np.dtype(action_dtype(spec.n_actions)), (length,)),
        "rewards": (np.dtype(np.float32), (length,)),
    }
    for name, (dtype, shape) in expected.items():
        array = getattr(episode, name)
        if array.dtype != dtype or array.shape != shape:
            raise InvalidMessage(
                f"episode {episode.command_id}: {name} are {array.dtype} {array.shape}, expected "
                f"{dtype} {shape}"
            )
    for name in ("observations", "rewards"):
        if not np.isfinite(getattr(episode, name)).all():
            raise InvalidMessage(f"episode {episode.command_id}: {name} are not all finite numbers")
    if int(episode.actions.min()) < 0 or int(episode.actions.max()) >= spec.n_actions:
        raise InvalidMessage(
            f"episode {episode.command_id}: actions must be 0 to {spec.n_actions - 1}, "
            f"got {int(episode.actions.min())} to {int(episode.actions.max())}"
        )
    if not (episode.terminated or episode.truncated):
        raise InvalidMessage(
            f"episode {episode.command_id}: it neither terminated nor was truncated"
        )
