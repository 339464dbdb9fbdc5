import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import gymnasium as gym
import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from gymnasium.envs.registration import EnvSpec

from udrl import commands
from udrl.acting import EpisodeGenerator, Failure, generate_episodes
from udrl.behavior import initialise
from udrl.commands import Command, CommandSampler
from udrl.config import Config, build
from udrl.digests import episode_digest
from udrl.environments import (
    Environment,
    EnvironmentSpec,
    limit_steps,
    make_environment,
    specify,
)
from udrl.environments.making import adapt
from udrl.episode import Episode
from udrl.errors import EnvironmentFault, UnsupportedEnvironment
from udrl.frame_stack import Seen
from udrl.graph import acting_graph
from udrl.inference import ActingFunction, Call
from udrl.replay_buffer import Entry, ReplayBuffer
from udrl.streams import Purpose, stream_key
from udrl.training import weights_of

Make = Callable[[Config], Environment]
Order = tuple[Command, ActingFunction | None]


def settings(environment: str = "Scripted-v0", **values: Any) -> Config:
    small = {"environment": environment, "hidden": [16, 16]}
    return build(Config, small | values)


def make_command(number: int, **values: Any) -> Command:
    """A command for weights version 1."""
    usual: dict[str, Any] = {
        "id": number,
        "kind": "explore",
        "desired_return": 3.0,
        "desired_horizon": 5,
        "environment_seed": number,
        "stream_key": stream_key(1, Purpose.EPISODE, 1, number),
        "weights_version": 1,
        "max_steps": 5000,
    }
    return Command(**(usual | values))


def behavior_of(config: Config, spec: EnvironmentSpec) -> ActingFunction:
    return ActingFunction(acting_graph(config.network, spec), weights_of(initialise(config, spec)))


def algorithm2(
    config: Config,
    command: Command,
    behavior: ActingFunction | None,
    make: Make = make_environment,
) -> Episode:
    """Algorithm 2 as in the paper: one environment, one episode, one action at a time."""
    env = make(config)
    spec = specify(env, config)
    limit_steps(env, command.max_steps)
    dr, dh = command.desired_return, command.desired_horizon
    s, _ = env.reset(seed=command.environment_seed)
    dtype, shape = spec.observation_space.dtype, spec.observation_space.shape
    s = np.asarray(s, dtype)

    episode: list[tuple[Any, int, np.float32]] = []  # 1: E <- {}
    over = terminated = truncated = False
    while not over:  # 3
        if command.cap is not None:
            dr = min(dr, command.cap)
        # 4: compute P(a_t | s_t, c_t) = B(s_t, c_t; theta)
        if behavior is None:
            logits = [0.0] * spec.action_space.n_parameters
        else:
            logits = behavior.logits(
                (s.reshape(1, *(shape or (1,))),), np.array([[dr, dh]], np.float64)
            )[0].tolist()
        # 5: execute a_t ~ P(a_t | s_t, c_t)
        numbers, random = command.decisions(len(episode) + 1, ())
        u, is_random = float(numbers[-1]), random[-1]
        if is_random:
            a = int(u * spec.action_space.n_parameters)
        elif command.temperature == 0:
            a = logits.index(max(logits))
        else:
            weights = np.exp((np.array(logits) - max(logits)) / command.temperature).tolist()
            cumulative = [weights[0]]
            for weight in weights[1:]:
                cumulative.append(cumulative[-1] + weight)
            a = next((a for a, p in enumerate(cumulative) if u * cumulative[-1] < p))
        next_s, reward, terminated, truncated, _ = env.step(a)
        r = np.float32(reward)
        episode.append((s, a, r))  # 6: append (s_t, a_t, r_t) to E
        s = np.asarray(next_s, dtype)  # 7: update state
        dr -= float(r)  # 8: update desired reward
        dh -= 1  # 9: update desired horizon
        over = terminated or truncated
    env.close()
    observations, actions, rewards = zip(*episode, strict=True)
    return Episode(
        command_id=command.id,
        observations=np.array(observations, dtype),
        actions=np.array(actions, spec.action_space.dtype),
        rewards=np.array(rewards, np.float32),
        terminated=terminated,
        truncated=truncated,
    )


