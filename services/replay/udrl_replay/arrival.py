"""Checks of a delivered episode, before the run handles it."""

from typing import NamedTuple

import msgspec

from udrl.digests import episode_digest
from udrl.environments import EnvironmentSpec
from udrl.episode import fault
from udrl.errors import InvalidMessage
from udrl.replay_buffer import Entry
from udrl_proto.codec import decode_episode, encode
from udrl_proto.messages import EpisodeMessage


class Arrival(msgspec.Struct, frozen=True, kw_only=True):
    """A delivered episode that is well formed. The run decides whether to accept it.

    Attributes:
        actor: name of the actor that delivered it.
        entry: its entry in the buffer, with the return computed here from the rewards.
        digest: digest of its content.
        body: the encoded message, as stored and sent to the learner.
    """

    actor: str
    entry: Entry
    digest: bytes
    body: bytes


class Malformed(NamedTuple):
    """A delivered episode that is not well formed, and the actor that sent it."""

    actor: str
    error: InvalidMessage


def inspect_episode(message: EpisodeMessage, spec: EnvironmentSpec) -> Arrival:
    """Check an episode and return what the run needs of it.

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
