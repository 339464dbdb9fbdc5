"""Automatic settings are chosen from random episodes."""

from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from udrl.acting import EpisodeGenerator
from udrl.algorithm1 import algorithm1
from udrl.automatic_settings import (
    Sample,
    choose,
    resolve_automatic,
    rewards_are_rare,
    scale_fits,
)
from udrl.config import AUTOMATIC, Budget, Config, build, change
from udrl.episode import Episode


class Endless(gym.Env[Any, Any]):
    """Episodes never end, and all actions have the same effect."""

    id = "Endless-v0"
    observation_space = gym.spaces.Box(0, 1, (2,))
    action_space = gym.spaces.Discrete(2)
    steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        Endless.steps += 1
        return np.zeros(2, np.float32), 0.0, False, False, {}


gym.register(Endless.id, entry_point=f"{__name__}:Endless", max_episode_steps=1_000_000)

SCALES = ("return_scale", "horizon_scale")


def config(**values: Any) -> Config:
    return build(Config, {"environment": "CartPole-v1", "hidden": [8]} | values)


def episodes(*returns_and_lengths: tuple[float, int]) -> list[Episode]:
    return [
        Episode(
            command_id=i,
            observations=np.arange(4 * n, dtype=np.float32).reshape(n, 4) + 10_000 * i,
            actions=np.zeros(n, np.uint8),
            rewards=np.array([r] + [0.0] * (n - 1), np.float32),
            terminated=True,
            truncated=False,
        )
        for i, (r, n) in enumerate(returns_and_lengths)
    ]


@pytest.mark.parametrize(
    ("found", "scales"),
    [
        ([(0.0, 10), (1.0, 10)], (1.0, 0.1)),
        ([(-500.0, 100), (100.0, 300)], (0.0017, 0.005)),  # the difference is 600
        ([(-200.0, 200), (-200.0, 200)], (0.005, 0.005)),
        ([(0.0, 4), (0.0, 4)], (1.0, 0.25)),
        ([(1e30, 1)], (1e-6, 1.0)),
    ],
)
def test_scales_are_the_inverse_of_typical_values(
    found: list[tuple[float, int]], scales: tuple[float, float]
) -> None:
    network = choose(config(), SCALES, EpisodeGenerator(config(), 1), episodes(*found)).network
    assert (network.return_scale, network.horizon_scale) == scales


def test_explicit_values_are_kept() -> None:
    generator = EpisodeGenerator(config(), 1)
    given = config(return_scale=0.5, horizon_scale=0.5)
    assert resolve_automatic(given, ()) == given
    half = choose(given, ("horizon_scale",), generator).network
    assert half.return_scale == 0.5
    assert half.horizon_scale != 0.5


def test_choice_is_independent_of_the_number_of_environments() -> None:
    resolved = [choose(config(), AUTOMATIC, EpisodeGenerator(config(), n)) for n in (1, 7)]
    assert resolved[0] == resolved[1]
    assert 0.01 < resolved[0].network.return_scale < 0.1


def test_algorithm_1_chooses_automatic_settings() -> None:
    small = {"n_warm_up_episodes": 4, "n_episodes_per_iter": 2, "n_updates_per_iter": 2,
             "batch_size": 16, "replay_size": 10, "last_few": 2}  # fmt: skip
    resolved = resolve_automatic(config(**small), SCALES)
    budget = Budget(max_env_steps=300)
    ways = [
        algorithm1(config(**small), budget, automatic=SCALES),
        algorithm1(resolved, budget),
    ]
    assert ways[0].weights_sha256 == ways[1].weights_sha256


def walk(
    *steps: tuple[int, int, float], truncated: bool = False, terminated: bool | None = None
) -> Episode:
    """An episode of (observed category, action, reward) steps."""
    return Episode(
        command_id=0,
        observations=np.array([[s[0]] for s in steps], np.int32),
        actions=np.array([s[1] for s in steps], np.uint8),
        rewards=np.array([s[2] for s in steps], np.float32),
        terminated=not truncated if terminated is None else terminated,
        truncated=truncated,
    )


