"""Makes environments from a run's settings, and specifies them for the algorithm.

All environments are adapted to the observation spaces of :mod:`udrl.spaces` and the action spaces
of :mod:`udrl.actions`. Errors for unsupported spaces list the supported ones.
"""

import ast
import errno
import math
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from numbers import Integral
from pathlib import PurePath
from typing import Annotated, Any

import gymnasium as gym
import msgspec
from gymnasium.envs.registration import find_highest_version, get_env_id, parse_env_id
from msgspec import Meta

from udrl.actions import ActionSpace
from udrl.config import Config
from udrl.environments.action_conversions import action_conversion
from udrl.environments.adapter import Adapter, close
from udrl.environments.conversions import describe, observation_conversion
from udrl.environments.masking import MASK, CheckMask, ObserveMask, below_observation
from udrl.environments.previous import ObservePrevious
from udrl.environments.time_left import ObserveTime
from udrl.errors import UnsupportedEnvironment
from udrl.setting_groups import ActionSettings
from udrl.spaces import MAX_LEAVES, Bits, ObservationSpace, Vector, leaves_of

Environment = gym.Env[Any, Any]

_EXTRAS = {
    "Box2D": "box2d",
    "pygame": "box2d",
    "matplotlib": "plot",
    "mujoco": "mujoco",
    "vizdoom": "doom",
}


#: Environment variable with an environment's index while it is made, which is unique among the
#: environments of a run on one machine.
INDEX = "UDRL_ENVIRONMENT_INDEX"

#: Attribute of wrappers that repeat actions, such as Gymnasium's ``RepeatAction``.
_REPEATS = "num_repeats"
#: Attribute of Gymnasium's ``TimeLimit``.
_LIMIT = "_max_episode_steps"

_making = threading.RLock()


class EnvironmentSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Specification of an environment.

    Attributes:
        observation_space: space of single observations.
        action_space: space of actions.
        max_episode_steps: step limit of episodes in steps.
        max_return: the highest possible return, if declared; caps evaluation commands (2.3.2).
        action_mask: number of the observation's leaf with the action mask: 1 for allowed actions,
            otherwise 0, for each of the ``n_parameters``. None: all actions are allowed.
    """

    observation_space: ObservationSpace
    action_space: ActionSpace
    max_episode_steps: Annotated[int, Meta(ge=1, le=2**31)]
    max_return: float | None = None
    action_mask: Annotated[int, Meta(ge=0, le=MAX_LEAVES - 1)] | None = None

    @property
    def step_bytes(self) -> int:
        """Bytes of one observation, action and reward, as sent and stored."""
        return self.observation_space.n_bytes + self.action_space.n_bytes + 4


@contextmanager
def indexed(number: int) -> Iterator[None]:
    """Set :data:`INDEX` while an environment is made, which may need it, e.g. to choose a port."""
    with _making:
        before = os.environ.get(INDEX)
        os.environ[INDEX] = str(number)
        try:
            yield
        finally:
            if before is None:
                del os.environ[INDEX]
            else:
                os.environ[INDEX] = before


def make_environment(config: Config) -> Adapter:
    """Return the environment of a run, adapted to the algorithm's spaces.

    Raises:
        UnsupportedEnvironment: it does not exist, cannot be created, has no step limit, or has
            unsupported spaces. The message lists all problems with limit and spaces.
    """
    name = config.environment
    # Passed only if it is set: None would mean "no limit" to Gymnasium.
    limit: dict[str, Any] = {}
    if config.max_episode_steps is not None:
        limit["max_episode_steps"] = config.max_episode_steps
    if (latest := _latest_version(name)) != name:
        raise UnsupportedEnvironment(
            f"environment {name!r} has no version, and the latest one depends on what is "
            f"installed; did you mean {latest!r}?"
        )
    try:
        with indexed(int(os.environ.get(INDEX, "0"))):
            env: Environment = gym.make(
                name, disable_env_checker=True, **(limit | config.environment_kwargs)
            )
    except (Exception, SystemExit) as error:
        raise UnsupportedEnvironment(
            f"environment {name!r} cannot be created: {type(error).__name__}: {_sentence(error)}; "
            f"{_remedy(error, config)}"
        ) from error
    for wrapper in config.wrappers:
        env = _wrapped(env, wrapper)
    longest = _step_limit(env, config)
    if longest is not None:
        limit_steps(env, longest)
        if config.observe_time:
            env = ObserveTime(env, longest)
    return adapt(ObservePrevious(env) if config.observe_previous else env, name, config.actions)


def _latest_version(name: str) -> str:
    """Return the latest version of a registered environment; any other name unchanged."""
    if name in gym.registry or ":" in name:
        return name
    try:
        namespace, base, version = parse_env_id(name)
    except gym.error.Error:
        return name
    latest = find_highest_version(namespace, base)
    return get_env_id(namespace, base, latest) if version is None and latest is not None else name


def _wrapped(env: Environment, name: str) -> Environment:
    module, colon, call = name.partition(":")
    try:
        if not colon:
            raise ValueError("there is no colon")  # noqa: TRY301 - one message for all faults
        attribute, arguments = _called(call)
        wrapped: Any = getattr(import_module(module), attribute)(env, **arguments)
        if not isinstance(wrapped, gym.Env):
            raise TypeError(f"it returned {describe(wrapped)}, not an environment")  # noqa: TRY301
    except (Exception, SystemExit) as error:
        close(env)
        remedy = (
            "name a wrapper that is importable here, as package.module:Wrapper or "
            "package.module:Wrapper(shape=(84, 84))"
        )
        if isinstance(error, TypeError) and " argument" in str(error):
            remedy = "correct its arguments, as in package.module:Wrapper(shape=(84, 84))"
        raise UnsupportedEnvironment(
            f"wrapper {name!r} cannot be applied: {type(error).__name__}: {_sentence(error)}; "
            f"{remedy}"
        ) from error
    result: Environment = wrapped
    return result


def _called(call: str) -> tuple[str, dict[str, Any]]:
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


def adapt(env: Environment, name: str, settings: ActionSettings) -> Adapter:
    """Return an environment adapted to the algorithm's spaces, which checks all values.

    Args:
        env: an environment with a step limit.
        name: its name in messages.
        settings: settings of its action space.

    Raises:
        UnsupportedEnvironment: it has no step limit, or unsupported spaces. The message lists all
            problems, and the environment is closed.
    """
    observations = actions = None
    problems = []
    try:
        actions = action_conversion(env.action_space, settings)
    except UnsupportedEnvironment as error:
        problems.append(str(error))
    if actions is not None and settings.action_mask is not None:
        env = _with_checked_mask(env, settings.action_mask, actions.plain.components)
    try:
        observations = observation_conversion(env.observation_space)
    except UnsupportedEnvironment as error:
        problems.insert(0, str(error))
    if env.spec is None or env.spec.max_episode_steps is None:
        problems.append(
            "it has no step limit, so an episode might never end; set one, e.g. "
            "--set max_episode_steps=1000"
        )
    if observations is None or actions is None or problems:
        close(env)
        raise UnsupportedEnvironment(f"environment {name!r}: {'; also, '.join(problems)}")
    return Adapter(env, observations, actions)


def _with_checked_mask(
    env: Environment, action_mask: str, components: tuple[int, ...]
) -> Environment:
    if action_mask == "info":
        return ObserveMask(env, components)
    return CheckMask(env, action_mask, components)


def _sentence(error: BaseException) -> str:
    """Return an exception's message without a full stop, so that a remedy can follow."""
    return str(error).rstrip().removesuffix(".")


