"""Names of actions and their values, for the board."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import msgspec
import numpy as np
from gymnasium import spaces

from udrl.environments.adapter import Adapter
from udrl.environments.conversions import leaves_within

#: Names of actions that environments do not declare, by prefix of the environment's id.
_KNOWN = {
    "Acrobot": ("torque -1", "no torque", "torque +1"),
    "Blackjack": ("stick", "hit"),
    "CartPole": ("push left", "push right"),
    "CliffWalking": ("up", "right", "down", "left"),
    "FrozenLake": ("left", "down", "right", "up"),
    "LunarLander": ("no engine", "left engine", "main engine", "right engine"),
    "MountainCar": ("push left", "coast", "push right"),
    "TakeCover": ("left", "right"),
    "Taxi": ("south", "north", "east", "west", "pick up", "drop off"),
}


class ActionComponent(msgspec.Struct, frozen=True, kw_only=True):
    """One component of an action.

    Attributes:
        name: name of the component; empty if it is the only one.
        values: names of its values.
    """

    name: str
    values: list[str]


def action_components(env: Adapter) -> list[ActionComponent]:
    """Return an action's components, in the order of their probabilities."""
    components: list[tuple[str, list[str]]] = []
    for path, space in leaves_within(env.env.action_space):
        values = _values_of(env, path, space, len(components))
        leaf = ".".join(map(str, path))
        for k, names in enumerate(values):
            numbered = f"{leaf}[{k}]" if leaf else f"component {k}"
            components.append((leaf if leaf and len(values) == 1 else numbered, names))
    if len(components) == 1:
        components = [("", components[0][1])]
    return [ActionComponent(name=name, values=values) for name, values in components]


def _values_of(
    env: Adapter, path: tuple[Any, ...], space: spaces.Space[Any], first: int
) -> list[list[str]]:
    """Return the names of the values of a leaf's components, the first with index ``first``."""
    match space:
        case spaces.Discrete(n=n, start=start):
            known = () if path else _declared(env) or _known(env)
            usable = len(known) == n
            return [list(known) if usable else [str(start + i) for i in range(n)]]
        case spaces.MultiDiscrete(nvec=ns, start=starts):
            pairs = zip(ns.reshape(-1).tolist(), starts.reshape(-1).tolist(), strict=True)
            return [[str(start + i) for i in range(n)] for n, start in pairs]
        case spaces.MultiBinary():
            return [["off", "on"]] * int(np.prod(space.shape))
    return _bins(env, path, space, first)


def _bins(
    env: Adapter, path: tuple[Any, ...], space: spaces.Space[Any], first: int
) -> list[list[str]]:
    """Return the values of a ``Box`` that its bins represent."""
    ns = env.actions.plain.components
    last = first + int(np.prod(space.shape or ()))

    def numbers(index: int) -> list[float]:
        action = env.actions.back_one(np.minimum(index, np.array(ns) - 1))
        for key in path:
            action = action[key]
        found: list[float] = np.asarray(action).reshape(-1).tolist()
        return found

    table = [numbers(index) for index in range(max(ns[first:last]))]
    return [[f"{row[k]:.3g}" for row in table[:n]] for k, n in enumerate(ns[first:last])]


def _declared(env: gym.Env[Any, Any]) -> tuple[str, ...]:
    """Return the names that the environment declares, by Atari's method or in its metadata."""
    try:
        meanings: Callable[[], list[str]] | None = getattr(
            env.unwrapped, "get_action_meanings", None
        )
        found = meanings() if callable(meanings) else env.metadata.get("action_names", ())
        return tuple(str(name).lower().replace("_", " ") for name in found)
    except Exception:  # noqa: BLE001 - foreign code, and names are optional
        return ()


def _known(env: gym.Env[Any, Any]) -> tuple[str, ...]:
    name = "" if env.spec is None else env.spec.id
    return next((names for start, names in _KNOWN.items() if name.startswith(start)), ())
