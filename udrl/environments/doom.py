"""ViZDoom's scenarios, with the screen as observation; TakeCover (section 3.1) is one of them."""

import contextlib
import os
import sys
import tempfile
import threading
import uuid
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from udrl.environments import engine_keeper
from udrl.environments.downsampling import AreaAverage, Pixels

#: Height and width of the engine's screen, in pixels.
_SCREEN = (120, 160)

#: Held while an engine starts in its own working directory.
_starting = threading.Lock()
#: Mark of this process's engines (:mod:`.engine_keeper`).
_mark = uuid.uuid4().hex
#: Tics in a second of the game.
_TICS_PER_S = 35
#: Write end of the keeper's standard input, which is only closed when this process ends.
_keeper: int | None = None


class Doom(gym.Env[Pixels, np.int64]):
    """A ViZDoom scenario: action i presses its button i; the observation is the screen.

    An episode depends only on its seed and actions. The engine is a separate process; when it dies,
    the next step raises.

    Args:
        scenario: a scenario of ViZDoom, e.g. ``take_cover``, or the path of a .cfg file.
        height, width: size of observations in pixels, at most 120 x 160, the engine's resolution.
        colour: observe red, green and blue instead of grey.
        frame_skip: tics per step; a second has 35.
        max_return: the highest possible return, if known (2.3.2).
        render_mode: ``rgb_array``, or None.

    Raises:
        gymnasium.error.DependencyNotInstalled: ViZDoom cannot be imported.
        ValueError: there is no such scenario, it has no buttons, or another argument is invalid.
        RuntimeError: the engine does not start with the scenario.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": _TICS_PER_S}

    def __init__(
        self,
        scenario: str = "take_cover",
        height: int = 32,
        width: int = 32,
        *,
        colour: bool = False,
        frame_skip: int = 1,
        max_return: float | None = None,
        render_mode: str | None = None,
    ) -> None:
        if not (0 < height <= _SCREEN[0] and 0 < width <= _SCREEN[1]):
            raise ValueError(
                f"height = {height}, width = {width}: expected 1 x 1 to {_SCREEN[0]} x "
                f"{_SCREEN[1]}, the size of the screen"
            )
        self.render_mode = render_mode
        self.max_return = max_return
        self._frame_skip = _tics(frame_skip)
        self.metadata = self.metadata | {"render_fps": _TICS_PER_S / self._frame_skip}
        self._shrink = AreaAverage(*_SCREEN, height, width)
        self._game, self._folder = _open(scenario, colour=colour)
        n = self._game.get_available_buttons_size()
        self._buttons = np.eye(n).tolist()
        self.action_space = gym.spaces.Discrete(n)
        shape = (height, width, 3) if colour else (height, width)
        self.observation_space = gym.spaces.Box(0, 255, shape, np.uint8)
        self._screen = np.zeros((*_SCREEN, *shape[2:]), np.uint8)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Pixels, dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        self._game.set_seed(int(self.np_random.integers(2**31)))
        self._game.new_episode()
        return self._observe(), {}

    def step(self, action: np.int64) -> tuple[Pixels, float, bool, bool, dict[str, Any]]:
        """Press a button for ``frame_skip`` tics. The last step returns the last known screen."""
        reward = self._game.make_action(self._buttons[action], self._frame_skip)
        terminated = self._game.is_episode_finished()
        return self._observe(), float(reward), terminated, False, {}

    def render(self) -> Pixels | None:
        """Return the screen, uint8 [120, 160, 3]."""
        if self.render_mode is None:
            return None
        screen = self._screen if self._screen.ndim == 3 else self._screen[..., None]
        return np.repeat(screen, 3 // screen.shape[-1], axis=-1)

    def close(self) -> None:
        """Stop the engine."""
        self._game.close()
        self._folder.cleanup()

    def _observe(self) -> Pixels:
        state = self._game.get_state()
        if state is not None:
            self._screen = state.screen_buffer
        return self._shrink(self._screen)


def _tics(frame_skip: Any) -> int:
    """Return the tics of a step, after checking ``frame_skip``."""
    if not isinstance(frame_skip, int | np.integer) or frame_skip < 1:
        raise ValueError(
            f"frame_skip = {frame_skip!r}: expected an integer, 1 or more; 1 acts in every tic"
        )
    return int(frame_skip)


def _open(scenario: str, *, colour: bool) -> tuple[Any, tempfile.TemporaryDirectory[str]]:
    """Start an engine; return it and its working directory."""
    try:
        import vizdoom
    except ImportError as error:
        raise gym.error.DependencyNotInstalled(f"vizdoom cannot be imported: {error}") from error
    shipped = Path(vizdoom.scenarios_path) / f"{scenario}.cfg"
    path = shipped if shipped.exists() else Path(scenario)
    if not path.is_file():
        known = sorted(p.stem for p in Path(vizdoom.scenarios_path).glob("*.cfg"))
        raise ValueError(
            f"scenario {scenario!r}: neither a file nor one of ViZDoom's; expected a .cfg file or "
            f"one of {', '.join(known)}"
        )
    folder = tempfile.TemporaryDirectory(prefix="udrl-doom-")
    game = vizdoom.DoomGame()
    try:
        game.load_config(str(path.resolve()))
        game.set_doom_config_path(os.devnull)  # written on exit, when the directory may be gone
        game.set_screen_resolution(vizdoom.ScreenResolution.RES_160X120)
        formats = vizdoom.ScreenFormat
        game.set_screen_format(formats.RGB24 if colour else formats.GRAY8)
        game.set_mode(vizdoom.Mode.PLAYER)
        game.set_window_visible(False)
        game.set_sound_enabled(False)
        _start(game, folder.name)
        n = game.get_available_buttons_size()
    except Exception as error:
        _discard(game, folder)
        raise RuntimeError(
            f"scenario {str(path)!r}: ViZDoom does not start with it: {type(error).__name__}: "
            f"{error}; correct the file, or what it names"
        ) from error
    if n == 0:
        _discard(game, folder)
        raise ValueError(
            f"scenario {str(path)!r}: it has no buttons; name at least one that ViZDoom has as "
            f"available_buttons, e.g. available_buttons = {{ MOVE_LEFT MOVE_RIGHT }}"
        )
    return game, folder


def _discard(game: Any, folder: tempfile.TemporaryDirectory[str]) -> None:
    """Stop a game's engine, if it runs, and remove its working directory."""
    with contextlib.suppress(Exception):
        game.close()
    folder.cleanup()


def _start(game: Any, folder: str) -> None:
    """Start a game's engine, which ends with this process, even if that is killed.

    Engines write to their working directory, and conflict if two share one. So this process changes
    to the engine's own directory for the tenth of a second that the start takes.
    """
    global _keeper
    with _starting:
        if _keeper is None and Path("/proc/self/environ").exists():
            reads, _keeper = os.pipe()
            command = [sys.executable, "-I", "-S", engine_keeper.__file__, _mark]
            # Without our stdout and stderr: their reader would wait for the keeper's end.
            silent = [(os.POSIX_SPAWN_OPEN, fd, os.devnull, os.O_WRONLY, 0) for fd in (1, 2)]
            os.posix_spawn(
                sys.executable, command, os.environ,
                file_actions=[(os.POSIX_SPAWN_DUP2, reads, 0), *silent], setsid=True,
            )  # fmt: skip
            os.close(reads)
        os.environ[engine_keeper.MARK] = _mark
        here = os.open(".", os.O_RDONLY | os.O_DIRECTORY)
        os.chdir(folder)
        try:
            game.init()
        finally:
            os.fchdir(here)
            os.close(here)
            del os.environ[engine_keeper.MARK]
