"""Counter-based random streams: every random number of a run has an address instead of a history.

A stream is identified by (seed, purpose, iteration, index). Its key is the first 16 bytes of
``sha256("udrl/stream/1|seed|purpose|iteration|index")``, read as a little-endian integer. Its
numbers are those of Philox4x64-10 under that key, counter from 1, each converted to a float64 in
[0, 1) by ``(x >> 11) * 2**-53``. All random numbers that results depend on come from streams, and
no generator state is ever stored.
"""

import hashlib
from enum import StrEnum

import numpy as np
import numpy.typing as npt


class Purpose(StrEnum):
    """Purpose of a stream's numbers."""

    INITIALISE = "initialise"
    COMMANDS = "commands"
    EPISODE = "episode"
    TRAINING = "training"
    PROBE = "probe"


def stream_key(seed: int, purpose: Purpose, iteration: int = 0, index: int = 0) -> bytes:
    """Return the 16-byte key of a stream."""
    name = f"udrl/stream/1|{seed}|{purpose}|{iteration}|{index}"
    return hashlib.sha256(name.encode()).digest()[:16]


class Stream:
    """The numbers of one stream, in order.

    Args:
        key: 16 bytes, from :func:`stream_key`.
    """

    def __init__(self, key: bytes) -> None:
        self._philox = np.random.Philox(key=int.from_bytes(key, "little"))

    def uniforms(self, n: int) -> npt.NDArray[np.float64]:
        """Return the next ``n`` numbers, float64 in [0, 1)."""
        raw = self._philox.random_raw(n)
        return (raw >> np.uint64(11)).astype(np.float64) * 2.0**-53

    def number(self, index: int) -> float:
        """Return the number at ``index``, counted from the next one, and advance past it."""
        return float(self.uniforms(index + 1)[index])

    def integers(self, n: int, low: int, high: int) -> npt.NDArray[np.int64]:
        """Return the next ``n`` numbers as integers, uniform in [low, high)."""
        return low + (self.uniforms(n) * (high - low)).astype(np.int64)