@pytest.mark.parametrize(
    ("others", "expected"),
    [
        ([walk((0, 0, 0.0), (1, 1, 1.0))], False),  # identical
        ([walk((0, 1, 0.0), (2, 1, 1.0))], False),  # another action
        ([walk((0, 0, 0.0), (2, 1, 1.0))], True),  # another next state
        ([walk((0, 0, 0.5), (1, 1, 1.0))], True),  # another reward
        ([walk((0, 0, 0.0))], True),  # terminal
        ([walk((0, 0, 0.0), truncated=True)], False),  # truncated: the next state is unknown
        ([walk((0, 0, 0.0), truncated=True, terminated=True)], True),  # terminal, at the limit
        ([], False),
    ],
)
def test_stochasticity_is_detected_from_different_outcomes_of_equal_steps(
    others: list[Episode], expected: bool
) -> None:
    sample = Sample()
    for one in [walk((0, 0, 0.0), (1, 1, 1.0)), *others]:
        sample.add(one)
    assert sample.is_stochastic is expected


@pytest.mark.parametrize(("slippery", "expected"), [(True, "action_value"), (False, "value")])
def test_baseline_is_action_value_in_stochastic_environments(slippery: bool, expected: str) -> None:
    settings = build(
        Config,
        {"environment": "FrozenLake-v1", "environment_kwargs": {"is_slippery": slippery}},
    )
    resolved = choose(
        settings,
        ("baseline", "horizon_scale", "hold_share", "hold_rate"),
        EpisodeGenerator(settings, 1),
    )
    assert resolved.network.baseline == expected
    assert (resolved.network.horizon_scale == 0) is slippery
    assert resolved.commands.hold_share == (0.5 if slippery else 0.25)
    assert resolved.commands.hold_rate == (0.15 if slippery else 0.05)
    everything = change(settings, segments="all")
    assert resolve_automatic(everything, ["baseline"]).network.baseline == "none"


@pytest.mark.parametrize(
    ("scale", "size", "good"),
    [(1.0, 0.0, True), (0.01, 500.0, True), (0.01, 5.0, False), (0.0, 5.0, True)],
)
def test_scale_is_checked_against_typical_values(scale: float, size: float, good: bool) -> None:
    assert scale_fits(scale, size) is good


@pytest.mark.parametrize(("environment", "expected"), [("MountainCar-v0", 32), ("CartPole-v1", 1)])
def test_actions_are_held_where_one_step_has_little_effect(environment: str, expected: int) -> None:
    settings = config(environment=environment)
    resolved = choose(settings, ("warm_up_hold_steps",), EpisodeGenerator(settings, 1)).commands
    assert resolved.warm_up_hold_steps == expected
    assert resolved.hold_steps == settings.commands.hold_steps


@pytest.mark.parametrize(("length", "expected"), [(9, 0.95), (80, 0.95), (200, 0.98), (500, 0.992)])
def test_return_lambda_follows_the_length_of_episodes(length: int, expected: float) -> None:
    settings = config()
    generator = EpisodeGenerator(settings, 1)
    resolved = choose(settings, ("return_lambda",), generator, episodes((1.0, length)) * 3)
    assert resolved.training.return_lambda == expected


def test_long_episodes_are_sampled_in_part() -> None:
    endless = config(environment=Endless.id)
    with closing(EpisodeGenerator(endless, 1)) as generator:
        resolved = choose(endless, AUTOMATIC, generator)
    assert Endless.steps <= 60_000
    assert resolved.network.horizon_scale == 0.0005
    assert resolved.commands.n_warm_up_episodes == 50


def test_short_episodes_make_a_longer_warm_up() -> None:
    settings = config(environment="FrozenLake-v1")
    resolved = choose(settings, ("n_warm_up_episodes",), EpisodeGenerator(settings, 1)).commands
    assert 300 < resolved.n_warm_up_episodes < 1_000  # of about 8 steps


