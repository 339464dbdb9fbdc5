"""Messages between a page and its stage."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from udrl.setting_groups import Temperature
from udrl.strategies import MAX_DESIRED
from udrl_board.action_names import ActionComponent
from udrl_proto.messages import Number

Return = Annotated[float, Meta(ge=-MAX_DESIRED, le=MAX_DESIRED)]
Horizon = Annotated[int, Meta(ge=-(2**31), le=2**31 - 1)]
#: Multiple of the environment's own speed.
Speed = Annotated[float, Meta(ge=1 / 16, le=64)]


class StartEpisode(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", tag="start"):
    """Start an episode; a running one is aborted."""

    desired_return: Return
    desired_horizon: Horizon
    seed: Annotated[int, Meta(ge=0, le=2**31 - 1)]
    temperature: Temperature = 1.0
    version: Number | Literal["latest", "best"] = "latest"
    paused: bool = False


class ChangeCommand(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", tag="change"):
    """Change the command during the episode; None leaves a value unchanged."""

    desired_return: Return | None = None
    desired_horizon: Horizon | None = None
    temperature: Temperature | None = None


class SetPaused(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", tag="pause"):
    """Pause or resume."""

    paused: bool


class TakeStep(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", tag="step"):
    """Take one step."""


class SetSpeed(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", tag="speed"):
    """Set the speed of this episode and later ones."""

    speed: Speed


StageRequest = StartEpisode | ChangeCommand | SetPaused | TakeStep | SetSpeed


class Moment(msgspec.Struct, frozen=True, kw_only=True):
    """The state of an episode.

    Attributes:
        seed: seed of the episode.
        version: weights version.
        commanded_return, commanded_horizon: initial command.
        desired_return, desired_horizon: current command, after the countdown.
        temperature: sampling temperature of the next action.
        step: steps so far.
        obtained: return so far.
        action: last action, an index or one per component; None before the first.
        probabilities: probabilities of the next action, component by component; empty when the
            episode has ended.
        actions: names of the components and values; only in the first moment of an episode.
        over: whether the episode has ended.
        truncated: whether a step limit ended it.
        is_changed: whether the command was changed during the episode.
        paused: whether the episode is paused.
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
        is_over: whether it ended the episode.
    """

    problem: str
    is_over: bool = False
