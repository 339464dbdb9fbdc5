"""A window that shows an agent, and changes its command by keyboard."""

import os
from typing import Any

from udrl.errors import ConfigError
from udrl.rollout import Rollout
from udrl_show.film import Picture

KEYS_HELP = (
    "space = pause; right = one step; up/down = desired return; page up/page down = desired "
    "horizon; g = greedy; q = quit"
)

#: Minimum width of a picture, height of a line of text, and margin around the text, in pixels.
_MIN_PICTURE_WIDTH, _LINE, _MARGIN = 480, 22, 6


class Window:
    """Shows pictures at a fixed speed and handles the keyboard.

    Args:
        fps: pictures per second.

    Raises:
        ConfigError: pygame is not installed, or there is no screen.
    """

    def __init__(self, fps: float) -> None:
        try:
            import pygame
        except ModuleNotFoundError as error:
            raise ConfigError(
                'a window needs pygame; install it with: pip install "udrl[play]"'
            ) from error
        self._pygame = pygame
        self._fps = fps
        self._surface: Any = None
        self._is_paused = False
        try:
            pygame.display.init()
        except pygame.error as error:
            raise ConfigError(
                f"a window cannot be opened: {error}; without a screen use --video FILE"
            ) from error
        driver = pygame.display.get_driver()
        if driver in ("offscreen", "dummy") and "SDL_VIDEODRIVER" not in os.environ:
            pygame.display.quit()
            raise ConfigError("a window cannot be opened: there is no screen; use --video FILE")
        pygame.font.init()
        self._font = pygame.font.Font(None, _LINE)
        self._clock = pygame.time.Clock()

    def close(self) -> None:
        """Close the window."""
        self._pygame.display.quit()

    def show(self, rollout: Rollout, picture: Picture, caption: str) -> bool:
        """Show a step of an episode and handle the keys; return False to stop playing."""
        while True:
            self._draw(picture, caption, rollout)
            keys = self._keys()
            if "q" in keys:
                return False
            for key in keys:
                self._handle(key, rollout)
            if not self._is_paused or "right" in keys:
                return True

    def _keys(self) -> list[str]:
        self._clock.tick(self._fps)
        keys = []
        for event in self._pygame.event.get():
            if event.type == self._pygame.QUIT:
                keys.append("q")
            elif event.type == self._pygame.KEYDOWN:
                name = self._pygame.key.name(event.key)
                keys.append("q" if name == "escape" else name)
        return keys

    def _handle(self, key: str, rollout: Rollout) -> None:
        command = rollout.command
        more = max(1.0, abs(command.desired_return) / 20)
        longer = max(1, command.desired_horizon // 20)
        changes = {
            "up": (more, 0), "down": (-more, 0),
            "page up": (0.0, longer), "page down": (0.0, -longer),
        }  # fmt: skip
        if key in changes:
            by_return, by_horizon = changes[key]
            rollout.set_command(
                rollout.desired_return + by_return, rollout.desired_horizon + by_horizon
            )
        elif key == "space":
            self._is_paused = not self._is_paused
        elif key == "g":
            rollout.temperature = (command.temperature or 1.0) if rollout.temperature == 0 else 0.0

    def _draw(self, picture: Picture, caption: str, rollout: Rollout) -> None:
        pygame = self._pygame
        height, width, _ = picture.shape
        enlarge = max(1, -(-_MIN_PICTURE_WIDTH // width))
        size = width * enlarge, height * enlarge
        if self._surface is None:
            self._surface = pygame.display.set_mode((size[0], size[1] + 2 * _LINE + 2 * _MARGIN))
            pygame.display.set_caption("udrl play")
        image = pygame.surfarray.make_surface(picture.swapaxes(0, 1))
        self._surface.fill("black")
        self._surface.blit(pygame.transform.scale(image, size), (0, 0))
        state = "greedy" if rollout.temperature == 0 else f"temperature {rollout.temperature:g}"
        lines = caption, state + (", paused" if self._is_paused else "")
        for number, line in enumerate(lines):
            text = self._font.render(line, True, "white")  # noqa: FBT003 - pygame's own
            self._surface.blit(text, (_MARGIN, size[1] + _MARGIN + number * _LINE))
        pygame.display.flip()
