"""Films of episodes: MP4 or GIF, a caption under every picture."""

from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from udrl.errors import ConfigError

Picture = npt.NDArray[np.uint8]

_CAPTION_HEIGHT = 26
#: Small screens are enlarged until they are this wide, in pixels.
_LEAST_WIDTH = 320
#: What GIFs have at most; browsers slow down faster ones.
_GIF_FPS = 25
# One palette for all pictures would have to see them all first: ffmpeg holds them meanwhile.
_GIF_FILTER = "split[a][b];[a]palettegen=stats_mode=diff[p];[b][p]paletteuse=dither=none"


class Film:
    """A file that pictures are appended to.

    Args:
        path: ``.mp4`` (H.264) or ``.gif``.
        fps: pictures a second; of a GIF only so many are kept that it plays as fast.

    Raises:
        ConfigError: another kind of file, it cannot be written, or the extra is not installed.
    """

    def __init__(self, path: Path, fps: float) -> None:
        if path.suffix not in (".mp4", ".gif"):
            raise ConfigError(f"--video {path}: expected a name that ends with .mp4 or .gif")
        try:
            import imageio_ffmpeg
            from PIL import Image, ImageDraw, ImageFont
        except ModuleNotFoundError as error:
            raise ConfigError(
                f'films need {error.name}; install it with: pip install "udrl[play]"'
            ) from error
        self._ffmpeg, self._image, self._draw = imageio_ffmpeg, Image, ImageDraw
        self._font = ImageFont.load_default(14)
        self._path = path
        self._every = max(1, round(fps / _GIF_FPS)) if path.suffix == ".gif" else 1
        self._fps = fps / self._every
        self._seen = 0
        self._writer: Generator[None, Any, None] | None = None

    def add(self, picture: Picture, caption: str) -> None:
        """Append a picture, uint8 [height, width, 3]; the first says how large the film is."""
        self._seen += 1
        if (self._seen - 1) % self._every:
            return
        frame = self.frame(picture, caption)
        if self._writer is None:
            self._writer = self._open(frame)
        with self._told():
            self._writer.send(np.ascontiguousarray(frame))

    def frame(self, picture: Picture, caption: str) -> Picture:
        """Return a picture with its caption below it, both sides even, as H.264 wants them."""
        enlarge = max(1, -(-_LEAST_WIDTH // picture.shape[1]))
        large = picture.repeat(enlarge, axis=0).repeat(enlarge, axis=1)
        height, width = (n - n % 2 for n in large.shape[:2])
        page = self._image.new("RGB", (width, height + _CAPTION_HEIGHT))
        page.paste(self._image.fromarray(large))
        self._draw.Draw(page).text((6, height + 5), caption, "white", self._font)
        return np.asarray(page)

    def close(self) -> None:
        """Finish the file; a film without pictures leaves none."""
        writer, self._writer = self._writer, None
        if writer is not None:
            with self._told():
                writer.close()

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Tell what ffmpeg cannot do, without its page of other affairs."""
        try:
            yield
        except (OSError, RuntimeError) as error:
            self._writer = None
            raise ConfigError(
                f"--video {self._path}: ffmpeg cannot write it ({type(error).__name__}); is the "
                f"disk full?"
            ) from error

    def _open(self, frame: Picture) -> Generator[None, Any, None]:
        height, width, _ = frame.shape
        # Here and not by ffmpeg, whose message would be a page of its own affairs.
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._path.open("wb").close()
        except OSError as error:
            raise ConfigError(
                f"--video {self._path}: {error.strerror}; name a file that you may write"
            ) from error
        kind: dict[str, Any] = {"codec": "libx264", "quality": 7, "macro_block_size": 2}
        if self._path.suffix == ".gif":
            kind = {
                "codec": "gif", "pix_fmt_out": "pal8", "macro_block_size": 1,
                "output_params": ["-filter_complex", _GIF_FILTER],
            }  # fmt: skip
        writer: Generator[None, Any, None] = self._ffmpeg.write_frames(
            str(self._path), (width, height), fps=self._fps, ffmpeg_log_level="error", **kind
        )
        with self._told():
            next(writer)
        return writer
