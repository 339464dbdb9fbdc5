"""Messages between a page and its stage."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from udrl.setting_groups import Temperature
from udrl_board.action_names import ActionComponent

Return = Annotated[float, Meta(ge=-1e9, le=1e9)]
Horizon = Annotated[int, Meta(ge=-(2**31), le=2**31 - 1)]
#: Multiple of the environment's own speed.
Speed = Annotated[float, Meta(ge=1 / 16, le=64)]


class StartEpisode(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", tag="start"):
    """Start an episode; a running one ends without a result."""

    desired_return: Return
    desired_horizon: Horizon
    seed: Annotated[int, Meta(ge=0, le=2**31 - 1)]
    temperature: Temperature = 1.0
    version: Annotated[int, Meta(ge=0, le=2**62)] | Literal["latest", "best"] = "latest"
    paused: bool = False


class ChangeCommand(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", tag="change"):
    """Change the command during the episode; what is None stays as it is."""

    desired_return: Return | None = None
    desired_horizon: Horizon | None = None
    temperature: Temperature | None = None


class SetPaused(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", tag="pause"):
    """Pause or resume."""

    paused: bool


class TakeStep(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", tag="step"):
    """Take one step."""


class SetSpeed(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", tag="speed"):
    """Set the speed of this episode and of those that follow."""

    speed: Speed


StageRequest = StartEpisode | ChangeCommand | SetPaused | TakeStep | SetSpeed


class Moment(msgspec.Struct, frozen=True, kw_only=True):
    """The state of an episode.

    Attributes:
        seed: of the episode.
        version: of the weights.
        commanded_return, commanded_horizon: the command that it started with.
        desired_return, desired_horizon: the command now, after the countdown.
        temperature: of the next action.
        step: steps so far.
        obtained: return so far.
        action: the last one, an index or one for each component; None before the first.
        probabilities: of the next action, component by component; empty when it is over.
        actions: names of the components and values, in the first moment of an episode.
        over: whether it has ended.
        truncated: whether a time limit ended it.
        is_changed: whether the command was changed during the episode.
        paused: whether it is paused.
        picture: whether a picture follows.
    """

    seed: int
    version: int
    commanded_return: float
    commanded_horizon: int
    desired_return: float
    desired_horizon: int
    temperature: float
    step: int
    obtained: float
    action: int | list[int] | None
    probabilities: list[float]
    actions: list[ActionComponent] | None
    over: bool
    truncated: bool
    is_changed: bool
    paused: bool
    picture: bool


class StageProblem(msgspec.Struct, frozen=True, kw_only=True):
    """A request failed.

    Attributes:
        problem: the reason.
        is_over: whether the episode has ended because of it.
    """

    problem: str
    is_over: bool = False
