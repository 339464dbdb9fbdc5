"""Algorithm 2, for many episodes at once (section 2.3.5).

::

    generator = EpisodeGenerator(config, n_environments=16)
    while commands or generator.running:
        while commands and generator.free:
            generator.start(commands.pop(), behavior)
        for outcome in generator.step():
            ...  # an Episode, or a Failure

The behavior function is evaluated for all environments in one call. A row's result does not depend
on the other rows (:class:`udrl.inference.ActingFunction`), so an episode depends only on its
command.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from udrl.actions import Actions, random_actions
from udrl.architecture import state_sizes
from udrl.commands import Command
from udrl.config import Config
from udrl.environments.adapter import Environment, raised
from udrl.environments.making import make_environment
from udrl.episode import Episode, fault
from udrl.errors import EnvironmentFault
from udrl.frame_stack import FrameStack
from udrl.inference import Acting, Call
from udrl.recording import Recording
from udrl.rows import Rows
from udrl.spaces import parts_of
from udrl.targets import ReturnInTime

#: Number of failures of a command after which it is not retried.
MAX_FAILURES = 3


class Failure(NamedTuple):
    """An episode that could not be completed, because the environment failed."""

    command: Command
    error: EnvironmentFault


class EpisodeGenerator:
    """Runs Algorithm 2 in ``n_environments`` environments at once.

    Args:
        config: the run's settings.
        n_environments: number of environments, which run at the same time.
        make: factory of environments.
        first_index: index of the first environment (:data:`udrl.environments.making.INDEX`).

    Attributes:
        spec: specification of the environment.

    Raises:
        UnsupportedEnvironment: the environment cannot be created or is not supported.
    """

    def __init__(
        self,
        config: Config,
        n_environments: int,
        make: Callable[[Config], Environment] = make_environment,
        first_index: int = 0,
    ) -> None:
        self._rows = Rows(config, n_environments, make, first_index)
        self.spec = self._rows.spec
        self._stack = FrameStack(self.spec.observation_space, config.network.frame_stack)
        # Without frame stacks, the networks' input is a view of the observations.
        single = self._stack.length == 1
        self._seen = self._stack.join(self._rows.observation) if single else None
        self._target = ReturnInTime(config.network)
        self._recording = Recording(self.spec, n_environments)
        self._commands: list[Command | None] = [None] * n_environments
        self._behaviors: list[Acting | None] = [None] * n_environments
        # Rows with an episode, those with greedy actions, and the calls that compute their logits.
        # They are planned again when an episode begins or ends.
        self._active: list[int] = []
        self._greedy: list[int] = []
        self._calls: list[tuple[Call, npt.NDArray[np.int64]]] = []
        self._planned = True

        # For each row: c_t = (dr_t, dh_t) and its cap, the memory's state, the parameters of
        # P(a | s_t, c_t), and the temperature.
        self._desired = np.zeros((n_environments, self._target.size))
        self._cap = np.full(n_environments, np.inf)
        self._n_capped = 0
        self._state = np.zeros((n_environments, sum(state_sizes(config.network))), np.float32)
        self._parameters = np.zeros((n_environments, self.spec.action_space.n_parameters))
        self._temperature = np.ones((n_environments, 1))
        # Number of rows whose commands may have random actions.
        self._n_random = 0

    @property
    def free(self) -> int:
        """Number of environments without an episode."""
        return self._commands.count(None)

    @property
    def running(self) -> list[Command]:
        """Commands of the running episodes."""
        return [c for c in self._commands if c is not None]

    def start(self, command: Command, behavior: Acting | None) -> Failure | None:
        """Begin an episode; there must be a free environment.

        Args:
            command: the command.
            behavior: the command's weights version; None in the warm-up.

        Returns:
            A failure if the environment could not be reset, otherwise None.

        Raises:
            UnsupportedEnvironment: a failed environment could not be created again.
        """
        row = self._commands.index(None)
        error = self._rows.reset(row, command.environment_seed, command.max_steps)
        if error is not None:
            self._rows.replace(row)
            return _failure("reset", command, error)
        self._commands[row] = command
        self._behaviors[row] = behavior
        self._planned = False
        self._recording.begin(row, command)
        self._desired[row] = command.desired_return, command.desired_horizon
        if command.cap is not None:
            self._cap[row] = command.cap
            self._n_capped += 1
            self._target.bound(self._desired, self._cap)
        self._parameters[row] = 0.0
        self._state[row] = 0.0
        self._temperature[row] = command.temperature or 1.0
        self._n_random += command.is_ever_random
        return None

    def step(self) -> list[Episode | Failure]:
        """Advance all running episodes by one step and return those that ended, in any order.

        Raises:
            UnsupportedEnvironment: a failed environment could not be created again.
        """
        rows, recording = self._rows, self._recording
        if not self._planned:
            self._plan()
        decisions = recording.begin_round(rows.observation)
        self._evaluate()
        actions = self._choose(*decisions)
        ended, failed = rows.step(self._active, actions)
        recording.end_round(actions, rows.reward)
        # Lines 8, 9 and 11 of Algorithm 2; the values in idle rows are not used.
        self._target.advance(self._desired, rows.reward)
        if self._n_capped:
            self._target.bound(self._desired, self._cap)
        outcomes: list[Episode | Failure] = [self._finish(*episode) for episode in ended]
        return outcomes + [self._fail(row, error) for row, error in failed]

    def close(self) -> None:
        """Close all environments."""
        self._rows.close()

    def _plan(self) -> None:
        """Assign the rows of each weights version to one call."""
        self._active = [row for row, c in enumerate(self._commands) if c is not None]
        self._greedy = [row for row in self._active if self._command_of(row).temperature == 0]
        rows_of: dict[Acting, list[int]] = {}
        for row in self._active:
            behavior = self._behaviors[row]
            if behavior is not None:
                rows_of.setdefault(behavior, []).append(row)
        self._calls = [(b.call(len(rows)), np.array(rows)) for b, rows in rows_of.items()]
        self._planned = True

    def _evaluate(self) -> None:
        """Compute the parameters of P(a | s_t, c_t) in all rows with a behavior function."""
        if not self._calls:
            return
        seen = self._seen
        if seen is None:
            seen = self._recording.stacks(self._stack)
        for call, rows in self._calls:
            for all_rows, given in zip(seen, call.seen, strict=True):
                all_rows.take(rows, axis=0, out=given, mode="clip")
            self._desired.take(rows, axis=0, out=call.command, mode="clip")
            if self._state.shape[1]:
                self._state.take(rows, axis=0, out=call.state, mode="clip")
            call.run()
            self._parameters[rows] = call.logits
            if self._state.shape[1]:
                self._state[rows] = call.next_state

    def _choose(self, numbers: npt.NDArray[np.float64], random: npt.NDArray[np.bool_]) -> Actions:
        """Choose a_t in every row according to its command: sampled, greedy, or random."""
        space = self.spec.action_space
        actions = space.sample(self._parameters, self._temperature, numbers)
        if self._greedy:
            actions[self._greedy] = space.mode(self._parameters[self._greedy])
        if self._n_random:
            k = self.spec.action_mask
            mask = None if k is None else parts_of(self._rows.observation)[k][random]
            actions[random] = random_actions(space, mask, numbers[random])
        return actions

    def _finish(self, row: int, terminated: bool, truncated: bool) -> Episode | Failure:
        """Return the episode that ended in a row, or a failure if it is invalid; free the row."""
        episode = self._recording.end(row, terminated=terminated, truncated=truncated)
        command = self._release(row)
        if found := fault(episode, self.spec):
            self._rows.replace(row)
            return _failure("step", command, EnvironmentFault(found))
        return episode

    def _fail(self, row: int, error: Exception) -> Failure:
        """Discard the episode of a row whose environment raised an exception; free the row."""
        self._recording.drop(row)
        command = self._release(row)
        self._rows.replace(row)
        return _failure("step", command, error)

    def _release(self, row: int) -> Command:
        """Mark a row as free, and return its command."""
        command = self._command_of(row)
        self._commands[row] = self._behaviors[row] = None
        self._planned = False
        self._n_random -= command.is_ever_random
        if command.cap is not None:
            self._cap[row] = np.inf
            self._n_capped -= 1
        return command

    def _command_of(self, row: int) -> Command:
        command = self._commands[row]
        assert command is not None
        return command


def _failure(where: str, command: Command, error: Exception) -> Failure:
    wrapped = EnvironmentFault(
        f"the environment failed under command {command.id} (seed {command.environment_seed}): "
        f"{raised(where, error)}"
    )
    wrapped.__cause__ = error
    return Failure(command, wrapped)


def generate_episodes(
    generator: EpisodeGenerator, commands: Iterable[Command], behavior: Acting | None
) -> list[Episode]:
    """Run commands with one behavior function and return the episodes, ordered by command id.

    Failed commands are retried, which does not affect other episodes.

    Raises:
        EnvironmentFault: the environment failed three times under the same command.
    """
    return sorted(iterate_episodes(generator, commands, behavior), key=lambda e: e.command_id)


def iterate_episodes(
    generator: EpisodeGenerator, commands: Iterable[Command], behavior: Acting | None
) -> Iterator[Episode]:
    """Like :func:`generate_episodes`, but yield each episode when it ends, in any order.

    This saves memory if the caller does not keep the episodes.

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
