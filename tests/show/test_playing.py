"""Pictures and speed of environments, as they declare them."""

import math
from typing import Any

import gymnasium as gym
import pytest

from udrl.config import Config, build
from udrl.errors import UnsupportedEnvironment
from udrl_show.playing import filmed, fps_of


class Declares(gym.Env[Any, Any]):
    """Declares the given metadata."""

    def __init__(self, **metadata: Any) -> None:
        self.metadata = metadata


@pytest.mark.parametrize("declared", [None, 0, -1, "many", math.nan, math.inf, [30]])
def test_invalid_speed_counts_as_undeclared(declared: Any) -> None:
    assert fps_of(Declares()) == fps_of(Declares(render_fps=declared)) == 30


@pytest.mark.parametrize("declared", [25, 0.5, "25"])
def test_declared_speed_is_used(declared: Any) -> None:
    assert fps_of(Declares(render_fps=declared)) == float(declared)


@pytest.mark.filterwarnings("ignore:.*render_modes:UserWarning")
@pytest.mark.parametrize("modes", [None, 5, [], ["human"]])
def test_environment_without_pictures_is_rejected(
    modes: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = build(Config, {"environment": "Obedience-v0"})
    unwrapped = type(gym.make("Obedience-v0").unwrapped)
    monkeypatch.setattr(unwrapped, "metadata", {"render_modes": modes})
    with pytest.raises(UnsupportedEnvironment, match="has no pictures to show"):
        filmed(config)
