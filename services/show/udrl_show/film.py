"""Videos of episodes as MP4 or GIF, with a caption below every frame."""

import subprocess
import tempfile
from pathlib import Path
from typing import IO

import numpy as np
import numpy.typing as npt

from udrl.errors import ConfigError
from udrl.file_endings import check_ending
from udrl.file_remedies import file_remedy

Picture = npt.NDArray[np.uint8]

#: Height of the caption, in pixels.
_CAPTION_HEIGHT = 26
#: Minimum width of a video, in pixels; smaller frames are enlarged.
_MIN_VIDEO_WIDTH = 320
#: Maximum frames per second of a GIF; browsers slow down faster ones.
_GIF_FPS = 25
#: Options of ffmpeg for each kind of file.
_FFMPEG_OPTIONS = {
    ".mp4": ("-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "15"),
    # The palette is computed from all frames, so ffmpeg keeps them in memory until the end.
    ".gif": (
        "-filter_complex",
        "split[a][b];[a]palettegen=stats_mode=diff[p];[b][p]paletteuse=dither=none",
    ),
}
#: Endings of the names of videos.
ENDINGS = tuple(_FFMPEG_OPTIONS)
#: Seconds for ffmpeg to finish a file.
_FINISH_S = 60.0


class Film:
    """Writes a video frame by frame.

    Args:
        path: ``.mp4`` (H.264) or ``.gif``.
        fps: frames per second. A GIF drops frames to keep this speed.

    Raises:
        ConfigError: the extension is not supported, the file cannot be written, or the extra is not
            installed.
    """

    def __init__(self, path: Path, fps: float) -> None:
        check_ending(path, ENDINGS)
        try:
            import imageio_ffmpeg
            from PIL import Image, ImageDraw, ImageFont
        except ModuleNotFoundError as error:
            raise ConfigError(
                f'videos need {error.name}; install it with: pip install "udrl[play]"'
            ) from error
        self._ffmpeg, self._image, self._draw = imageio_ffmpeg.get_ffmpeg_exe, Image, ImageDraw
        self._font = ImageFont.load_default(14)
        self._path = path
        self._every = max(1, round(fps / _GIF_FPS)) if path.suffix == ".gif" else 1
        self._fps = fps / self._every
        self._seen = 0
        self._process: subprocess.Popen[bytes] | None = None
        self._ffmpeg_log: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the film

    def add(self, picture: Picture, caption: str) -> None:
        """Append a picture, uint8 [height, width, 3]; the first one sets the size of the video."""
        self._seen += 1
        if (self._seen - 1) % self._every:
            return
        frame = self.frame(picture, caption)
        if self._process is None:
            self._process, self._shape = self._open(frame), frame.shape
        if frame.shape != self._shape:
            raise ConfigError(
                f"--video {self._path}: the environment's pictures changed from {self._shape} to "
                f"{frame.shape}; expected pictures of one size"
            )
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(np.ascontiguousarray(frame).data)
        except OSError as error:
            raise self._failure() from error

    def frame(self, picture: Picture, caption: str) -> Picture:
        """Return a picture with its caption below it; both sides are even, as H.264 requires."""
        enlarge = max(1, -(-_MIN_VIDEO_WIDTH // picture.shape[1]))
        large = picture.repeat(enlarge, axis=0).repeat(enlarge, axis=1)
        height, width = (n - n % 2 for n in large.shape[:2])
        page = self._image.new("RGB", (width, height + _CAPTION_HEIGHT))
        page.paste(self._image.fromarray(large))
        self._draw.Draw(page).text((6, height + 5), caption, "white", self._font)
        return np.asarray(page)

    def close(self) -> None:
        """Finish the file. Without pictures, no file is written.

        Raises:
            ConfigError: ffmpeg could not write it.
        """
        if self._process is not None and self._finish() != 0:
            raise self._failure()
        self._ffmpeg_log.close()

    def _finish(self) -> int:
        """Wait for the end of ffmpeg and return its exit code."""
        process, self._process = self._process, None
        assert process is not None
        try:
            process.communicate(timeout=_FINISH_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
        return process.returncode

    def _failure(self) -> ConfigError:
        """Return an error with the first line of ffmpeg's output, and remove the file."""
        if self._process is not None:
            self._finish()
        self._ffmpeg_log.seek(0)
        lines = self._ffmpeg_log.read().decode(errors="replace").strip().splitlines()
        self._ffmpeg_log.close()
        self._path.unlink(missing_ok=True)
        why = lines[0].strip() if lines else "it ended without a message"
        return ConfigError(f"--video {self._path}: ffmpeg cannot write it: {why}")

    def _open(self, frame: Picture) -> subprocess.Popen[bytes]:
        height, width, _ = frame.shape
        # ffmpeg's own message would be longer.
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._path.open("wb").close()
        except OSError as error:
            what_to_do = file_remedy(error, "choose a writable file")
            raise ConfigError(f"--video {self._path}: {error.strerror}; {what_to_do}") from error
        arguments = (
            "-y", "-loglevel", "error",
            "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}",
            "-r", f"{self._fps:g}", "-i", "-", *_FFMPEG_OPTIONS[self._path.suffix],
            f"file:{self._path}",
        )  # fmt: skip
        try:
            return subprocess.Popen(  # noqa: S603 - the library's own program
                [self._ffmpeg(), *arguments],
                stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=self._ffmpeg_log,
                process_group=0,  # Ctrl-C ends the episode, and the video of it is finished
            )  # fmt: skip
        except (OSError, RuntimeError) as error:
            self._path.unlink(missing_ok=True)
            raise ConfigError(f"--video {self._path}: ffmpeg cannot be started: {error}") from error
