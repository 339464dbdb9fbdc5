"""Algorithm 2, for many episodes at once (section 2.3.5).

::

    generator = EpisodeGenerator(config, n_environments=16)
    while commands or generator.running:
        while commands and generator.free:
            generator.start(commands.pop(), behavior)
        for outcome in generator.step():
            ...  # an Episode, or a Failure

The behavior function is evaluated for all environments in one call. Which rows stand beside it does
not change a row's result (:class:`udrl.inference.ActingFunction`), so an episode depends on its
command alone. With a ``frame_stack`` of more than 1 it sees the episode's most recent observations
(:func:`udrl.episode.recent`).
"""

import contextlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from udrl.architecture import stacked_shape
from udrl.commands import Command
from udrl.config import Config
from udrl.environments.making import (
    Environment,
    EnvironmentSpec,
    limit_steps,
    make_environment,
    specify,
)
from udrl.episode import Episode, action_dtype, recent
from udrl.errors import EnvironmentFault
from udrl.inference import Acting, Call
from udrl.streams import Stream

#: Failures under the same command after which it is hopeless.
MAX_FAILURES = 3

_FIRST_CAPACITY = 1024
_FIRST_BYTES = 64 << 20
#: A round that does not come.
_NEVER = np.iinfo(np.int64).max

_Rows = npt.NDArray[np.int64]


def sample(
    logits: npt.NDArray[np.float64],
    temperature: npt.NDArray[np.float64],
    uniforms: npt.NDArray[np.float64],
) -> npt.NDArray[np.int64]:
    """Return one action for each row, by inverse CDF.

    Args:
        logits: of P(a | s, c), float64 [n, n_actions].
        temperature: logits are divided by it, float64 [n, 1], more than 0.
        uniforms: float64 [n] in [0, 1).
    """
    below = logits - np.maximum.reduce(logits, axis=1, keepdims=True)
    weights = np.exp(below / temperature)
    cumulative = np.add.accumulate(weights, axis=1)
    threshold = uniforms * cumulative[:, -1]
    actions: npt.NDArray[np.int64] = np.add.reduce(cumulative <= threshold[:, None], axis=1)
    np.minimum(actions, logits.shape[1] - 1, out=actions)
    return actions


class Failure(NamedTuple):
    """An episode that could not be finished, through the environment's fault."""

    command: Command
    error: EnvironmentFault


