"""A trained agent: observation and command in, action out."""

import math
from typing import Any

import gymnasium as gym
import msgspec
import numpy as np
import numpy.typing as npt

from udrl.actions import choose
from udrl.config import Config
from udrl.environments.adapter import Environment
from udrl.environments.conversions import nested
from udrl.environments.making import make_environment
from udrl.environments.specification import EnvironmentSpec
from udrl.errors import InvalidData
from udrl.inference import ActingFunction, MemoryState
from udrl.policy_inputs import PolicyInputs
from udrl.spaces import Record, parts_of


class Policy:
    """A behavior function with its settings (section 2.3.2).

    Its distributions are bit-identical to those that Algorithm 2 samples from (:mod:`udrl.acting`).
    An agent with a ``memory`` remembers the observations that :meth:`predict` received since
    :meth:`reset`, which must be called at the beginning of each episode.

    All methods also take a batch: a desired return and a desired horizon for each of ``n``
    observations, which are stacked along the first dimension as vector environments do. A single
    desired return or horizon is used for all of them::

        actions = policy.predict(observations, np.full(8, 200.0), 300)

    Args:
        behavior: B(s, c; theta).
        config: settings of its run.
        spec: specification of its environment.
        rng: source of random numbers for actions. None: seeded by the operating system.
        desired_return: return of the default command. None: unknown.
        desired_horizon: horizon of the default command. None: unknown.
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
        self._inputs = PolicyInputs(spec, config)
        self._rng = rng or np.random.default_rng()
        self.reset()

    def reset(self, rows: npt.ArrayLike | None = None) -> None:
        """Begin an episode: forget the observations so far.

        Args:
            rows: the rows of a batch whose episodes begin, bool [n]. None: all.

        Raises:
            InvalidData: the number of rows is not that of the batch so far.
        """
        if rows is None:
            self._state: MemoryState | None = None
        elif self._state is not None:
            begins = np.asarray(rows, bool)
            if begins.shape != (len(self._state),):
                raise InvalidData(
                    f"rows of shape {begins.shape}: expected ({len(self._state)},), one for each "
                    f"row of the batch"
                )
            self._state = np.where(begins[:, None], np.float32(0), self._state)

    def make_environment(self, **kwargs: Any) -> Environment:
        """Create the environment of the agent, with observations as in training.

        Args:
            kwargs: further arguments for ``gymnasium.make``, e.g. ``render_mode="human"``.

        Raises:
            UnsupportedEnvironment: the environment cannot be created here.
        """
        known = self.config.environment_kwargs
        env: Environment = make_environment(
            msgspec.structs.replace(self.config, environment_kwargs=known | kwargs)
        )
        if isinstance(self.spec.observation_space, Record):
            space = env.observation_space
            # A function, because Gymnasium copies it; a method would drag the policy along.
            env = gym.wrappers.TransformObservation(
                env, lambda record: nested(space, iter(parts_of(record))), space
            )
        if self.config.network.frame_stack == 1:
            return env
        return gym.wrappers.FrameStackObservation(env, self.config.network.frame_stack)

    def logits(
        self,
        observation: npt.ArrayLike,
        desired_return: npt.ArrayLike,
        desired_horizon: npt.ArrayLike,
    ) -> npt.NDArray[np.float64]:
        """Return the logits of P(a | s, c).

        Args:
            observation: an observation of the environment, or a batch; a record can also be a
                structured array. With a ``frame_stack`` of more than 1, the last observations,
                newest last, as ``gymnasium.wrappers.FrameStackObservation`` stacks them.
            desired_return: the return still to be obtained.
            desired_horizon: the steps left for it; less than 1 counts as 1. Not used by agents
                without this input (``horizon_scale = 0``), or if the horizon follows from the
                return (``horizon_equals_return = true``).

        Returns:
            float64 [n_parameters]; for a batch [n, n_parameters].

        Raises:
            InvalidData: the observation's shape differs from that in training, a value is not
                finite or impossible in training, or the memory is that of another batch.
        """
        return self.advance(observation, desired_return, desired_horizon, self._state)[0]

    def advance(
        self,
        observation: npt.ArrayLike,
        desired_return: npt.ArrayLike,
        desired_horizon: npt.ArrayLike,
        state: MemoryState | None,
    ) -> tuple[npt.NDArray[np.float64], MemoryState]:
        """Return the logits, like :meth:`logits`, and the memory at the next step.

        Args:
            observation: see :meth:`logits`.
            desired_return: likewise.
            desired_horizon: likewise.
            state: the memory. None: empty, as at the beginning of an episode.

        Raises:
            InvalidData: see :meth:`logits`.
        """
        seen, desired, n = self._inputs.convert(observation, desired_return, desired_horizon)
        if state is not None and len(state) != (n or 1):
            what = "a single observation" if n is None else f"a batch of {n} observations"
            raise InvalidData(
                f"{what}, but the memory is that of {len(state)} episodes; call reset() first"
            )
        if n is None:
            rows, after = self.behavior.advance(seen, desired, state)
            return rows[0].astype(np.float64), after
        call = self.behavior.call(n)
        for given, array in zip(call.seen, seen, strict=True):
            given[:] = array
        call.command[:] = desired
        call.state[:] = 0 if state is None else state
        call.run()
        return call.logits.astype(np.float64), call.next_state.copy()

    def probabilities(
        self,
        observation: npt.ArrayLike,
        desired_return: npt.ArrayLike,
        desired_horizon: npt.ArrayLike,
        temperature: float = 1.0,
    ) -> npt.NDArray[np.float64]:
        """Return P(a | s, c), float64, of the same shape as :meth:`logits`.

        Args:
            observation: see :meth:`logits`.
            desired_return: likewise.
            desired_horizon: likewise.
            temperature: divisor of the logits; 0 = probability 1 for the most likely action.

        Raises:
            InvalidData: see :meth:`logits`; also if the temperature is negative or not finite.
        """
        _check_temperature(temperature)
        logits = self.logits(observation, desired_return, desired_horizon)
        space = self.spec.action_space
        if logits.ndim == 1:
            return space.probabilities(logits, temperature)
        return np.stack([space.probabilities(row, temperature) for row in logits])

    def predict(
        self,
        observation: npt.ArrayLike,
        desired_return: npt.ArrayLike,
        desired_horizon: npt.ArrayLike,
        *,
        temperature: float = 1.0,
        deterministic: bool = False,
    ) -> Any:
        """Sample an action from P(a | s, c).

        The caller counts down: after a reward r, pass ``desired_return - r`` and
        ``desired_horizon - 1`` (Algorithm 2).

        Args:
            observation: see :meth:`logits`.
            desired_return: likewise.
            desired_horizon: likewise.
            temperature: divisor of the logits; 0 = the most likely action.
            deterministic: same as a temperature of 0.

        Returns:
            The action; for a batch, the actions, stacked along the first dimension. They are the
            same as those of single calls with the same random numbers.

        Raises:
            InvalidData: see :meth:`logits`; also if the temperature is negative or not finite.
        """
        _check_temperature(temperature)
        temperature = 0.0 if deterministic else temperature
        logits, after = self.advance(observation, desired_return, desired_horizon, self._state)
        self._state = after if after.shape[1] else None  # without a memory, batches may change size
        space, rows = self.spec.action_space, np.atleast_2d(logits)
        actions = choose(space, rows, temperature, self._rng.random((len(rows), *space.shape)))
        if logits.ndim == 2:
            return actions
        return actions[0] if space.shape else int(actions[0])


def _check_temperature(temperature: float) -> None:
    if not 0 <= temperature < math.inf:
        raise InvalidData(f"temperature {temperature}: expected a finite number of at least 0")
