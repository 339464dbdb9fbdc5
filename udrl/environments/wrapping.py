"""Wrappers that are named in settings."""

import ast
from importlib import import_module
from typing import Any

import gymnasium as gym

from udrl.environments.adapter import Environment
from udrl.environments.conversions import describe
from udrl.environments.creation_remedies import sentence
from udrl.errors import UnsupportedEnvironment


def wrapped(env: Environment, name: str) -> Environment:
    """Return an environment in the wrapper that a setting names.

    Args:
        env: the environment.
        name: ``package.module:Wrapper``, or with keyword arguments,
            ``package.module:Wrapper(shape=(84, 84))``.

    Raises:
        UnsupportedEnvironment: the wrapper cannot be imported or applied.
    """
    module, colon, call = name.partition(":")
    try:
        if not colon:
            raise ValueError("there is no colon")  # noqa: TRY301 - one message for all faults
        attribute, arguments = _parsed(call)
        found: Any = getattr(import_module(module), attribute)(env, **arguments)
    except (Exception, SystemExit) as error:
        remedy = (
            "name a wrapper that is importable here, as package.module:Wrapper or "
            "package.module:Wrapper(shape=(84, 84))"
        )
        if isinstance(error, TypeError) and " argument" in str(error):
            remedy = "correct its arguments, as in package.module:Wrapper(shape=(84, 84))"
        raise UnsupportedEnvironment(
            f"wrapper {name!r} cannot be applied: {type(error).__name__}: {sentence(error)}; "
            f"{remedy}"
        ) from error
    if not isinstance(found, gym.Wrapper):
        raise UnsupportedEnvironment(
            f"wrapper {name!r} returned {describe(found)}, expected a gymnasium.Wrapper; derive "
            f"its class from gymnasium.Wrapper, so that the step limit inside can be set"
        )
    return found


def _parsed(call: str) -> tuple[str, dict[str, Any]]:
    """Return name and keyword arguments of a call; these are literals, nothing is evaluated."""
    node = ast.parse(call.strip(), mode="eval").body
    arguments: dict[str, Any] = {}
    if isinstance(node, ast.Call):
        if node.args:
            raise ValueError("arguments need names")
        arguments = {str(k.arg): ast.literal_eval(k.value) for k in node.keywords}
        node = node.func
    if not isinstance(node, ast.Name):
        raise TypeError("there is no class name after the colon")
    return node.id, arguments
