"""Settings that are left open are chosen by random episodes."""

from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from udrl.acting import EpisodeGenerator
from udrl.algorithm1 import algorithm1
from udrl.config import AUTOMATIC, Budget, Config, build, change
from udrl.episode import Episode
from udrl.fitting import Sample, choose, fit, fits


class Endless(gym.Env[Any, Any]):
    """Nothing ends it and nothing tells actions apart."""

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
def test_scales_are_one_over_what_is_usual(
    found: list[tuple[float, int]], scales: tuple[float, float]
) -> None:
    network = choose(config(), SCALES, EpisodeGenerator(config(), 1), episodes(*found)).network
    assert (network.return_scale, network.horizon_scale) == scales


def test_what_is_given_stays() -> None:
    generator = EpisodeGenerator(config(), 1)
    given = config(return_scale=0.5, horizon_scale=0.5)
    assert fit(given, ()) == given
    half = choose(given, ("horizon_scale",), generator).network
    assert half.return_scale == 0.5
    assert half.horizon_scale != 0.5


def test_the_choice_does_not_depend_on_how_many_environments_there_are() -> None:
    fitted = [choose(config(), AUTOMATIC, EpisodeGenerator(config(), n)) for n in (1, 7)]
    assert fitted[0] == fitted[1]
    assert 0.01 < fitted[0].network.return_scale < 0.1


def test_algorithm_1_chooses_them() -> None:
    small = {"n_warm_up_episodes": 4, "n_episodes_per_iter": 2, "n_updates_per_iter": 2,
             "batch_size": 16, "replay_size": 10, "last_few": 2}  # fmt: skip
    fitted = fit(config(**small), SCALES)
    budget = Budget(max_env_steps=300)
    ways = [
        algorithm1(config(**small), budget, automatic=SCALES),
        algorithm1(fitted, budget),
    ]
    assert ways[0].weights_sha256 == ways[1].weights_sha256


def walk(*steps: tuple[int, int, float], truncated: bool = False) -> Episode:
    """An episode of (category seen, action, reward)."""
    return Episode(
        command_id=0,
        observations=np.array([[s[0]] for s in steps], np.int32),
        actions=np.array([s[1] for s in steps], np.uint8),
        rewards=np.array([s[2] for s in steps], np.float32),
        terminated=not truncated,
        truncated=truncated,
    )


@pytest.mark.parametrize(
    ("others", "expected"),
    [
        ([walk((0, 0, 0.0), (1, 1, 1.0))], False),  # the same again
        ([walk((0, 1, 0.0), (2, 1, 1.0))], False),  # another action
        ([walk((0, 0, 0.0), (2, 1, 1.0))], True),  # it led elsewhere
        ([walk((0, 0, 0.5), (1, 1, 1.0))], True),  # another reward
        ([walk((0, 0, 0.0))], True),  # it was the end
        ([walk((0, 0, 0.0), truncated=True)], False),  # nobody knows what would have followed
        ([], False),
    ],
)
def test_chance_shows_where_the_same_has_different_consequences(
    others: list[Episode], expected: bool
) -> None:
    sample = Sample()
    for one in [walk((0, 0, 0.0), (1, 1, 1.0)), *others]:
        sample.add(one)
    assert sample.is_stochastic is expected


@pytest.mark.parametrize(("slippery", "expected"), [(True, "action_value"), (False, "value")])
def test_where_chance_decides_actions_are_valued_on_average(slippery: bool, expected: str) -> None:
    settings = build(
        Config,
        {"environment": "FrozenLake-v1", "environment_kwargs": {"is_slippery": slippery}},
    )
    fitted = choose(
        settings,
        ("baseline", "horizon_scale", "held_actions", "held_rate"),
        EpisodeGenerator(settings, 1),
    )
    assert fitted.network.baseline == expected
    assert (fitted.network.horizon_scale == 0) is slippery
    assert fitted.commands.held_actions == (0.5 if slippery else 0.25)
    assert fitted.commands.held_rate == (0.15 if slippery else 0.05)
    everything = change(settings, segments="all")
    assert fit(everything, ["baseline"]).network.baseline == "none"


@pytest.mark.parametrize(
    ("scale", "size", "good"),
    [(1.0, 0.0, True), (0.01, 500.0, True), (0.01, 5.0, False), (0.0, 5.0, True)],
)
def test_a_scale_fits_what_is_usual_or_not(scale: float, size: float, good: bool) -> None:
    assert fits(scale, size) is good


@pytest.mark.parametrize(("environment", "expected"), [("MountainCar-v0", 32), ("CartPole-v1", 1)])
def test_actions_are_held_where_one_step_moves_little(environment: str, expected: int) -> None:
    settings = config(environment=environment)
    fitted = choose(settings, ("warm_up_hold",), EpisodeGenerator(settings, 1)).commands
    assert fitted.warm_up_hold == expected
    assert fitted.hold_steps == settings.commands.hold_steps


@pytest.mark.parametrize(("length", "expected"), [(9, 0.95), (80, 0.95), (200, 0.98), (500, 0.992)])
def test_lambda_follows_the_length_of_episodes(length: int, expected: float) -> None:
    settings = config()
    generator = EpisodeGenerator(settings, 1)
    fitted = choose(settings, ("return_lambda",), generator, episodes((1.0, length)) * 3)
    assert fitted.training.return_lambda == expected


def test_long_episodes_are_looked_at_in_part_and_few_of_them() -> None:
    endless = config(environment=Endless.id)
    with closing(EpisodeGenerator(endless, 1)) as generator:
        fitted = choose(endless, AUTOMATIC, generator)
    assert Endless.steps <= 60_000
    assert fitted.network.horizon_scale == 0.0005
    assert fitted.commands.n_warm_up_episodes == 50


def test_short_episodes_are_many_in_the_warm_up() -> None:
    settings = config(environment="FrozenLake-v1")
    fitted = choose(settings, ("n_warm_up_episodes",), EpisodeGenerator(settings, 1)).commands
    assert 300 < fitted.n_warm_up_episodes < 1_000  # of about 8 steps


def test_a_dataset_decides_how_many_episodes_the_warm_up_has() -> None:
    settings = config(n_warm_up_episodes=3)
    fitted = choose(settings, AUTOMATIC, EpisodeGenerator(settings, 1), episodes((1.0, 9)) * 3)
    assert fitted.commands.n_warm_up_episodes == 3
    assert fitted.commands.warm_up_hold == 1


@pytest.mark.parametrize(("environment", "shown"), [("Pendulum-v1", True), ("CartPole-v1", False)])
def test_the_time_is_shown_where_random_episodes_last_for_half_the_step_limit(
    environment: str, shown: bool
) -> None:
    assert fit(config(environment=environment), ("observe_time",)).observe_time is shown


@pytest.mark.parametrize(
    ("lengths", "limits", "shown"),
    [
        ((49, 51), {}, False),
        ((50, 51), {}, True),
        ((30, 30), {"max_train_steps": 50}, True),  # none can be longer
        ((999, 999), {"max_episode_steps": 100_000}, False),
        ((1_100, 1_100), {"max_episode_steps": 100_000}, True),  # of the 2,000 that are looked at
    ],
)
def test_lengths_are_compared_with_the_limit_of_random_episodes(
    lengths: tuple[int, ...], limits: dict[str, int], shown: bool
) -> None:
    settings = config(**{"max_episode_steps": 100} | limits)
    found = episodes(*[(1.0, length) for length in lengths])
    with closing(EpisodeGenerator(settings, 1)) as generator:
        assert choose(settings, ["observe_time"], generator, found).observe_time is shown
