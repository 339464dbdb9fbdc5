"""Commands: desired return and horizon of an episode, and everything else that it depends on.

An episode is a pure function of its command. This module draws the exploratory commands (2.3.4),
the evaluation commands (2.3.6), and those of the warm-up, which prescribe random actions.
"""

import hashlib
import math
from functools import cached_property
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from udrl.config import COMMANDS_PER_ITERATION, Config, change
from udrl.environments.specification import EnvironmentSpec
from udrl.replay_buffer import ReplayBuffer
from udrl.schedule import weights_version
from udrl.setting_groups import CommandSettings, Temperature
from udrl.strategies import Best, CommandStrategy, choose_command, make_strategy
from udrl.streams import Purpose, Stream, stream_key
from udrl.targets import ReturnInTime

CommandKind = Literal["warm_up", "explore", "evaluate"]

#: Reset seeds (section 3.2), half-open ranges.
TRAINING_SEEDS = (1_000_000, 10_000_000)
SEARCH_SEEDS = (500_000, 1_000_000)
EVALUATION_SEEDS = (1, 500_000)

#: Maximum number of exploratory episodes per iteration that ``n_steps_per_iter`` can lead to.
MAX_EPISODES = 1_000
#: Index of the first command of a run's final evaluation, within the run's last iteration.
FINAL_EVALUATION = 500_000


class Decisions(NamedTuple):
    """Random numbers that choose the actions of an episode's first steps.

    Attributes:
        numbers: uniform in [0, 1), float64 [n, *action_shape].
        random: whether the action is uniformly random instead of sampled from the behavior
            function's distribution, bool [n].
    """

    numbers: npt.NDArray[np.float64]
    random: npt.NDArray[np.bool_]


