"""Algorithm 2, for many episodes at once (section 2.3.5).

::

    generator = EpisodeGenerator(config, n_environments=16)
    while commands or generator.running:
        while commands and generator.free:
            generator.start(commands.pop(), behavior)
        for outcome in generator.step():
            ...  # an Episode, or a Failure

The behavior function is evaluated for all environments in one call, padded to a fixed number of
rows. Which rows stand beside it does not change a row's result (:mod:`udrl.numerics` checks), so an
episode depends on its command alone.
"""

import contextlib
from collections import Counter
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from udrl.behavior import BehaviorFunction
from udrl.commands import Command
from udrl.config import Config
from udrl.environments.making import (
    Environment,
    EnvironmentSpec,
    limit_steps,
    make_environment,
    specify,
)
from udrl.episode import Episode, action_dtype
from udrl.errors import EnvironmentFault
from udrl.streams import Stream

#: Failures under the same command after which it is hopeless.
MAX_FAILURES = 3

_FIRST_CAPACITY = 1024


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
        self._make = make
        self._envs = [make(config) for _ in range(n_environments)]
        self.spec: EnvironmentSpec = specify(self._envs[0], config)
        self._limits = [self.spec.max_episode_steps] * n_environments
        self._commands: list[Command | None] = [None] * n_environments
        self._streams: list[Stream | None] = [None] * n_environments
        self._rows = np.arange(n_environments)
        self._running = np.zeros(n_environments, np.int64)
        self._greedy = np.zeros(n_environments, bool)
        self._actor_of: dict[BehaviorFunction, npt.NDArray[np.bool_]] = {}

        # What the network reads, padded to whole calls. See training._Batch for why torch owns it.
        rows = config.inference_rows
        padded = -(-n_environments // rows) * rows
        self._calls = [slice(i, i + rows) for i in range(0, padded, rows)]
        self._observation_t = torch.zeros(padded, self.spec.observation_size)
        self._command_t = torch.zeros(padded, 2)
        self._observation = self._observation_t.numpy()
        self._command = self._command_t.numpy()[:n_environments]
        self._scales = np.array([config.return_scale, config.horizon_scale])
        self._logits = np.zeros((padded, self.spec.n_actions))

        # dr_t, dh_t, the cap on dr_t, and t of Algorithm 2.
        self._desired = np.zeros((n_environments, 2))
        self._cap = np.full(n_environments, np.inf)
        self._reward = np.zeros(n_environments, np.float32)
        self._t = np.zeros(n_environments, np.int64)

        self._capacity = min(self.spec.max_episode_steps, _FIRST_CAPACITY)
        shape = (n_environments, self._capacity)
        self._observations = np.zeros((*shape, self.spec.observation_size), np.float32)
        self._actions = np.zeros(shape, action_dtype(self.spec.n_actions))
        self._rewards = np.zeros(shape, np.float32)
        self._uniforms = np.zeros(shape)

    @property
    def free(self) -> int:
        """Episodes that could be started now."""
        return len(self._envs) - int(self._running.sum())

    @property
    def running(self) -> list[Command]:
        """The commands being carried out."""
        return [c for c in self._commands if c is not None]

    def start(self, command: Command, behavior: BehaviorFunction | None) -> Failure | None:
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
        self._running[row] = 1
        self._greedy[row] = command.greedy
        self._t[row] = 0
        self._desired[row] = command.desired_return, command.desired_horizon
        self._cap[row] = np.inf
        if command.kind == "evaluate" and self.spec.max_return is not None:
            self._cap[row] = self.spec.max_return
        self._streams[row] = stream = Stream(command.stream_key)
        self._uniforms[row] = stream.uniforms(self._capacity)
        self._logits[row] = 0.0
        if behavior is not None:
            mask = self._actor_of.setdefault(behavior, np.zeros(len(self._logits), bool))
            mask[row] = True
        return None

    def step(self) -> list[Episode | Failure]:
        """Advance every running episode by one step and return those that ended, in any order."""
        over: list[tuple[int, bool, bool]] = []
        failed: list[tuple[int, EnvironmentFault]] = []
        if int(self._t.max()) >= self._capacity:
            self._grow()
        self._actions[self._rows, self._t] = actions = self._choose_actions()
        self._observations[self._rows, self._t] = self._observation[: len(self._envs)]
        observation, reward, envs = self._observation, self._reward, self._envs
        chosen = actions.tolist()
        for row in np.flatnonzero(self._running).tolist():
            try:
                observation[row], reward[row], terminated, truncated, _ = envs[row].step(
                    chosen[row]
                )
            except Exception as error:  # noqa: BLE001 - whatever foreign code raises is its fault
                failed.append((row, _fault("step", self._command_of(row), error)))
                continue
            if terminated or truncated:
                over.append((row, bool(terminated), bool(truncated)))
        self._rewards[self._rows, self._t] = reward
        # Lines 8, 9 and 11 of Algorithm 2; idle rows stay as they are.
        self._desired[:, 0] -= reward
        self._desired[:, 1] -= self._running
        self._t += self._running

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

    def _choose_actions(self) -> npt.NDArray[np.int64]:
        """Sample a_t ~ P(a | s_t, c_t) for every row, by inverse CDF in float64."""
        if self.spec.max_return is not None:
            np.minimum(self._desired[:, 0], self._cap, out=self._desired[:, 0])
        self._command[:, 0] = self._desired[:, 0] * self._scales[0]
        self._command[:, 1] = np.maximum(self._desired[:, 1], 1.0) * self._scales[1]
        with torch.inference_mode():
            for behavior, mask in self._actor_of.items():
                for call in self._calls:
                    if len(self._calls) > 1 and not mask[call].any():
                        continue
                    logits = behavior(self._observation_t[call], self._command_t[call])
                    np.copyto(self._logits[call], logits.numpy(), where=mask[call, None])
        n = len(self._envs)
        logits = self._logits[:n]
        weights = np.exp(logits - np.maximum.reduce(logits, axis=1, keepdims=True))
        cumulative = np.add.accumulate(weights, axis=1)
        threshold = self._uniforms[self._rows, self._t] * cumulative[:, -1]
        actions: npt.NDArray[np.int64] = np.add.reduce(cumulative <= threshold[:, None], axis=1)
        np.minimum(actions, self.spec.n_actions - 1, out=actions)
        if self._greedy.any():
            actions = np.where(self._greedy, logits.argmax(axis=1), actions)
        return actions

    def _finish(self, row: int, terminated: bool, truncated: bool) -> Episode | Failure:
        length = int(self._t[row])
        command = self._command_of(row)
        episode = Episode(
            command_id=command.id,
            observations=self._observations[row, :length].copy(),
            actions=self._actions[row, :length].copy(),
            rewards=self._rewards[row, :length].copy(),
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
        self._commands[row] = self._streams[row] = None
        self._running[row] = self._t[row] = 0
        self._reward[row] = self._desired[row] = self._observation[row] = 0.0
        self._greedy[row] = False
        for mask in self._actor_of.values():
            mask[row] = False
        self._actor_of = {b: mask for b, mask in self._actor_of.items() if mask.any()}

    def _rebuild(self, row: int) -> None:
        """Replace an environment that can no longer be trusted."""
        with contextlib.suppress(Exception):  # it is broken already, and goes
            self._envs[row].close()
        self._envs[row] = self._make(self._config)
        self._limits[row] = self.spec.max_episode_steps

    def _grow(self) -> None:
        """Make room for longer episodes: twice as many steps."""
        for name in ("_observations", "_actions", "_rewards", "_uniforms"):
            old = getattr(self, name)
            setattr(self, name, np.concatenate([old, np.zeros_like(old)], axis=1))
        for row, stream in enumerate(self._streams):
            if stream is not None:
                self._uniforms[row, self._capacity :] = stream.uniforms(self._capacity)
        self._capacity *= 2

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
    generator: EpisodeGenerator, commands: Iterable[Command], behavior: BehaviorFunction | None
) -> list[Episode]:
    """Carry out commands with one behavior function and return the episodes, by command id.

    A command that fails is tried again, which changes nothing else.

    Raises:
        EnvironmentFault: the environment failed three times under the same command.
    """
    waiting = list(commands)[::-1]
    episodes: list[Episode] = []
    failures: Counter[int] = Counter()
    while waiting or generator.running:
        outcomes: list[Episode | Failure | None] = []
        while waiting and generator.free:
            outcomes.append(generator.start(waiting.pop(), behavior))
        outcomes.extend(generator.step())
        for outcome in outcomes:
            if isinstance(outcome, Episode):
                episodes.append(outcome)
            elif outcome is not None:
                failures[outcome.command.id] += 1
                if failures[outcome.command.id] == MAX_FAILURES:
                    raise outcome.error
                waiting.append(outcome.command)
    return sorted(episodes, key=lambda e: e.command_id)
