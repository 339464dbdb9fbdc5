"""SHA-256 digests of content: two runs are equal if their digests are.

Digests cover decoded values, not encodings: weights by name, dtype, shape and bytes; episodes by
their arrays; a buffer by its episodes in the order of (return, id). The actor of an episode and the
time are not included. Numbers are little-endian.
"""

import hashlib
import struct
from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt

from udrl.episode import Episode

Digest = bytes


def arrays_digest(arrays: Mapping[str, npt.NDArray[np.generic]]) -> Digest:
    """Return the digest of named arrays, independent of their order."""
    sha = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        little = array.astype(array.dtype.newbyteorder("<"), copy=False)
        sha.update(f"{name}|{little.dtype.str}|{little.shape}|".encode())
        sha.update(little.tobytes())
    return sha.digest()


def episode_digest(episode: Episode) -> Digest:
    """Return the digest of an episode's content and id."""
    sha = hashlib.sha256(
        struct.pack("<Q??", episode.command_id, episode.terminated, episode.truncated)
    )
    sha.update(
        arrays_digest(
            {
                "observations": episode.observations,
                "actions": episode.actions,
                "rewards": episode.rewards,
            }
        )
    )
    return sha.digest()


def replay_digest(episode_digests: Iterable[Digest]) -> Digest:
    """Return the digest of a buffer from its episodes' digests, in the buffer's order."""
    sha = hashlib.sha256()
    for digest in episode_digests:
        sha.update(digest)
    return sha.digest()
