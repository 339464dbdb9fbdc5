"""Making images smaller by area averaging, to the last bit the same everywhere."""

from typing import Any

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]


class AreaAverage:
    """Averages the pixels that each pixel of a smaller image covers.

    A pixel that is covered in part counts by its part. The sums are exact, so the result does not
    depend on the processor; it is rounded to the nearest integer, halves up.

    Args:
        height, width: of what comes in.
        to_height, to_width: of what goes out, at most as large.
    """

    def __init__(self, height: int, width: int, to_height: int, to_width: int) -> None:
        # Small integers are exact as floats, in whatever order they are summed, and matrix products
        # of floats are the fast ones.
        self._area = height * width
        exact = np.float32 if 255 * self._area < 2**24 else np.float64
        self._rows: npt.NDArray[Any] = _shares(height, to_height).astype(exact)
        self._columns: npt.NDArray[Any] = _shares(width, to_width).T.astype(exact)

    def __call__(self, image: Image) -> Image:
        """Return the smaller image.

        Args:
            image: uint8 [height, width] or [height, width, channels].

        Returns:
            uint8 [to_height, to_width] or [to_height, to_width, channels].
        """
        channels = image if image.ndim == 3 else image[..., None]
        planes = np.moveaxis(channels, -1, 0).astype(self._rows.dtype)
        sums = (self._rows @ planes @ self._columns).astype(np.int64)
        smaller = ((2 * sums + self._area) // (2 * self._area)).astype(np.uint8)
        out: Image = np.moveaxis(smaller, 0, -1).reshape(*smaller.shape[1:], *image.shape[2:])
        return out


def _shares(size: int, to_size: int) -> npt.NDArray[np.int64]:
    """Return what each of ``size`` pixels gives to each of ``to_size``, in parts of a pixel.

    A pixel is ``to_size`` parts long and a larger one ``size``; [to_size, size].
    """
    pixel = np.arange(size) * to_size
    larger = np.arange(to_size)[:, None] * size
    overlap = np.minimum(pixel + to_size, larger + size) - np.maximum(pixel, larger)
    shares: npt.NDArray[np.int64] = np.maximum(overlap, 0)
    return shares