def run_commands(generator: EpisodeGenerator, commands: Sequence[Order]) -> list[Episode | Failure]:
    """Run commands as an actor does, with all environments busy; return outcomes as they arrive."""
    waiting = list(commands)[::-1]
    outcomes: list[Episode | Failure] = []
    while waiting or generator.running:
        while waiting and generator.free:
            failure = generator.start(*waiting.pop())
            if failure is not None:
                outcomes.append(failure)
        outcomes += generator.step()
    return outcomes


def digests(outcomes: Sequence[Episode | Failure]) -> dict[int, bytes]:
    return {e.command_id: episode_digest(e) for e in outcomes if isinstance(e, Episode)}


# --- Equality with the paper's loop, independent of concurrency --------------------------------


@cache
def mixed_commands(environment: str) -> tuple[Config, list[Order], list[bytes]]:
    """Commands of all kinds, for two weights versions, and their episodes' digests."""
    config = settings(
        environment,
        n_warm_up_episodes=3,
        warm_up_hold_steps=3,
        n_episodes_per_iter=5,
        eval_episodes=4,
        max_train_steps=60,
        max_return=12.0,
    )
    env = make_environment(config)
    spec = specify(env, config)
    one, other = (behavior_of(settings(environment, seed=seed), spec) for seed in (1, 2))
    buffer = ReplayBuffer(config.buffer, [Entry(10.0, 0, 4), Entry(30.0, 1, 20)])
    sample = CommandSampler(config, spec)
    evaluation = sample.evaluate(2, buffer)
    commands: list[Order] = []
    commands += [(command, None) for command in sample.warm_up()]
    commands += [(command, one) for command in sample.explore(1, buffer)]
    commands += [(command, other) for command in sample.explore(2, buffer) + evaluation]
    commands += [
        (msgspec.structs.replace(command, id=command.id + 100, temperature=0.0), other)
        for command in evaluation
    ]
    return config, commands, [episode_digest(algorithm2(config, *each)) for each in commands]


@pytest.mark.parametrize("n_environments", [1, 3, 16, 20])
@pytest.mark.parametrize("environment", ["CartPole-v1", "Figure2-v0", "LunarLander-v3"])
def test_episodes_equal_algorithm_2_for_any_number_of_environments(
    environment: str, n_environments: int
) -> None:
    config, commands, expected = mixed_commands(environment)
    generator = EpisodeGenerator(config, n_environments)
    # Every fifth command mixes long and short episodes, versions and kinds.
    mixed = [commands[5 * i % len(commands)] for i in range(len(commands))]
    outcomes = run_commands(generator, mixed)
    assert digests(outcomes) == {
        command.id: digest for (command, _), digest in zip(commands, expected, strict=True)
    }


def test_episode_repeats_after_other_episodes() -> None:
    config, commands, _ = mixed_commands("LunarLander-v3")
    generator = EpisodeGenerator(config, n_environments=2)
    assert digests(run_commands(generator, commands)) == digests(
        run_commands(generator, commands[::-1])
    )


# --- Scripted and failing environments -----------------------------------------------------------


def four_steps(seed: int) -> list[float]:
    return [1.0, -2.0, 4.0, 0.5]


@dataclass
class World:
    """The script of scripted environments, and a record of the calls they received.

    Attributes:
        script: the rewards of an episode, by seed.
        ends: ``terminated`` and ``truncated`` of the last step.
        faults: what goes wrong in the episodes of a seed, with the third step (or the reset).
    """

    script: Callable[[int], list[float]] = four_steps
    ends: tuple[bool, bool] = (True, False)
    faults: dict[int, str] = field(default_factory=dict)
    instances: list["Scripted"] = field(default_factory=list)

    def make(self, config: Config) -> Environment:
        spec = EnvSpec("Scripted-v0", entry_point=self._instance, max_episode_steps=5000)
        return adapt(gym.make(spec, disable_env_checker=True), "Scripted-v0", config.actions)

    def _instance(self, **_: Any) -> "Scripted":
        self.instances.append(Scripted(self))
        return self.instances[-1]


