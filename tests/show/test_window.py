"""Keyboard input in the window of ``udrl play``."""

from typing import Any

import numpy as np
import pytest

from udrl.errors import ConfigError
from udrl.rollout import Rollout
from udrl_show.window import Window


class Episode:
    """The part of a rollout that a window changes."""

    def __init__(self) -> None:
        self.command = type("Command", (), {"desired_return": 200.0, "desired_horizon": 100,
                                            "temperature": 0.7})  # fmt: skip
        self.desired_return, self.desired_horizon = 150.0, 80
        self.temperature = 0.7

    def set_command(self, desired_return: float, desired_horizon: int) -> None:
        self.desired_return, self.desired_horizon = desired_return, desired_horizon


@pytest.fixture
def window(monkeypatch: pytest.MonkeyPatch) -> Window:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    return Window(fps=1000)


def show(window: Window, episode: Episode, *moments: str) -> bool:
    """Press keys, those of a moment separated by spaces, and show a frame."""
    pygame: Any = window._pygame
    pressed = iter(moments)
    window._keys = lambda: next(pressed).split(", ")  # type: ignore[method-assign]
    picture = np.zeros((40, 60, 3), np.uint8)
    rollout: Any = episode
    assert pygame.display.get_init()
    going_on = window.show(rollout, picture, "a caption")
    assert next(pressed, None) is None, "the window must wait for all keys"
    return going_on


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ("up", (160.0, 80)),
        ("down, down", (130.0, 80)),
        ("page up", (150.0, 85)),
        ("page down, up", (160.0, 75)),
    ],
)
def test_keys_change_the_command(window: Window, keys: str, expected: tuple[float, int]) -> None:
    episode = Episode()
    assert show(window, episode, keys)
    assert (episode.desired_return, episode.desired_horizon) == expected


def test_paused_window_waits_and_single_steps(window: Window) -> None:
    episode = Episode()
    assert show(window, episode, "space", "", "", "right")
    assert show(window, episode, "", "right")
    assert show(window, episode, "", "space")
    assert show(window, episode, "")


def test_greedy_is_toggled(window: Window) -> None:
    episode = Episode()
    show(window, episode, "g")
    assert episode.temperature == 0
    show(window, episode, "g")
    assert episode.temperature == 0.7


def test_quit(window: Window) -> None:
    assert not show(window, Episode(), "up, q")


def test_missing_screen_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ConfigError, match=r"without a screen|there is no screen;"):
        Window(fps=1000)


def test_rollout_has_the_attributes_of_the_stand_in() -> None:
    attributes = {"command", "desired_return", "desired_horizon", "temperature"}
    assert attributes <= set(vars(Episode()))
    assert callable(Rollout.set_command)
