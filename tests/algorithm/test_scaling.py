"""Scales that are left open are settled by random episodes."""

from typing import Any

import numpy as np
import pytest

from udrl.acting import EpisodeGenerator
from udrl.algorithm1 import algorithm1
from udrl.config import Budget, Config, build
from udrl.episode import Episode
from udrl.errors import ConfigError
from udrl.graph import acting_graph
from udrl.scaling import settle_scales

OPEN = {"return_scale": "auto", "horizon_scale": "auto"}


def config(**values: Any) -> Config:
    return build(Config, {"environment": "CartPole-v1", "hidden": [8]} | OPEN | values)


def episodes(*returns_and_lengths: tuple[float, int]) -> list[Episode]:
    return [
        Episode(
            command_id=i,
            observations=np.zeros((n, 4), np.float32),
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
    generator = EpisodeGenerator(config(), 1)
    assert settle_scales(config(), generator, episodes(*found)).network.scales == scales


def test_what_is_given_stays() -> None:
    generator = EpisodeGenerator(config(), 1)
    assert settle_scales(config(return_scale=0.5, horizon_scale=0.5), generator) == config(
        return_scale=0.5, horizon_scale=0.5
    )
    half = settle_scales(config(return_scale=0.5), generator)
    assert half.network.return_scale == 0.5
    assert half.network.scales[1] > 0


def test_they_do_not_depend_on_how_many_environments_there_are() -> None:
    settled = [settle_scales(config(), EpisodeGenerator(config(), n)) for n in (1, 7)]
    assert settled[0] == settled[1]
    assert 0.01 < settled[0].network.scales[0] < 0.1


def test_open_scales_cannot_be_computed_with() -> None:
    with pytest.raises(ConfigError, match=r"'auto' is settled when a run is created"):
        acting_graph(config().network, EpisodeGenerator(config(), 1).spec)


def test_algorithm_1_settles_them() -> None:
    small = {"n_warm_up_episodes": 4, "n_episodes_per_iter": 2, "n_updates_per_iter": 2,
             "batch_size": 16, "replay_size": 10, "last_few": 2}  # fmt: skip
    left_open = config(**small)
    given = settle_scales(left_open, EpisodeGenerator(left_open, 1))
    budget = Budget(max_env_steps=300)
    assert algorithm1(left_open, budget).weights_sha256 == algorithm1(given, budget).weights_sha256