def test_dataset_sets_the_number_of_warm_up_episodes() -> None:
    settings = config(n_warm_up_episodes=3)
    resolved = choose(settings, AUTOMATIC, EpisodeGenerator(settings, 1), episodes((1.0, 9)) * 3)
    assert resolved.commands.n_warm_up_episodes == 3
    assert resolved.commands.warm_up_hold_steps == 1


@pytest.mark.parametrize(("environment", "shown"), [("Pendulum-v1", True), ("CartPole-v1", False)])
def test_time_left_is_observed_if_random_episodes_last_half_the_step_limit(
    environment: str, shown: bool
) -> None:
    assert (
        resolve_automatic(config(environment=environment), ("observe_time",)).observe_time is shown
    )


@pytest.mark.parametrize(
    ("lengths", "limits", "shown"),
    [
        ((49, 51), {}, False),
        ((50, 51), {}, True),
        ((30, 30), {"max_train_steps": 50}, True),  # the maximum
        ((999, 999), {"max_episode_steps": 100_000}, False),
        ((1_100, 1_100), {"max_episode_steps": 100_000}, True),  # of the 2,000 that are sampled
    ],
)
def test_lengths_are_compared_with_the_limit_of_random_episodes(
    lengths: tuple[int, ...], limits: dict[str, int], shown: bool
) -> None:
    settings = config(**{"max_episode_steps": 100} | limits)
    found = episodes(*[(1.0, length) for length in lengths])
    with closing(EpisodeGenerator(settings, 1)) as generator:
        assert choose(settings, ["observe_time"], generator, found).observe_time is shown


@pytest.mark.parametrize(
    ("n_better", "iterations", "rare"),
    [
        (4, {}, True),  # 60 episodes in 12 iterations: (1 + 4) / (30 + 2) of them are 9.4
        (5, {}, False),
        (2, {"n_episodes_per_iter": 10}, False),
        (2, {"n_steps_per_iter": 1_000}, False),  # 10 episodes
    ],
)
def test_rewards_are_rare_if_the_usual_window_has_few_better_episodes(
    n_better: int, iterations: dict[str, int], rare: bool
) -> None:
    sample = Sample()
    for one in episodes(*[(float(i < n_better), 100) for i in range(30)]):
        sample.add(one)
    settings = config(**{"n_episodes_per_iter": 5} | iterations)
    assert rewards_are_rare(sample, settings.commands) is rare


@pytest.mark.parametrize(("environment", "rare"), [(Endless.id, True), ("CartPole-v1", False)])
def test_best_and_newest_episodes_are_kept_if_rewards_are_rare(
    environment: str, rare: bool
) -> None:
    settings = config(environment=environment, n_episodes_per_iter=5)
    with closing(EpisodeGenerator(settings, 1)) as generator:
        resolved = choose(settings, AUTOMATIC, generator)
    kept = resolved.buffer
    expected = (100, 60, None) if rare else (12_000, 0, 12)
    assert (kept.replay_size, kept.recent_size, kept.max_age) == expected
    assert resolved.network.guidance_kl == (0.1 if rare else 0.0)
    assert resolved.training.reset_every == (100 if rare else None)


def test_kept_episodes_include_those_that_commands_are_drawn_from() -> None:
    settings = config(environment=Endless.id, n_episodes_per_iter=5, last_few=300)
    with closing(EpisodeGenerator(settings, 1)) as generator:
        assert choose(settings, ["replay_size"], generator).buffer.replay_size == 300


def test_rewards_of_a_dataset_are_not_rare() -> None:
    settings = config()
    equal = episodes((1.0, 9)) * 30
    resolved = choose(settings, ["max_age"], EpisodeGenerator(settings, 1), equal)
    assert resolved.buffer.max_age == 12
