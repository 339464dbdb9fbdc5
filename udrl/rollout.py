"""Algorithm 2 one step at a time, so that an episode can be watched and its command changed.

:mod:`udrl.acting` runs many commands to the end. With an unchanged command, both produce
bit-identical episodes.
"""

import math
from collections import deque
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from udrl.actions import choose, random_actions
from udrl.commands import Command
from udrl.environments.adapter import Environment, raised
from udrl.environments.step_limits import limit_steps
from udrl.errors import EnvironmentFault, UnsupportedEnvironment
from udrl.inference import MemoryState
from udrl.policy import Policy
from udrl.spaces import parts_of
from udrl.targets import ReturnInTime

Result = TypeVar("Result")

#: Steps for which random numbers are drawn at once.
_STEPS_AT_ONCE = 1024


class Rollout:
    """One episode.

    Args:
        policy: the agent.
        env: its environment, from :func:`udrl.environments.make_environment`.
        command: the command, including the seeds and the temperature.

    Attributes:
        temperature: sampling temperature of the next actions; may be set.
        steps: number of steps taken.
        episode_return: return obtained so far, a sequential sum in float64.
        terminated: whether the environment reached a terminal state.
        truncated: whether a step limit ended the episode.
        action: the last action, an index or one for each component; None before the first.

    Raises:
        EnvironmentFault: the environment raised an exception.
    """

    def __init__(self, policy: Policy, env: Environment, command: Command) -> None:
        self.command = command
        self.temperature = command.temperature
        self.steps = 0
        self.episode_return = 0.0
        self.terminated = self.truncated = False
        self.action: int | list[int] | None = None
        self._policy = policy
        self._env = env
        self._target = ReturnInTime(policy.config.network)
        self._cap = np.array([math.inf if command.cap is None else command.cap])
        self._state: MemoryState | None = None
        self._decisions = command.decisions(0, policy.spec.action_space.shape)
        limit_steps(env, command.max_steps)
        observation = self._guarded("reset", lambda: env.reset(seed=command.environment_seed)[0])
        n = policy.config.network.frame_stack
        self._recent = deque([self._plain(observation)] * n, maxlen=n)
        self.set_command(command.desired_return, command.desired_horizon)

    @property
    def over(self) -> bool:
        """Whether the episode has ended."""
        return self.terminated or self.truncated

    @property
    def probabilities(self) -> npt.NDArray[np.float64]:
        """Distribution P(a | s_t, c_t) of the next action, float64 [n_parameters]."""
        return self._policy.spec.action_space.probabilities(self._advance()[0], self.temperature)

    @property
    def components(self) -> tuple[int, ...]:
        """Number of values of each component of an action."""
        return self._policy.spec.action_space.components

    def set_command(self, desired_return: float, desired_horizon: int) -> None:
        """Change the command for the remaining steps."""
        self._desired = np.array([[desired_return, desired_horizon]], np.float64)
        self._target.bound(self._desired, self._cap)

    @property
    def desired_return(self) -> float:
        """Return still to be obtained, after the countdown."""
        return float(self._desired[0, 0])

    @property
    def desired_horizon(self) -> int:
        """Steps left to obtain it."""
        if self._target.horizon_follows:
            return math.floor(self.desired_return)
        return int(self._desired[0, 1])

    def step(self) -> float:
        """Take one action and return its reward; the episode must not be over.

        Raises:
            EnvironmentFault: the environment raised an exception.
        """
        assert not self.over
        space, (number, is_random) = self._policy.spec.action_space, self._decision()
        logits, self._state = self._advance()
        if is_random:
            k = self._policy.spec.action_mask
            mask = None if k is None else parts_of(self._recent[-1][None])[k]
            actions = random_actions(space, mask, number[None])
        else:
            actions = choose(space, logits[None], self.temperature, number[None])
        self.action = action = actions[0].tolist()
        observation, reward, self.terminated, self.truncated, _ = self._guarded(
            "step", lambda: self._env.step(action)
        )
        self._recent.append(self._plain(observation))
        rounded = np.float32(reward)
        self.steps += 1
        self.episode_return += float(rounded)
        self._target.advance(self._desired, np.array([rounded]))
        self._target.bound(self._desired, self._cap)
        return float(rounded)

    def picture(self) -> npt.NDArray[np.uint8]:
        """Return a rendering of the current state, uint8 [height, width, 3].

        Raises:
            UnsupportedEnvironment: the environment was not made with a ``render_mode`` of
                ``rgb_array``, or has none.
        """
        picture = self._guarded("render", self._env.render)
        if (
            not isinstance(picture, np.ndarray)
            or picture.dtype != np.uint8
            or picture.ndim != 3
            or picture.shape[2] != 3
            or picture.size == 0
        ):
            raise UnsupportedEnvironment(
                f"environment {self._policy.config.environment!r} renders no image of bytes, "
                f"height x width x 3; it must support render_mode='rgb_array' and be created with "
                f"it"
            )
        return picture

    def _decision(self) -> tuple[Any, bool]:
        """Return the number or numbers that choose this action, and whether it is random."""
        t = self.steps
        if t == len(self._decisions.random):
            shape = self._policy.spec.action_space.shape
            self._decisions = self.command.decisions(t + _STEPS_AT_ONCE, shape)
        return self._decisions.numbers[t], bool(self._decisions.random[t])

    def _advance(self) -> tuple[npt.NDArray[np.float64], MemoryState]:
        return self._policy.advance(
            np.stack(self._recent), self.desired_return, self.desired_horizon, self._state
        )

    def _plain(self, observation: Any) -> npt.NDArray[Any]:
        """Return a copy of an observation, in the dtype that the network was trained on."""
        space = self._policy.spec.observation_space
        plain = np.array(observation, space.dtype)
        if found := space.fault(plain[None], 1):
            raise EnvironmentFault(
                f"the environment failed, {self.steps} steps into the episode of seed "
                f"{self.command.environment_seed}: observations are {found}"
            )
        return plain

    def _guarded(self, where: str, call: Callable[[], Result]) -> Result:
        """Call the environment; turn its exceptions into :class:`EnvironmentFault`."""
        try:
            return call()
        except (Exception, SystemExit) as error:
            raise EnvironmentFault(
                f"the environment failed, {self.steps} steps into the episode of seed "
                f"{self.command.environment_seed}: {raised(where, error)}"
            ) from error
