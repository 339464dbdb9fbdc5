"""The cost of a training iteration, and the warning when it takes minutes."""

from typing import Any

import pytest

from udrl.actions import Categorical
from udrl.config import Config, build
from udrl.cost import slow_training_warning, training_s
from udrl.environments import EnvironmentSpec
from udrl.spaces import Image, ObservationSpace, Vector


def spec(space: ObservationSpace) -> EnvironmentSpec:
    return EnvironmentSpec(
        observation_space=space, action_space=Categorical(n=4), max_episode_steps=10
    )


def settings(**values: Any) -> Config:
    return build(Config, {"environment": "X-v0"} | values)


def test_cost_of_a_vector_is_that_of_its_layers() -> None:
    config = settings(hidden=[10, 20], n_updates_per_iter=100, batch_size=50)
    found = training_s(config, spec(Vector(size=3)))
    assert found == pytest.approx(6 * 100 * 50 * (3 * 10 + 10 * 20) / 5e10)


def test_cost_of_an_image_is_that_of_its_convolutions() -> None:
    config = settings(
        convolutions=[8, 16], hidden=[10], n_updates_per_iter=10, batch_size=5, training_threads=2
    )
    first, second = 10 * 8 * 9 * 3 * 8, 5 * 4 * 9 * 8 * 16
    features = 5 * 4 * 16
    found = training_s(config, spec(Image(channels=3, height=20, width=16)))
    expected = 6 * 10 * 5 * (first + second + features * 10) / 5e10 / 2
    assert found == pytest.approx(expected)


@pytest.mark.parametrize(("baseline", "networks"), [("none", 0), ("value", 1), ("action_value", 2)])
def test_cost_includes_every_network(baseline: str, networks: int) -> None:
    config = settings(hidden=[8], baseline=baseline, n_updates_per_iter=1, batch_size=1)
    found = training_s(config, spec(Vector(size=5))) * 5e10 / 6
    assert found == pytest.approx(5 * 8 + networks * (5 * 64 + 64 * 64))


def test_cost_includes_the_memory() -> None:
    config = settings(hidden=[8], memory="gru", memory_size=16, n_updates_per_iter=1, batch_size=1)
    found = training_s(config, spec(Vector(size=5))) * 5e10 / 6
    assert found == pytest.approx(5 * 8 + 3 * 16 * (8 + 16))


def test_large_images_are_warned_of_with_the_remedy() -> None:
    screen = spec(Image(channels=3, height=210, width=160))
    warning = slow_training_warning(settings(), screen)
    assert "every iteration will train for about 12 minutes" in warning
    assert "100 updates of 768 examples of" in warning
    assert """wrappers=["udrl.environments:Downsample(height""" in warning
    assert slow_training_warning(settings(n_updates_per_iter=5), screen) == ""
    assert slow_training_warning(settings(device="cuda"), screen) == ""
    assert slow_training_warning(settings(), spec(Vector(size=8))) == ""