class Scripted(gym.Env[Any, Any]):
    """Observes (seed, steps taken, last action); raises if it is stepped after an episode's end."""

    def __init__(self, world: World) -> None:
        self.metadata = {"render_modes": []}
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self.action_space = gym.spaces.Discrete(3)
        self.world = world
        self.seeds: list[int] = []
        self.left: list[float] = []
        self.closed = False
        self.broken = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        assert seed is not None
        assert not self.broken
        self.fault = self.world.faults.get(seed)
        self.broken = self.fault is not None
        if self.fault == "raises in reset":
            raise RuntimeError("no more worlds")
        if self.fault == "exits in reset":
            sys.exit("no more worlds")
        self.seeds.append(seed)
        self.left = list(self.world.script(seed))
        self.t = 0
        return np.array([seed, 0, 0], np.float32), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        reward = self.left.pop(0)
        observation = np.array([self.seeds[-1], self.t, action], np.float32)
        terminated, truncated = self.world.ends if not self.left else (False, False)
        if self.fault is not None and self.t == 3:
            if self.fault == "raises in step":
                raise RuntimeError("the world has ended")
            if self.fault == "exits in step":
                sys.exit(0)
            if self.fault == "returns four values":
                return observation, reward, terminated, {}
            if self.fault == "observes a matrix":
                observation = np.zeros((2, 2), np.float32)
            if self.fault == "observes NaN":
                observation[1] = np.nan
            if self.fault == "observes infinity":
                observation[1] = np.inf
            if self.fault.startswith("rewards "):
                reward = float(self.fault.removeprefix("rewards "))
        return observation, reward, terminated, truncated, {}

    def close(self) -> None:
        self.closed = True


class Spy:
    """Returns the same logits for every input, and records its inputs."""

    def __init__(self, generator: EpisodeGenerator, logits: list[float]) -> None:
        self.shape = generator.spec.observation_space.shape
        self.logits = logits
        self.commands: list[list[float]] = []  # of the first row
        self.rows: list[int] = []

    def call(self, n: int) -> Call:
        return _SpyCall(self, n)


class _SpyCall:
    def __init__(self, spy: Spy, n: int) -> None:
        self.seen: Seen = (np.zeros((n, *spy.shape), np.float32),)
        self.state = self.next_state = np.zeros((n, 0), np.float32)
        self.command = np.zeros((n, 2))
        self.logits = np.tile(np.array(spy.logits, np.float32), (n, 1))
        self._spy = spy

    def run(self) -> None:
        self._spy.commands.append(self.command[0].tolist())
        self._spy.rows.append(len(self.command))


def act(world: World, commands: list[Command], n_environments: int = 1) -> list[Episode | Failure]:
    """Run commands with random actions."""
    generator = EpisodeGenerator(settings(), n_environments, world.make)
    return run_commands(generator, [(command, None) for command in commands])


@pytest.mark.parametrize(
    ("cap", "seen"),
    [
        (None, [[3, 2], [2, 1], [4, 0], [0, -1]]),
        (2.5, [[2.5, 2], [1.5, 1], [2.5, 0], [-1.5, -1]]),
    ],
)
def test_graph_input_is_the_remaining_command(cap: float | None, seen: list[list[float]]) -> None:
    config = settings()
    generator = EpisodeGenerator(config, 1, World().make)
    spy = Spy(generator, [0.0, 0.0, 0.0])
    generate_episodes(generator, [make_command(1, cap=cap, desired_horizon=2)], spy)
    assert spy.commands == seen


@pytest.mark.parametrize("n_environments", [1, 7, 40])
def test_call_has_one_row_per_running_episode(n_environments: int) -> None:
    generator = EpisodeGenerator(settings(), n_environments, World().make)
    spy = Spy(generator, [0.0, 0.0, 0.0])
    generate_episodes(generator, [make_command(i) for i in range(n_environments)], spy)
    assert spy.rows == [n_environments] * 4


