"""A trained agent to act with: an observation and an order in, an action out."""

import math
from typing import Any

import gymnasium as gym
import msgspec
import numpy as np
import numpy.typing as npt

from udrl.config import Config
from udrl.environments.conversions import describe, nested
from udrl.environments.making import Environment, EnvironmentSpec, make_environment
from udrl.errors import InvalidData
from udrl.inference import ActingFunction, State
from udrl.memory import FrameStack
from udrl.spaces import Leaf, Observations, Record, leaves_of, parts_of


class Policy:
    """A behavior function with the settings that say how to ask it (section 2.3.2).

    The same arguments give the same distribution, to the bit the one that Algorithm 2 samples from
    (:mod:`udrl.acting`). An agent with a ``memory`` remembers what :meth:`predict` was shown since
    :meth:`reset`, which has to be called when an episode begins.

    Args:
        behavior: B(s, c; theta).
        config: the settings that it was trained with.
        spec: of its environment.
        rng: draws the actions; None: seeded by the operating system.
        desired_return: what to ask it for if one has no wishes; None: unknown.
        desired_horizon: in how many steps; likewise.
    """

    def __init__(
        self,
        behavior: ActingFunction,
        config: Config,
        spec: EnvironmentSpec,
        rng: np.random.Generator | None = None,
        *,
        desired_return: float | None = None,
        desired_horizon: int | None = None,
    ) -> None:
        self.behavior = behavior
        self.config = config
        self.spec = spec
        self.desired_return = desired_return
        self.desired_horizon = desired_horizon
        self._memory = FrameStack(spec.observation_space, config.network.frame_stack)
        self._rng = rng or np.random.default_rng()
        self.reset()

    def reset(self) -> None:
        """Forget the episode so far."""
        self._state: State | None = None

    def make_environment(self, **kwargs: Any) -> Environment:
        """Return the environment that it was trained in, with observations as it knows them.

        Args:
            kwargs: further arguments for ``gymnasium.make``, e.g. ``render_mode="human"``.

        Raises:
            UnsupportedEnvironment: it cannot be made here.
        """
        known = self.config.environment_kwargs
        env: Environment = make_environment(
            msgspec.structs.replace(self.config, environment_kwargs=known | kwargs)
        )
        if isinstance(self.spec.observation_space, Record):
            space = env.observation_space
            # A function, since Gymnasium copies what it is given, and a method has its policy.
            env = gym.wrappers.TransformObservation(
                env, lambda record: nested(space, iter(parts_of(record))), space
            )
        if self.config.network.frame_stack == 1:
            return env
        return gym.wrappers.FrameStackObservation(env, self.config.network.frame_stack)

    def logits(
        self, observation: npt.ArrayLike, desired_return: float, desired_horizon: float
    ) -> npt.NDArray[np.float64]:
        """Return the logits of P(a | s, c).

        Args:
            observation: what the environment shows; of a record a structured array will do too.
                With a ``frame_stack`` of more than 1 the most recent ones, the newest last, as
                ``gymnasium.wrappers.FrameStackObservation`` stacks them.
            desired_return: what is still to be obtained.
            desired_horizon: in how many steps; less than 1 counts as 1. It is not read where the
                horizon follows from the return (``desired_horizon = "return"``).

        Returns:
            float64 [n_parameters].

        Raises:
            InvalidData: the observation has another shape than those it was trained on, or
                something is not finite, or the temperature less than 0.
        """
        return self.advance(observation, desired_return, desired_horizon, self._state)[0]

    def advance(
        self,
        observation: npt.ArrayLike,
        desired_return: float,
        desired_horizon: float,
        state: State | None,
    ) -> tuple[npt.NDArray[np.float64], State]:
        """Return the logits, as :meth:`logits`, and what is remembered afterwards.

        Args:
            observation: see :meth:`logits`.
            desired_return: likewise.
            desired_horizon: likewise.
            state: what is remembered; None: nothing, the episode begins.
        """
        desired = np.array([[desired_return, desired_horizon]], np.float64)
        if not np.isfinite(desired).all():
            raise InvalidData(
                f"desired return {desired_return}, desired horizon {desired_horizon}: expected "
                f"finite numbers"
            )
        seen = self._memory.join(self._plain(observation)[None])
        rows, after = self.behavior.advance(seen, desired, state)
        return rows[0].astype(np.float64), after

    def _plain(self, observation: Any) -> Observations:
        """Return what the environment showed as an array, [frame_stack, *observation_shape]."""
        space, n = self.spec.observation_space, self._memory.length
        plain: Observations = np.empty((n, *space.shape), space.dtype)
        parts = zip(leaves_of(space), parts_of(plain), self._memory.shapes, strict=True)
        for leaf, part, joined in parts:
            seen = np.asarray(_find(leaf, observation))
            expected = part.shape[1:] if n == 1 else joined
            if seen.shape not in (expected, part.shape):
                raise InvalidData(
                    f"an observation{leaf.name} of shape {seen.shape}: expected {expected}; show "
                    f"the policy what it was trained on ({self.config.environment})"
                )
            if not np.isfinite(seen).all():
                raise InvalidData(f"observation{leaf.name}: {seen}; expected finite numbers")
            part[:] = seen.reshape(part.shape)
        return plain

    def probabilities(
        self,
        observation: npt.ArrayLike,
        desired_return: float,
        desired_horizon: float,
        temperature: float = 1.0,
    ) -> npt.NDArray[np.float64]:
        """Return P(a | s, c), float64 [n_parameters]; arguments and errors as of :meth:`logits`.

        Args:
            observation: see :meth:`logits`.
            desired_return: likewise.
            desired_horizon: likewise.
            temperature: logits are divided by it; 0: all on the mode.
        """
        _check(temperature)
        logits = self.logits(observation, desired_return, desired_horizon)
        return self.spec.action_space.probabilities(logits, temperature)

    def predict(
        self,
        observation: npt.ArrayLike,
        desired_return: float,
        desired_horizon: float,
        *,
        temperature: float = 1.0,
        deterministic: bool = False,
    ) -> Any:
        """Return an action of P(a | s, c); arguments and errors as of :meth:`logits`.

        Who acts counts down: after a reward r ask for ``desired_return - r`` within
        ``desired_horizon - 1`` steps (Algorithm 2).

        Args:
            observation: see :meth:`logits`.
            desired_return: likewise.
            desired_horizon: likewise.
            temperature: logits are divided by it; 0: take the mode.
            deterministic: the same as a temperature of 0.
        """
        _check(temperature)
        logits, self._state = self.advance(
            observation, desired_return, desired_horizon, self._state
        )
        space = self.spec.action_space
        uniform: Any = self._rng.random(space.shape)
        return space.choose(logits, 0.0 if deterministic else temperature, uniform)


def _find(leaf: Leaf, observation: Any) -> Any:
    """Return a leaf of what an environment shows, plain or its own."""
    try:
        if isinstance(observation, np.ndarray | np.void) and observation.dtype.names:
            return observation[leaf.name]
        return leaf.find(observation)
    except (LookupError, ValueError) as error:
        raise InvalidData(
            f"observation{leaf.name} is missing in {describe(observation)}; show the policy what "
            f"it was trained on"
        ) from error


def _check(temperature: float) -> None:
    if not 0 <= temperature < math.inf:
        raise InvalidData(f"temperature {temperature}: expected a finite number from 0 on")
