"""What to do if an environment cannot be created."""

import errno
import threading
from pathlib import PurePath

import gymnasium as gym

from udrl.config import Config

#: Extras of this project, by the word for the missing package in an exception's message.
_EXTRAS = {
    "Box2D": "box2d",
    "pygame": "box2d",
    "matplotlib": "plot",
    "mujoco": "mujoco",
    "vizdoom": "doom",
}


def sentence(error: BaseException) -> str:
    """Return an exception's message without a full stop, so that a remedy can follow."""
    return str(error).rstrip().removesuffix(".")


def remedy(error: BaseException, config: Config) -> str:
    """Return the remedy for an exception of ``gymnasium.make``."""
    text = str(error)
    module, colon, name = config.environment.rpartition(":")
    path = PurePath(module if colon else name)
    if path.suffix == ".py" or (colon and "/" in module):
        return (
            f"name the module as in an import, not its file: {path.stem}:"
            f"{name if colon else 'Env-v0'}, and start in the directory that contains it"
        )
    if isinstance(error, gym.error.DependencyNotInstalled | ImportError):
        for package, extra in _EXTRAS.items():
            if package.lower() in text.lower():
                return f'install it with: pip install "udrl[{extra}]"'
        if isinstance(error, ModuleNotFoundError) and ":" in config.environment:
            return (
                "install the package that provides it, or start in the directory that contains "
                "the module"
            )
        return "install the package that provides it"
    if isinstance(error, gym.error.UnregisteredEnv) and colon:
        return f"check the name, or call gymnasium.register({name!r}, ...) in {module}"
    if isinstance(error, gym.error.Error):
        return "name an id registered with Gymnasium, or an importable one as package.module:Env-v0"
    if threading.current_thread() is not threading.main_thread() and _needs_main_thread(text):
        return (
            "it must be created in the main thread of a process: train without --in-process (in "
            "Python: in_process=False), and watch it with udrl play instead of the board"
        )
    if isinstance(error, OSError) and error.errno == errno.EADDRINUSE:
        return (
            "another copy of it, or another program, uses this port; if only one copy can run at a "
            "time, add --actors 1 --envs-per-actor 1"
        )
    if isinstance(error, TypeError) and "unexpected keyword argument" in text:
        return "remove arguments that it does not accept from environment_kwargs"
    if isinstance(error, TypeError) and "missing" in text and "required" in text:
        return "pass the argument, e.g. --set 'environment_kwargs={NAME=VALUE}'"
    arguments = "".join(f", {name}={value!r}" for name, value in config.environment_kwargs.items())
    return (
        f"the cause is in the environment, its files or its arguments; in Python, "
        f"gymnasium.make({config.environment!r}{arguments}) shows where"
    )


def _needs_main_thread(text: str) -> bool:
    """Return whether an exception's text suggests that the code must run in the main thread."""
    return any(word in text.lower() for word in ("main thread", "event loop", "signal"))
