"""Checking an episode that arrives, before the run sees it."""

from typing import NamedTuple

import msgspec

from udrl.digests import episode_digest
from udrl.environments import EnvironmentSpec
from udrl.episode import fault
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
    episode = decode_episode(message, spec.observation_space)
    if found := fault(episode, spec):
        raise InvalidMessage(f"episode {episode.command_id}: {found}")
    return Arrival(
        actor=message.actor,
        entry=Entry(episode.episode_return, episode.command_id, episode.length),
        digest=episode_digest(episode),
        body=encode(message),
    )