class EpisodeGenerator:
    """Runs Algorithm 2 in ``n_environments`` environments at once.

    Args:
        config: the run's settings.
        n_environments: episodes that can run at the same time.
        make: makes one environment.

    Raises:
        UnsupportedEnvironment: the environment cannot be made or is not supported.
    """

    def __init__(
        self,
        config: Config,
        n_environments: int,
        make: Callable[[Config], Environment] = make_environment,
    ) -> None:
        self._config = config
        self._frame_stack = config.frame_stack
        self._make = make
        self._envs = [make(config) for _ in range(n_environments)]
        self.spec: EnvironmentSpec = specify(self._envs[0], config)
        self._stacked_shape = stacked_shape(self.spec, config)
        self._limits = [self.spec.max_episode_steps] * n_environments
        self._commands: list[Command | None] = [None] * n_environments
        self._behaviors: list[Acting | None] = [None] * n_environments
        self._calls: list[tuple[Call, _Rows]] | None = None
        self._greedy: list[int] = []
        # The rounds from and before which a row's action is held, and how many rows have such.
        self._hold_from = np.full(n_environments, _NEVER)
        self._hold_until = np.full(n_environments, _NEVER)
        self._n_holding = 0

        # s_t, c_t = (dr_t, dh_t), r_t, and the logits of P(a | s_t, c_t).
        dtype = np.dtype(self.spec.observation_dtype)
        self._observation = np.zeros((n_environments, *self.spec.observation_shape), dtype)
        self._desired = np.zeros((n_environments, 2))
        self._reward = np.zeros(n_environments, np.float32)
        self._logits = np.zeros((n_environments, self.spec.n_actions))
        self._temperature = np.ones((n_environments, 1))
        self._cap = np.full(n_environments, np.inf)

        # A ring of rounds: round k of all environments is kept at k % capacity, until the longest
        # running episode needs more.
        self._round = 0
        self._began = np.zeros(n_environments, np.int64)
        round_bytes = n_environments * self.spec.step_bytes
        self._capacity = min(
            self.spec.max_episode_steps, _FIRST_CAPACITY, max(64, _FIRST_BYTES // round_bytes)
        )
        shape = (self._capacity, n_environments)
        self._observations = np.zeros((*shape, *self.spec.observation_shape), dtype)
        self._actions = np.zeros(shape, action_dtype(self.spec.n_actions))
        self._rewards = np.zeros(shape, np.float32)
        self._uniforms = np.zeros(shape)

    @property
    def free(self) -> int:
        """Episodes that could be started now."""
        return self._commands.count(None)

    @property
    def running(self) -> list[Command]:
        """The commands being carried out."""
        return [c for c in self._commands if c is not None]

    def start(self, command: Command, behavior: Acting | None) -> Failure | None:
        """Begin an episode; there must be a free environment.

        Args:
            command: c_0, and all else that the episode depends on.
            behavior: the version that the command names; None in the warm-up: act at random.

        Returns:
            A failure when the environment could not be reset, else None.
        """
        row = self._commands.index(None)
        try:
            if self._limits[row] != command.max_steps:
                limit_steps(self._envs[row], command.max_steps)
                self._limits[row] = command.max_steps
            observation, _ = self._envs[row].reset(seed=command.environment_seed)
            self._observation[row] = observation
        except Exception as error:  # noqa: BLE001 - whatever foreign code raises is its fault
            self._rebuild(row)
            return Failure(command, _fault("reset", command, error))
        self._commands[row] = command
        self._behaviors[row] = behavior
        self._calls = None
        if command.temperature == 0:
            self._greedy.append(row)
        self._temperature[row] = command.temperature or 1.0
        self._desired[row] = command.desired_return, command.desired_horizon
        self._cap[row] = np.inf
        if command.kind == "evaluate" and self.spec.max_return is not None:
            self._cap[row] = self.spec.max_return
        self._logits[row] = 0.0
        self._began[row] = self._round
        if command.hold_steps:
            self._hold_from[row] = self._round + command.hold_from
            self._hold_until[row] = self._hold_from[row] + command.hold_steps
            self._n_holding += 1
        self._lay_out_uniforms(row, command)
        return None

    def step(self) -> list[Episode | Failure]:
        """Advance every running episode by one step and return those that ended, in any order."""
        self._make_room()
        over: list[tuple[int, bool, bool]] = []
        failed: list[tuple[int, EnvironmentFault]] = []
        observation, reward, envs = self._observation, self._reward, self._envs
        at = self._round % self._capacity
        self._observations[at] = observation
        self._actions[at] = actions = self._choose_actions(self._uniforms[at])
        chosen = actions.tolist()
        for row, command in enumerate(self._commands):
            if command is None:
                continue
            try:
                observation[row], reward[row], terminated, truncated, _ = envs[row].step(
                    chosen[row]
                )
            except Exception as error:  # noqa: BLE001 - whatever foreign code raises is its fault
                failed.append((row, _fault("step", command, error)))
                continue
            if terminated or truncated:
                over.append((row, bool(terminated), bool(truncated)))
        self._rewards[at] = reward
        # Lines 8, 9 and 11 of Algorithm 2; nobody reads the rows of idle environments.
        self._desired[:, 0] -= reward
        self._desired[:, 1] -= 1.0
        self._round += 1

        outcomes: list[Episode | Failure] = [self._finish(*ended) for ended in over]
        for row, fault in failed:
            outcomes.append(Failure(self._command_of(row), fault))
            self._release(row)
            self._rebuild(row)
        return outcomes

    def close(self) -> None:
        """Close all environments."""
        for env in self._envs:
            env.close()

    def _choose_actions(self, uniforms: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
        """Sample a_t ~ P(a | s_t, c_t) for every row, by inverse CDF in float64."""
        desired, logits = self._desired, self._logits
        if self.spec.max_return is not None:
            np.minimum(desired[:, 0], self._cap, out=desired[:, 0])
        if self._calls is None:
            self._calls = self._plan_calls()
        observation = self._observation if self._frame_stack == 1 else self._stacks()
        for call, rows in self._calls:
            observation.take(rows, axis=0, out=call.observation, mode="clip")
            desired.take(rows, axis=0, out=call.command, mode="clip")
            call.run()
            logits[rows] = call.logits
        actions = sample(logits, self._temperature, uniforms)
        if self._greedy:
            actions[self._greedy] = logits[self._greedy].argmax(axis=1)
        if self._n_holding:
            held = (self._hold_from <= self._round) & (self._round < self._hold_until)
            actions[held] = (uniforms[held] * logits.shape[1]).astype(np.int64)
        return actions

    def _stacks(self) -> npt.NDArray[np.generic]:
        """Return what the network sees now in every environment."""
        t = recent(self._round - self._began, self._frame_stack)
        rounds = (self._began[:, None] + t) % self._capacity
        frames = self._observations[rounds, np.arange(len(rounds))[:, None]]
        stacks: npt.NDArray[np.generic] = frames.reshape(len(frames), *self._stacked_shape)
        return stacks

    def _plan_calls(self) -> list[tuple[Call, _Rows]]:
        """Gather the rows of each weights version into a call."""
        rows_of: dict[Acting, list[int]] = {}
        for row, behavior in enumerate(self._behaviors):
            if behavior is not None:
                rows_of.setdefault(behavior, []).append(row)
        return [(b.call(len(rows)), np.array(rows)) for b, rows in rows_of.items()]

    def _finish(self, row: int, terminated: bool, truncated: bool) -> Episode | Failure:
        command = self._command_of(row)
        began = int(self._began[row])
        places = self._places(began, self._round - began)
        episode = Episode(
            command_id=command.id,
            observations=self._observations[places, row],
            actions=self._actions[places, row],
            rewards=self._rewards[places, row],
            terminated=terminated,
            truncated=truncated,
        )
        self._release(row)
        if not (np.isfinite(episode.observations).all() and np.isfinite(episode.rewards).all()):
            self._rebuild(row)
            fault = ValueError("an observation or reward is NaN, infinite, or beyond float32")
            return Failure(command, _fault("step", command, fault))
        return episode

    def _release(self, row: int) -> None:
        self._commands[row] = self._behaviors[row] = self._calls = None
        if row in self._greedy:
            self._greedy.remove(row)
        if self._hold_from[row] != _NEVER:
            self._hold_from[row] = _NEVER
            self._n_holding -= 1
        self._reward[row] = self._desired[row] = 0.0

    def _rebuild(self, row: int) -> None:
        """Replace an environment that can no longer be trusted."""
        with contextlib.suppress(Exception):  # it is broken already, and goes
            self._envs[row].close()
        self._envs[row] = self._make(self._config)
        self._limits[row] = self.spec.max_episode_steps

    def _places(self, first: int, count: int) -> _Rows:
        """Return where ``count`` rounds from ``first`` on lie in the ring."""
        return np.arange(first, first + count) % self._capacity

    def _lay_out_uniforms(self, row: int, command: Command) -> None:
        """Put number t of the command's stream where step t of its episode will look.

        Numbers of the warm-up are used ``warm_up_hold`` times, and so are the actions they choose;
        number ``hold_from`` of a command is used for ``hold_steps`` steps.
        """
        numbers = Stream(command.stream_key).uniforms(self._capacity)
        if command.kind == "warm_up":
            hold = self._config.warm_up_hold
            numbers = numbers[np.arange(self._capacity) // hold * hold]
        if command.hold_steps:
            first, last = command.hold_from, command.hold_from + command.hold_steps
            numbers[first:last] = Stream(command.stream_key).number(first)
        self._uniforms[self._places(int(self._began[row]), self._capacity), row] = numbers

    def _make_room(self) -> None:
        """Make the ring twice as long if an episode would overwrite its own beginning."""
        if self._capacity >= self.spec.max_episode_steps:
            return
        running = [(row, c) for row, c in enumerate(self._commands) if c is not None]
        first = self._round - self._capacity
        if not any(self._began[row] == first for row, _ in running):
            return
        count = self._capacity
        old = self._places(first, count)
        self._capacity *= 2
        new = self._places(first, count)
        for name in ("_observations", "_actions", "_rewards", "_uniforms"):
            ring = getattr(self, name)
            longer = np.zeros((self._capacity, *ring.shape[1:]), ring.dtype)
            longer[new] = ring[old]
            setattr(self, name, longer)
        for row, command in running:
            self._lay_out_uniforms(row, command)

    def _command_of(self, row: int) -> Command:
        command = self._commands[row]
        assert command is not None
        return command


def _fault(where: str, command: Command, error: Exception) -> EnvironmentFault:
    fault = EnvironmentFault(
        f"the environment failed in {where}() under command {command.id} "
        f"(seed {command.environment_seed}): {type(error).__name__}: {error}"
    )
    fault.__cause__ = error
    return fault


def generate_episodes(
    generator: EpisodeGenerator, commands: Iterable[Command], behavior: Acting | None
) -> list[Episode]:
    """Carry out commands with one behavior function and return the episodes, by command id.

    A command that fails is tried again, which changes nothing else.

    Raises:
        EnvironmentFault: the environment failed three times under the same command.
    """
    return sorted(iterate_episodes(generator, commands, behavior), key=lambda e: e.command_id)


def iterate_episodes(
    generator: EpisodeGenerator, commands: Iterable[Command], behavior: Acting | None
) -> Iterator[Episode]:
    """As :func:`generate_episodes`, but yield each episode when it ends, in any order.

    For many episodes of which only a few numbers are kept: images take much memory.

    Raises:
        EnvironmentFault: the environment failed three times under the same command.
    """
    waiting = list(commands)[::-1]
    failures: Counter[int] = Counter()
    while waiting or generator.running:
        outcomes: list[Episode | Failure | None] = []
        while waiting and generator.free:
            outcomes.append(generator.start(waiting.pop(), behavior))
        outcomes.extend(generator.step())
        for outcome in outcomes:
            if isinstance(outcome, Episode):
                yield outcome
            elif outcome is not None:
                failures[outcome.command.id] += 1
                if failures[outcome.command.id] == MAX_FAILURES:
                    raise outcome.error
                waiting.append(outcome.command)
