"""Environments that deviate from Gymnasium's conventions: some are accepted, others rejected."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class Plain(gym.Env[Any, Any]):
    """Ten regular steps: observes the step's number and the seed; action 1 pays 1."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}
    observation_space: spaces.Space[Any] = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space: spaces.Space[Any] = spaces.Discrete(2)

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode

    def seen(self) -> Any:
        return np.array([self.t, self.seed], np.float32)

    def pay(self, action: Any) -> Any:
        return float(action)

    def over(self) -> Any:
        return self.t >= 10

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.t, self.seed = 0, float(self.np_random.integers(100_000)) / 1000
        return self.seen(), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        return self.seen(), self.pay(action), self.over(), False, {}

    def render(self) -> Any:
        return np.zeros((32, 32, 3), np.uint8)


# Accepted conventions: their meaning is unambiguous.


class ShowsFloat64(Plain):
    def seen(self) -> Any:
        return np.array([self.t, self.seed], np.float64)


class ShowsList(Plain):
    def seen(self) -> Any:
        return [float(self.t), self.seed]


class PaysArray(Plain):
    def pay(self, action: Any) -> Any:
        return np.array([float(action)])


class PaysNumpy(Plain):
    def pay(self, action: Any) -> Any:
        return np.float64(action)


class PaysInteger(Plain):
    def pay(self, action: Any) -> Any:
        return int(action)


class EndsInNumpy(Plain):
    def over(self) -> Any:
        return np.bool_(self.t >= 10)


class EndsInArray(Plain):
    def over(self) -> Any:
        return np.array([self.t >= 10])


class EndsInIntegers(Plain):
    def over(self) -> Any:
        return int(self.t >= 10)


class WantsNumpysAction(Plain):
    def pay(self, action: Any) -> Any:
        return float(action.item())


class WantsAnActionOfItsSpace(Plain):
    def pay(self, action: Any) -> Any:
        assert self.action_space.contains(action), type(action)
        return float(action)


class StepsToList(Plain):
    def step(self, action: Any) -> Any:
        return list(super().step(action))


class ClosesWithAnError(Plain):
    def close(self) -> None:
        raise AttributeError("'NoneType' object has no attribute 'close'")


# Rejected conventions: their meaning is ambiguous.


class ResetsToObservation(Plain):
    def reset(self, **arguments: Any) -> Any:
        return super().reset(**arguments)[0]


class ResetsToThree(Plain):
    def reset(self, **arguments: Any) -> Any:
        return *super().reset(**arguments), {}


class ResetsWithoutInfo(Plain):
    def reset(self, **arguments: Any) -> Any:
        return super().reset(**arguments)[0], None


class StepsAsOldGymDid(Plain):
    def step(self, action: Any) -> Any:
        observation, reward, terminated, _, info = super().step(action)
        return observation, reward, terminated, info


class ShowsAnotherShape(Plain):
    def seen(self) -> Any:
        return super().seen()[None]


class ShowsOneNumber(Plain):
    def seen(self) -> Any:
        return self.t


class ShowsTwoParts(Plain):
    def seen(self) -> Any:
        return {"position": super().seen()}


class ShowsRaggedLists(Plain):
    def seen(self) -> Any:
        return [[1.0], [1.0, 2.0]]


class ShowsText(Plain):
    def seen(self) -> Any:
        return np.array(["a", "b"])


class ShowsNan(Plain):
    def seen(self) -> Any:
        return np.array([self.t, np.nan], np.float32)


class ShowsStateBeyondItsSpace(Plain):
    observation_space = spaces.Discrete(8)

    def seen(self) -> Any:
        return self.t


class ShowsFractionOfAState(Plain):
    observation_space = spaces.Discrete(11)

    def seen(self) -> Any:
        return self.t / 2


class ShowsFloatPixels(Plain):
    observation_space = spaces.Box(0, 255, (4, 4), np.uint8)

    def seen(self) -> Any:
        return np.full((4, 4), self.t / 10)


