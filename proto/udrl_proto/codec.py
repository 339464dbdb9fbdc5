"""Messages as MessagePack: bounded before they are decoded, validated as they are typed."""

import math
from typing import Any, TypeVar

import msgpack
import msgspec
import numpy as np
import numpy.typing as npt

from udrl.episode import Episode
from udrl.errors import ConfigError, InvalidMessage
from udrl.spaces import ObservationSpace
from udrl_proto.messages import Array, EpisodeMessage, Message
from udrl_proto.text import printable

AnyMessage = TypeVar("AnyMessage", bound=Message)

#: Bytes of a message that carries no arrays or weights.
SMALL = 1 << 20
#: Bytes of a page of episodes.
PAGE = 4 << 20
#: Bytes of anything.
LARGEST = 1 << 30


def encode(message: Message) -> bytes:
    """Return a message as MessagePack: a map from field names to values."""
    plain = msgspec.to_builtins(message, builtin_types=(bytes,))
    # What others say in an error may hold half a surrogate pair, which is not Unicode.
    packed: bytes = msgpack.packb(plain, use_bin_type=True, unicode_errors="replace")
    return packed


def decode(data: bytes, kind: type[AnyMessage], limit: int = SMALL) -> AnyMessage:
    """Return the message of a certain kind in ``data``.

    Args:
        data: bytes from outside.
        kind: the message expected.
        limit: the most bytes that it may have.

    Raises:
        InvalidMessage: it is too large, not MessagePack, or not that message.
    """
    if len(data) > limit:
        raise InvalidMessage(f"{kind.__name__}: {len(data)} bytes, at most {limit} are allowed")
    try:
        plain: Any = msgpack.unpackb(
            data,
            raw=False,
            strict_map_key=True,
            max_str_len=SMALL,
            max_bin_len=limit,
            # An array is allocated as long as it says it is; an element has at least one byte.
            max_array_len=min(1 << 20, len(data)),
            max_map_len=4096,
            max_ext_len=0,
            object_pairs_hook=_map,
        )
    except (ValueError, msgpack.UnpackException, RecursionError, MemoryError) as error:
        name = type(error).__name__
        said = printable(error)
        raise InvalidMessage(f"{kind.__name__}: not MessagePack: {name}: {said}") from error
    try:
        return msgspec.convert(plain, kind, builtin_types=(bytes,))
    except (msgspec.ValidationError, ConfigError) as error:
        raise InvalidMessage(f"{kind.__name__}: {printable(error)}") from error


def _map(pairs: list[tuple[Any, Any]]) -> dict[Any, Any]:
    unique = dict(pairs)
    if len(unique) != len(pairs):
        raise ValueError("a map has a key twice")
    return unique


def encode_array(array: npt.NDArray[Any]) -> Array:
    """Return an array as a message."""
    little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    return Array(dtype=little.dtype.str, shape=array.shape, data=little.tobytes())


def decode_array(message: Array) -> npt.NDArray[Any]:
    """Return the array in a message, read-only.

    Raises:
        InvalidMessage: its bytes do not fill its shape.
    """
    dtype = np.dtype(message.dtype)
    expected = dtype.itemsize * math.prod(message.shape)
    if len(message.data) != expected:
        raise InvalidMessage(
            f"Array: {len(message.data)} bytes for {message.dtype} {list(message.shape)}, "
            f"expected {expected}"
        )
    return np.frombuffer(message.data, dtype).reshape(message.shape)


def encode_episode(episode: Episode, actor: str) -> bytes:
    """Return an episode as its actor sends it."""
    return encode(
        EpisodeMessage(
            actor=actor,
            command_id=episode.command_id,
            observations=encode_array(episode.observations),
            actions=encode_array(episode.actions),
            rewards=encode_array(episode.rewards),
            terminated=episode.terminated,
            truncated=episode.truncated,
        )
    )


def decode_episode(message: EpisodeMessage, space: ObservationSpace) -> Episode:
    """Return the episode in a message; its arrays fit their shapes, and that is all that is known.

    Args:
        message: from outside.
        space: of its observations: what the structures of a record hold is not in the message.

    Raises:
        InvalidMessage: an array's bytes do not fill its shape.
    """
    observations = decode_array(message.observations)
    if observations.dtype.kind == "V" and observations.dtype.itemsize == space.dtype.itemsize:
        observations = observations.view(space.dtype.newbyteorder("<"))
    return Episode(
        command_id=message.command_id,
        observations=observations,
        actions=decode_array(message.actions),
        rewards=decode_array(message.rewards),
        terminated=message.terminated,
        truncated=message.truncated,
    )