@pytest.mark.parametrize(
    ("logits", "probabilities"),
    [(None, [1 / 3, 1 / 3, 1 / 3]), ([5 + math.log(p) for p in (0.5, 0.3, 0.2)], [0.5, 0.3, 0.2])],
)
def test_actions_follow_the_networks_distribution_and_are_uniform_in_the_warm_up(
    logits: list[float] | None, probabilities: list[float]
) -> None:
    n, config = 4000, settings()
    generator = EpisodeGenerator(config, 1, World(script=lambda _: [0.0] * n).make)
    behavior = None if logits is None else Spy(generator, logits)
    (episode,) = generate_episodes(generator, [make_command(1)], behavior)
    expected = n * np.array(probabilities)
    counts = np.bincount(episode.actions, minlength=3)
    # Chi-square with 2 degrees of freedom exceeds 13.8 once in a thousand samples.
    assert ((counts - expected) ** 2 / expected).sum() < 13.8


class Edges:
    """A stream of the smallest number, the largest, and one between them."""

    def __init__(self, key: bytes) -> None:
        pass

    def uniforms(self, n: int) -> npt.NDArray[np.float64]:
        return np.resize([0.0, 0.5, 1 - 2**-53], n)


@pytest.mark.parametrize(
    ("logits", "actions"),
    [
        ([0.0, 0.0, -math.inf], [0, 1, 1]),
        ([-math.inf, 0.0, 0.0], [1, 2, 2]),
        ([0.0, -math.inf, 0.0], [0, 2, 2]),
        ([-math.inf, 0.0, -math.inf], [1, 1, 1]),
    ],
)
def test_action_of_probability_zero_is_never_taken(
    logits: list[float], actions: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(commands, "Stream", Edges)
    config = settings()
    generator = EpisodeGenerator(config, 1, World(script=lambda _: [0.0] * 3).make)
    (episode,) = generate_episodes(generator, [make_command(1)], Spy(generator, logits))
    assert episode.actions.tolist() == actions


def test_temperature_0_selects_the_mode() -> None:
    config = settings()
    generator = EpisodeGenerator(config, 1, World(script=lambda _: [0.0] * 100).make)
    spy = Spy(generator, [0.1, 0.3, 0.2])
    mode, sampled = generate_episodes(
        generator, [make_command(1, temperature=0.0), make_command(2)], spy
    )
    assert set(mode.actions.tolist()) == {1}
    assert set(sampled.actions.tolist()) == {0, 1, 2}


def test_each_episode_has_its_own_temperature() -> None:
    n, logits = 3000, [0.0, 1.0, -0.5]
    config = settings(max_episode_steps=n)
    generator = EpisodeGenerator(config, 2, World(script=lambda _: [0.0] * n).make)
    spy = Spy(generator, logits)
    temperatures = (0.25, 1.0, 4.0)
    commands = [make_command(i, temperature=t, max_steps=n) for i, t in enumerate(temperatures)]
    for temperature, episode in zip(
        temperatures, generate_episodes(generator, commands, spy), strict=True
    ):
        weights = np.exp(np.array(logits) / temperature)
        expected = weights / weights.sum()
        found = np.bincount(episode.actions, minlength=3) / n
        # Four standard deviations of a frequency, plus the rounding of the expected values.
        assert np.abs(found - expected).max() < 4 * 0.5 / np.sqrt(n)


@pytest.mark.parametrize("ends", [(True, False), (False, True), (True, True)])
def test_episode_has_all_steps_and_its_end_flags(ends: tuple[bool, bool]) -> None:
    (episode,) = act(World(ends=ends), [make_command(7)])
    assert isinstance(episode, Episode)
    assert (episode.command_id, episode.length) == (7, 4)
    assert (episode.terminated, episode.truncated) == ends
    assert episode.rewards.tolist() == [1.0, -2.0, 4.0, 0.5]
    assert episode.episode_return == 3.5


def test_observations_are_those_before_each_action() -> None:
    for episode in act(World(), [make_command(i) for i in range(1, 6)], n_environments=2):
        assert isinstance(episode, Episode)
        before = [0, *episode.actions.tolist()[:-1]]
        assert episode.observations.tolist() == [
            [episode.command_id, t, action] for t, action in enumerate(before)
        ]


def test_environment_is_reset_once_per_episode_with_the_commands_seed() -> None:
    world = World()
    act(world, [make_command(i, environment_seed=i + 50) for i in range(6)], n_environments=2)
    first, second = (instance.seeds for instance in world.instances)
    assert (first, second) == ([50, 52, 54], [51, 53, 55])


def test_max_steps_truncates_only_the_commands_own_episode() -> None:
    steps = {1: 2, 2: 4, 3: 3, 4: 5000}
    episodes = act(World(), [make_command(i, max_steps=n) for i, n in steps.items()])
    ends = {
        e.command_id: (e.length, e.terminated, e.truncated)
        for e in episodes
        if isinstance(e, Episode)
    }
    assert ends == {
        1: (2, False, True),
        2: (4, True, True),
        3: (3, False, True),
        4: (4, True, False),
    }


def test_rewards_are_rounded_to_float32_before_they_are_subtracted() -> None:
    config = settings(return_scale=1, horizon_scale=1)
    generator = EpisodeGenerator(config, 1, World(script=lambda _: [0.1, 0.0]).make)
    spy = Spy(generator, [0.0, 0.0, 0.0])
    generate_episodes(generator, [make_command(1, desired_return=0.1)], spy)
    assert spy.commands[1][0] == np.float32(0.1 - float(np.float32(0.1)))


def long_script(seed: int) -> list[float]:
    return [float((seed * t) % 7 - 3) for t in range(1100 * seed)]


@pytest.mark.parametrize("n_environments", [1, 2, 4])
def test_episodes_longer_than_the_initial_storage_are_complete(n_environments: int) -> None:
    # The initial storage has 1024 steps; these episodes have 1100, 2200 and 3300.
    config, world = settings(), World(script=long_script)
    generator = EpisodeGenerator(config, n_environments, world.make)
    behavior = behavior_of(config, generator.spec)
    commands: list[Order] = [
        (make_command(1), behavior),
        (make_command(3), None),
        (make_command(2), behavior),
    ]
    outcomes = run_commands(generator, commands)
    assert digests(outcomes) == {
        command.id: episode_digest(algorithm2(config, command, behavior, World(long_script).make))
        for command, behavior in commands
    }


# --- Faults ---------------------------------------------------------------------------------------

NOT_FINITE = "not all finite numbers"
FAULTS = {
    "raises in reset": "reset() raised RuntimeError: no more worlds (test_acting.py, line ",
    "raises in step": "step() raised RuntimeError: the world has ended (test_acting.py, line ",
    "exits in reset": "reset() raised SystemExit: no more worlds (test_acting.py, line ",
    "exits in step": "step() raised SystemExit: 0 (test_acting.py, line ",
    "returns four values": "step() returned a tuple of 4, expected (observation, reward, ",
    "observes a matrix": "step() returned observation: an array of float32, shape (2, 2), exp",
    "observes NaN": f"observations are {NOT_FINITE}",
    "observes infinity": f"observations are {NOT_FINITE}",
    "rewards nan": "step() returned the reward nan, expected a finite number",
    "rewards inf": "step() returned the reward inf, expected a finite number",
    "rewards 1e300": "step() returned the reward 1e+300, expected a finite number",
}


@pytest.mark.parametrize("random", [True, False])
@pytest.mark.parametrize("fault", FAULTS)
def test_fault_costs_one_episode_and_its_environment_only(fault: str, random: bool) -> None:
    config, world = settings(), World(faults={4: fault})
    generator = EpisodeGenerator(config, 3, world.make)
    behavior = None if random else behavior_of(config, generator.spec)
    commands = [make_command(i) for i in range(9)]
    outcomes = run_commands(generator, [(command, behavior) for command in commands])

    (failure,) = (outcome for outcome in outcomes if isinstance(outcome, Failure))
    assert failure.command == commands[4]
    assert isinstance(failure.error, EnvironmentFault)
    assert str(failure.error).startswith(
        f"the environment failed under command 4 (seed 4): {FAULTS[fault]}"
    )
    assert digests(outcomes) == {
        c.id: episode_digest(algorithm2(config, c, behavior, World().make))
        for c in commands
        if c.id != 4
    }
    assert [instance.broken for instance in world.instances].count(True) == 1
    assert all(instance.closed == instance.broken for instance in world.instances)
    assert len(world.instances) == 3 + 1


def test_generator_survives_consecutive_faults() -> None:
    n = len(FAULTS)
    world = World(faults=dict(enumerate(FAULTS, start=1)))
    outcomes = act(world, [make_command(i) for i in range(n + 2)], n_environments=2)
    assert sum(isinstance(outcome, Failure) for outcome in outcomes) == n
    assert set(digests(outcomes)) == {0, n + 1}


def test_rebuilt_environment_gets_the_next_commands_limit() -> None:
    world = World(faults={1: "raises in reset"})
    _, episode = act(world, [make_command(1, max_steps=2), make_command(2, max_steps=2)])
    assert isinstance(episode, Episode)
    assert (episode.length, episode.truncated) == (2, True)


def test_free_and_running_count_environments() -> None:
    generator = EpisodeGenerator(settings(), 2, World(faults={3: "raises in reset"}).make)
    assert (generator.free, generator.running) == (2, [])
    assert isinstance(generator.start(make_command(3), None), Failure)
    assert (generator.free, generator.running) == (2, [])
    assert generator.start(make_command(1), None) is None
    assert (generator.free, generator.running) == (1, [make_command(1)])
    for _ in range(3):
        assert generator.step() == []
    assert len(generator.step()) == 1
    assert (generator.free, generator.running) == (2, [])


def test_episodes_are_returned_in_order_of_command_id() -> None:
    lengths = {1: 9, 2: 3, 3: 6}
    world = World(script=lambda seed: [0.0] * lengths[seed])
    generator = EpisodeGenerator(settings(), 2, world.make)
    episodes = generate_episodes(generator, [make_command(i) for i in (3, 1, 2)], None)
    assert [(e.command_id, e.length) for e in episodes] == list(lengths.items())


def fails_at_first(times: int) -> Callable[[int], list[float]]:
    """A script that fails for seed 2 the first ``times`` times."""
    failures = iter([True] * times)

    def script(seed: int) -> list[float]:
        if seed == 2 and next(failures, False):
            raise RuntimeError("not yet")
        return four_steps(seed)

    return script


def test_generate_retries_after_a_fault_with_the_same_result() -> None:
    commands = [make_command(i) for i in range(5)]
    smooth, rough = (
        generate_episodes(EpisodeGenerator(settings(), 2, world.make), commands, None)
        for world in (World(), World(script=fails_at_first(times=2)))
    )
    assert digests(rough) == digests(smooth)
    assert [episode.command_id for episode in rough] == [0, 1, 2, 3, 4]


def test_generate_raises_the_fault_of_a_command_that_keeps_failing() -> None:
    generator = EpisodeGenerator(settings(), 2, World(script=fails_at_first(times=3)).make)
    with pytest.raises(EnvironmentFault, match=r"under command 2 .*reset\(\) .* not yet"):
        generate_episodes(generator, [make_command(i) for i in range(5)], None)


def test_close_closes_all_environments() -> None:
    world = World()
    EpisodeGenerator(settings(), 3, world.make).close()
    assert [instance.closed for instance in world.instances] == [True] * 3


def test_environments_are_closed_if_they_cannot_be_specified() -> None:
    world = World()

    def make(config: Config) -> Environment:
        env = world.make(config)
        env.metadata["max_return"] = np.inf
        return env

    with pytest.raises(UnsupportedEnvironment, match="max_return"):
        EpisodeGenerator(settings(), 3, make)
    assert [instance.closed for instance in world.instances] == [True] * 3
