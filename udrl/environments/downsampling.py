"""Downsampling of images by area averaging, with the same bits on every machine."""

from typing import Any

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]


class AreaAverage:
    """Averages the pixels that each pixel of a smaller image covers.

    A partly covered pixel is weighted by its covered part. The sums are exact, so the result does
    not depend on the processor; it is rounded to the nearest integer, halves up.

    Args:
        height, width: size of the input.
        to_height, to_width: size of the output, at most that of the input.
    """

    def __init__(self, height: int, width: int, to_height: int, to_width: int) -> None:
        self._area = height * width
        # Sums are at most 255 times the area; rounding doubles them and adds the area.
        exact = np.int32 if 511 * self._area < 2**31 else np.int64
        self._rows = _covered(height, to_height, exact)
        self._columns = _covered(width, to_width, exact)

    def __call__(self, image: Image) -> Image:
        """Return the smaller image.

        Args:
            image: uint8 [height, width] or [height, width, channels].

        Returns:
            uint8 [to_height, to_width] or [to_height, to_width, channels].
        """
        # Not a matrix product: BLAS threads spin while they wait for each other, and deadlock when
        # an environment in another thread starts a process.
        rows, shares = self._rows
        sums = np.einsum("kj,kj...->j...", shares, image[rows])
        columns, shares = self._columns
        sums = np.einsum("kj,ikj...->ij...", shares, sums[:, columns])
        out: Image = ((2 * sums + self._area) // (2 * self._area)).astype(np.uint8)
        return out


def _covered(
    size: int, to_size: int, exact: type[np.signedinteger[Any]]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[Any]]:
    """Return the pixels that each output pixel covers, and their weights, [most, to_size] each.

    Output pixels that cover fewer than ``most`` pixels also have neighbours of weight 0.
    """
    shares = _shares(size, to_size)
    most = int((shares > 0).sum(axis=1).max())
    first = np.minimum((shares > 0).argmax(axis=1), size - most)
    pixels = first + np.arange(most)[:, None]
    return pixels, shares[np.arange(to_size), pixels].astype(exact)


def _shares(size: int, to_size: int) -> npt.NDArray[np.int64]:
    """Return the overlaps of ``to_size`` output pixels and ``size`` pixels, [to_size, size].

    The unit makes all overlaps integers: a pixel is ``to_size`` long, an output pixel ``size``.
    """
    pixel = np.arange(size) * to_size
    larger = np.arange(to_size)[:, None] * size
    overlap = np.minimum(pixel + to_size, larger + size) - np.maximum(pixel, larger)
    shares: npt.NDArray[np.int64] = np.maximum(overlap, 0)
    return shares