class Command(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A command to an actor.

    Attributes:
        id: ``iteration * COMMANDS_PER_ITERATION + index``; also the id of the episode.
        kind: purpose of the episode.
        desired_return: initial desired return; 0 and unused in the warm-up.
        desired_horizon: initial desired horizon in steps; 0 and unused in the warm-up.
        cap: upper bound of the desired return at every step; None: no bound.
        environment_seed: reset seed of the environment.
        stream_key: key of the random stream whose number t chooses action t, 16 bytes.
        weights_version: version of the behavior function; 0 in the warm-up: random actions.
        max_steps: step limit of the episode in steps.
        temperature: divisor of the logits before sampling; 0 = the most likely action.
        random_from: first step of a period of uniformly random actions.
        random_steps: length of this period in steps.
        random_hold: steps for which each of these actions is held.
        random_rate: if not 0, there is no such period. Instead, at each step without a held action,
            a random action begins with this probability. It is held for ``random_hold`` times k
            steps, where k is at least n with probability 1 / n.
    """

    id: Annotated[int, Meta(ge=0, le=2**62)]
    kind: CommandKind
    desired_return: float
    desired_horizon: Annotated[int, Meta(ge=0, le=2**31)]
    cap: float | None = None
    environment_seed: Annotated[int, Meta(ge=0, le=2**31)]
    stream_key: Annotated[bytes, Meta(min_length=16, max_length=16)]
    weights_version: Annotated[int, Meta(ge=0, le=2**62)]
    max_steps: Annotated[int, Meta(ge=1, le=2**31)]
    temperature: Temperature = 1.0
    random_from: Annotated[int, Meta(ge=0, le=2**31)] = 0
    random_steps: Annotated[int, Meta(ge=0, le=2**31)] = 0
    random_hold: Annotated[int, Meta(ge=1, le=2**31)] = 1
    random_rate: Annotated[float, Meta(ge=0, le=1)] = 0.0

    @property
    def iteration(self) -> int:
        """The command's iteration."""
        return self.id // COMMANDS_PER_ITERATION

    @property
    def index(self) -> int:
        """The command's number within its iteration."""
        return self.id % COMMANDS_PER_ITERATION

    @property
    def is_ever_random(self) -> bool:
        """Whether the episode may have random actions."""
        return self.random_steps > 0 or self.random_rate > 0

    def decisions(self, n: int, shape: tuple[int, ...]) -> Decisions:
        """Return the random numbers of the first ``n`` actions, which have the given shape."""
        numbers = Stream(self.stream_key).uniforms(n * math.prod(shape)).reshape(n, *shape)
        steps = np.arange(n)
        if self.random_rate:
            begun = self._begun(n)
        else:
            since = steps - self.random_from
            random = (since >= 0) & (since < self.random_steps)
            begun = np.where(random, steps - since % self.random_hold, -1)
        random = begun >= 0
        return Decisions(numbers[np.where(random, begun, steps)], random)

    def _begun(self, n: int) -> npt.NDArray[np.int64]:
        """Return the first step of each step's held action, int64 [n]; -1: none is held."""
        begun = np.full(n, -1)
        key = hashlib.sha256(self.stream_key).digest()[:16]
        numbers = Stream(key).uniforms(n)
        free = 0
        for step in np.flatnonzero(numbers < self.random_rate).tolist():
            if step >= free:
                multiple = math.floor(1 / (1 - numbers[step] / self.random_rate))
                free = step + self.random_hold * multiple
                begun[step:free] = step
        return begun


def episodes_due(settings: CommandSettings, buffer: ReplayBuffer) -> int:
    """Return the number of an iteration's exploratory episodes, given the buffer to draw from."""
    least, steps = settings.n_episodes_per_iter, settings.n_steps_per_iter
    if steps is None or not (newest := buffer.newest()):
        return least
    wanted = math.ceil(steps * len(newest) / sum(e.length for e in newest))
    return max(least, min(wanted, MAX_EPISODES))


def strategy_of(config: Config, spec: EnvironmentSpec) -> CommandStrategy:
    """Return a run's strategy; it sees the highest return that the environment declares.

    Raises:
        ConfigError: as :func:`~udrl.strategies.make_strategy`.
    """
    return make_strategy(change(config, max_return=spec.max_return))


class CommandSampler:
    """Draws the commands of a run, iteration by iteration.

    Args:
        config: the run's settings.
        spec: the environment's step limit and highest return.
    """

    def __init__(self, config: Config, spec: EnvironmentSpec) -> None:
        self._config = config
        self._settings = config.commands
        self._spec = spec
        self._target = ReturnInTime(config.network)
        longest = spec.max_episode_steps
        self._max_train_steps = min(longest, config.max_train_steps or longest)

    @cached_property
    def _strategy(self) -> CommandStrategy:
        # On first use: evaluations do not need to import it.
        return strategy_of(self._config, self._spec)

    def warm_up(self) -> list[Command]:
        """Return the commands of iteration 0: random actions (section 2.3.1)."""
        n, hold = self._settings.n_warm_up_episodes, self._settings.warm_up_hold_steps
        commands = self._commands("warm_up", 0, 0, [(0.0, 0)] * n, TRAINING_SEEDS)
        return [
            msgspec.structs.replace(c, random_steps=c.max_steps, random_hold=hold) for c in commands
        ]

    def explore(self, iteration: int, buffer: ReplayBuffer) -> list[Command]:
        """Return an iteration's exploratory commands (section 2.3.4).

        A strategy (:mod:`udrl.strategies`) chooses desired return and horizon: in the paper, a
        return uniform in [M, M + S], and the mean length of the ``last_few`` best episodes. Not in
        the paper: a share of the episodes, ``hold_share``, have held random actions: one, which
        begins within the desired horizon and lasts for ``hold_steps`` steps, or with a
        ``hold_rate``, any number.

        Raises:
            ConfigError: the strategy cannot be imported, or returned an invalid command.
        """
        best = buffer.best(self._settings.last_few)
        n = episodes_due(self._settings, buffer)
        u, w, x = self._stream(iteration).uniforms(3 * n).reshape(3, n).tolist()
        desired = [
            self._target.initial(*choose_command(self._strategy, best, number)) for number in u
        ]
        commands = self._commands("explore", iteration, 0, desired, TRAINING_SEEDS)
        return [
            self._with_random_actions(c, x[k]) if w[k] < self._settings.hold_share else c
            for k, c in enumerate(commands)
        ]

    def _with_random_actions(self, command: Command, x: float) -> Command:
        """Add held random actions to a command; ``x`` in [0, 1) chooses the first step."""
        rate, hold = self._settings.hold_rate, self._settings.hold_steps
        if rate:
            return msgspec.structs.replace(command, random_rate=rate, random_hold=hold)
        return msgspec.structs.replace(
            command,
            random_from=math.floor(x * min(command.max_steps, command.desired_horizon)),
            random_steps=hold,
            random_hold=hold,
        )

    def training_command(self, episode_id: int) -> Command:
        """Return the command of an earlier training episode, without what depended on the buffer.

        Desired return and horizon are 0, and there are no random actions.
        """
        iteration, index = divmod(episode_id, COMMANDS_PER_ITERATION)
        kind: CommandKind = "explore" if iteration else "warm_up"
        return self._commands(kind, iteration, 0, [(0.0, 0)] * (index + 1), TRAINING_SEEDS)[index]

    def evaluate(self, iteration: int, buffer: ReplayBuffer) -> list[Command]:
        """Return an iteration's evaluation commands (section 2.3.6): return M, the same horizon."""
        first = episodes_due(self._settings, buffer)
        return self._evaluation(iteration, first, buffer)

    def evaluate_final(self, iteration: int, buffer: ReplayBuffer) -> list[Command]:
        """Return commands of a final evaluation after an iteration: final weights, fresh seeds."""
        commands = self._evaluation(iteration, FINAL_EVALUATION, buffer)
        return [msgspec.structs.replace(c, weights_version=iteration) for c in commands]

    def _evaluation(self, iteration: int, first: int, buffer: ReplayBuffer) -> list[Command]:
        evaluation = self._config.evaluation
        best = Best.of(buffer.best(self._settings.last_few))
        c0 = self._target.initial(best.mean, best.horizon)
        seeds = EVALUATION_SEEDS if evaluation.eval_seeds == "final" else SEARCH_SEEDS
        commands = self._commands(
            "evaluate", iteration, first, [c0] * evaluation.eval_episodes, seeds
        )
        return [
            msgspec.structs.replace(
                c,
                cap=self._spec.max_return,
                max_steps=self._spec.max_episode_steps,
                temperature=evaluation.eval_temperature,
            )
            for c in commands
        ]

    def _stream(self, iteration: int, index: int = -1) -> Stream:
        return Stream(stream_key(self._config.seed, Purpose.COMMANDS, iteration, index))

    def _commands(
        self,
        kind: CommandKind,
        iteration: int,
        first: int,
        desired: list[tuple[float, int]],
        seeds: tuple[int, int],
    ) -> list[Command]:
        environment_seeds = self._stream(iteration, first).integers(len(desired), *seeds)
        return [
            Command(
                id=iteration * COMMANDS_PER_ITERATION + index,
                kind=kind,
                desired_return=desired_return,
                desired_horizon=desired_horizon,
                environment_seed=seed,
                stream_key=stream_key(self._config.seed, Purpose.EPISODE, iteration, index),
                weights_version=weights_version(iteration, self._config.lead),
                max_steps=self._max_train_steps,
            )
            for index, ((desired_return, desired_horizon), seed) in enumerate(
                zip(desired, environment_seeds.tolist(), strict=True), start=first
            )
        ]
