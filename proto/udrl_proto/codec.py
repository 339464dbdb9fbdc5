"""Messages as MessagePack: size limits before decoding, validation against the message types."""

import math
from typing import Any, TypeVar

import msgpack
import msgspec
import numpy as np
import numpy.typing as npt

from udrl.episode import Episode
from udrl.errors import ConfigError, InvalidMessage
from udrl.spaces import ObservationSpace
from udrl_proto.messages import ArrayMessage, EpisodeMessage, Message
from udrl_proto.text import printable

AnyMessage = TypeVar("AnyMessage", bound=Message)

#: Largest message without arrays or weights, bytes.
SMALL = 1 << 20
#: Largest status of a run, bytes; it lists up to 10,000 actors.
REPORT = 16 << 20
#: Size of a page of episodes, bytes.
PAGE = 4 << 20
#: Largest message, bytes.
LARGEST = 1 << 30


def encode(message: Message) -> bytes:
    """Return a message as MessagePack: a map from field names to values."""
    plain = msgspec.to_builtins(message, builtin_types=(bytes,))
    # Error text of foreign origin may hold a lone surrogate, which UTF-8 cannot encode.
    packed: bytes = msgpack.packb(plain, use_bin_type=True, unicode_errors="replace")
    return packed


def decode(data: bytes, kind: type[AnyMessage], limit: int = SMALL) -> AnyMessage:
    """Decode and validate a message.

    Args:
        data: untrusted bytes.
        kind: the expected message type.
        limit: largest allowed size, bytes.

    Raises:
        InvalidMessage: the data are too large, not MessagePack, or not a valid ``kind``.
    """
    if len(data) > limit:
        raise InvalidMessage(f"{kind.__name__}: {len(data)} bytes, expected at most {limit}")
    try:
        plain: Any = msgpack.unpackb(
            data,
            raw=False,
            strict_map_key=True,
            max_str_len=SMALL,
            max_bin_len=limit,
            # msgpack allocates an array of its declared length; an element has at least one byte.
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
        raise ValueError("a map has a duplicate key")
    return unique


def encode_array(array: npt.NDArray[Any]) -> ArrayMessage:
    """Return an array as a message."""
    little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    return ArrayMessage(dtype=little.dtype.str, shape=array.shape, data=little.tobytes())


def decode_array(message: ArrayMessage) -> npt.NDArray[Any]:
    """Return the array in a message, read-only.

    Raises:
        InvalidMessage: the number of bytes does not match shape and dtype.
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
    """Return an episode as the message that its actor sends."""
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
    """Return the episode in a message. Only the sizes of its arrays are checked here.

    Args:
        message: an untrusted message.
        space: observation space; defines the fields of records, which the message lacks.

    Raises:
        InvalidMessage: an array's number of bytes does not match its shape and dtype.
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