def _remedy(error: BaseException, config: Config) -> str:
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


def specify(env: Environment, config: Config) -> EnvironmentSpec:
    """Return the specification of an environment from :func:`make_environment`.

    Raises:
        UnsupportedEnvironment: it declares an invalid ``max_return``, or has no such action mask.
    """
    longest = _step_limit(env, config)
    assert longest is not None
    space, actions = (env.get_wrapper_attr(name).plain for name in ("observations", "actions"))
    return EnvironmentSpec(
        observation_space=space,
        action_space=actions,
        action_mask=_mask(config, space, actions),
        max_episode_steps=longest,
        max_return=_max_return(env, config),
    )


def _max_return(env: Environment, config: Config) -> float | None:
    """Return the highest possible return: the setting, or what the environment declares."""
    if config.max_return is not None:
        return config.max_return
    declared = getattr(env.unwrapped, "max_return", env.metadata.get("max_return"))
    if declared is None:
        return None
    try:
        number = math.nan if isinstance(declared, str | bytes) else float(declared)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise UnsupportedEnvironment(
            f"environment {config.environment!r} declares max_return = {describe(declared)}, "
            f"expected a finite number, or no declaration if there is no highest return; correct "
            f"it in the environment or its metadata, or override it, e.g. --set max_return=500"
        )
    return number


def _mask(config: Config, space: ObservationSpace, actions: ActionSpace) -> int | None:
    """Return the number of the leaf with the action mask."""
    name = config.actions.action_mask
    if name is None:
        return None
    key = MASK if name == "info" else name
    leaves = [leaf.path for leaf in leaves_of(space)]
    found = [k for k, path in enumerate(leaves) if below_observation(path) == (key,)]
    if not found:
        keys = [below_observation(path) for path in leaves]
        entries = ", ".join(repr(k[0]) for k in keys if len(k) == 1 and isinstance(k[0], str))
        raise UnsupportedEnvironment(
            f"action_mask = {name!r}: environment {config.environment!r} has no such entry; "
            f"expected 'info'{f', or one of {entries}' if entries else ''}"
        )
    leaf = leaves_of(space)[found[0]].space
    if not isinstance(leaf, Bits | Vector) or leaf.size != actions.n_parameters:
        raise UnsupportedEnvironment(
            f"action_mask = {name!r}: it is {leaf}, expected {actions.n_parameters} numbers, 0 or "
            f"1, one for each output of {actions}"
        )
    return found[0]


def _step_limit(env: Environment, config: Config) -> int | None:
    """Return the step limit of an environment's episodes, in actions; None if it has none."""
    if env.spec is None or env.spec.max_episode_steps is None:
        return None
    if config.max_episode_steps is not None:
        return config.max_episode_steps
    return max(1, env.spec.max_episode_steps // _steps_per_action(env))


def _steps_per_action(env: Environment) -> int:
    """Return how many steps of Gymnasium's ``TimeLimit`` an action takes."""
    steps = 1
    while isinstance(env, gym.Wrapper) and _LIMIT not in vars(env):
        repeats = vars(env).get(_REPEATS)
        if isinstance(repeats, Integral):
            steps *= max(1, int(repeats))
        env = env.env
    return steps


def limit_steps(env: Environment, max_steps: int) -> None:
    """Set the step limit of the environment's next episodes, in actions.

    This changes Gymnasium's ``TimeLimit`` wrapper instead of counting steps outside, because the
    wrappers outside it must see the truncation (:class:`~udrl.environments.sparse.RewardAtEnd`).

    Raises:
        UnsupportedEnvironment: it has no ``TimeLimit``.
    """
    steps = max_steps * _steps_per_action(env)
    if not env.set_wrapper_attr(_LIMIT, steps, force=False):
        raise UnsupportedEnvironment(
            f"environment {env} has no gymnasium.wrappers.TimeLimit to set to {max_steps} steps; "
            f"make it with make_environment"
        )