class ShowsPixelsBelowZero(Plain):
    observation_space = spaces.Box(0, 255, (4, 4), np.uint8)

    def seen(self) -> Any:
        return np.full((4, 4), -self.t - 1)


class PaysNothing(Plain):
    def pay(self, action: Any) -> Any:
        return None


class PaysTwice(Plain):
    def pay(self, action: Any) -> Any:
        return np.array([1.0, 2.0])


class PaysText(Plain):
    def pay(self, action: Any) -> Any:
        return "1.0"


class PaysComplex(Plain):
    def pay(self, action: Any) -> Any:
        return 1j


class PaysInfinity(Plain):
    def pay(self, action: Any) -> Any:
        return float("inf")


class PaysMoreThanFloat32Holds(Plain):
    def pay(self, action: Any) -> Any:
        return 1e39


class EndsInText(Plain):
    def over(self) -> Any:
        return "no"


class EndsInNone(Plain):
    def over(self) -> Any:
        return None


class EndsInParts(Plain):
    def over(self) -> Any:
        return np.array([True, False])


BORNE: tuple[type[Plain], ...] = (
    ShowsFloat64, ShowsList, PaysArray, PaysNumpy, PaysInteger, EndsInNumpy, EndsInArray,
    EndsInIntegers, StepsToList, WantsNumpysAction, WantsAnActionOfItsSpace, ClosesWithAnError,
)  # fmt: skip

#: For each: the error's description of the returned value and of the declared one.
REFUSED: dict[type[Plain], tuple[str, str]] = {
    ResetsToObservation: ("an array of float32, shape (2,)", "(observation, info)"),
    ResetsToThree: ("a tuple of 3", "(observation, info)"),
    ResetsWithoutInfo: ("None (NoneType) as info", "a dictionary"),
    StepsAsOldGymDid: ("a tuple of 4", "since Gym 0.26"),
    ShowsAnotherShape: ("an array of float32, shape (1, 2)", "Box(-inf, inf, (2,), float32)"),
    ShowsOneNumber: ("0 (int)", "Box(-inf, inf, (2,), float32)"),
    ShowsTwoParts: ("a dict of 'position'", "Box(-inf, inf, (2,), float32)"),
    ShowsRaggedLists: ("a list of 2", "inhomogeneous"),
    ShowsText: ("an array of <U1, shape (2,)", "Box(-inf, inf, (2,), float32)"),
    ShowsNan: ("observations are not all finite numbers", ""),
    ShowsStateBeyondItsSpace: ("8 (int", "Discrete(8)"),
    ShowsFractionOfAState: ("0.0 (float)", "Discrete(11)"),
    ShowsFloatPixels: ("an array of float64, shape (4, 4)", "Box(0, 255, (4, 4), uint8)"),
    ShowsPixelsBelowZero: ("an array of int64, shape (4, 4)", "Box(0, 255, (4, 4), uint8)"),
    PaysNothing: ("None (NoneType) as reward", "a number"),
    PaysTwice: ("an array of float64, shape (2,) as reward", "a number"),
    PaysText: ("'1.0' (str) as reward", "a number"),
    PaysComplex: ("1j (complex) as reward", "a number"),
    PaysInfinity: ("the reward inf", "a finite number"),
    PaysMoreThanFloat32Holds: ("the reward 1e+39", "float32"),
    EndsInText: ("'no' (str) as terminated", "True or False"),
    EndsInNone: ("None (NoneType) as terminated", "True or False"),
    EndsInParts: ("an array of bool, shape (2,) as terminated", "True or False"),
}


def register(kind: Callable[..., gym.Env[Any, Any]], max_steps: int | None = 50) -> str:
    """Register an environment with Gymnasium; return its id."""
    name = f"{getattr(kind, '__name__', 'Some')}-v0"
    gym.registry.pop(name, None)
    gym.register(name, entry_point=kind, max_episode_steps=max_steps)
    return name
