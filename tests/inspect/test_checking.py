"""``udrl check``."""

import json
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from gymnasium import spaces

from tests.foreign.conventions import Plain, ResetsToObservation, register
from tests.foreign.test_determinism import Unseeded
from udrl.config import Config, build
from udrl.errors import ConfigError, EnvironmentFault, UnsupportedEnvironment
from udrl_inspect.checking import check_environment
from udrl_launch.cli import cli


def checked(kind: type[Plain], **settings: Any) -> Any:
    return check_environment(
        build(Config, {"environment": register(kind), "return_scale": 0.3} | settings)
    )


def test_report_on_an_environment() -> None:
    found = checked(Plain, horizon_scale=0.1)
    assert found.repeats
    assert (found.max_episode_steps, found.length_mean, found.episodes) == (50, 10.0, 20)
    assert 0 <= found.return_min <= found.return_mean <= found.return_max <= 10
    assert found.declared_observations == "Box(-inf, inf, (2,), float32)"
    assert found.observations == "Vector(size=2)"
    assert found.step_bytes == 2 * 4 + 1 + 4
    assert found.step_s > 0
    assert found.advice == ()


def test_unusual_environment_gets_advice() -> None:
    class Poor(Unseeded):
        def pay(self, action: Any) -> float:
            return 0.0

        def over(self) -> bool:
            return False

    advice = " ".join(checked(Poor, horizon_scale=1e-4).advice)
    for part in (
        "Episodes cannot be repeated from their seeds",
        "All random episodes return 0",
        "All random episodes reach the limit of 50 steps. A lower max_train_steps",
        "horizon_scale = 0.0001 scales values of about 50 to inputs of about 0.005",
    ):
        assert part in advice


@pytest.mark.parametrize(("brightest", "is_advised"), [(10, True), (200, False)])
def test_images_of_indices_get_advice(brightest: int, is_advised: bool) -> None:
    class Grid(Plain):
        observation_space = spaces.Dict(
            grid=spaces.Box(0, 255, (7, 7, 3), np.uint8), place=spaces.Discrete(3)
        )

        def seen(self) -> Any:
            return {"grid": np.full((7, 7, 3), brightest, np.uint8), "place": 1}

    advice = " ".join(checked(Grid, horizon_scale=0.1).advice)
    assert ("observation['grid'] never exceeds 10 of 255" in advice) == is_advised
    assert ("FlattenObservation" in advice) == is_advised


def test_findings_of_gymnasiums_checker_are_advice() -> None:
    class Outside(Plain):
        observation_space = spaces.Box(0, 1, (2,), np.float32)

    assert any("Gymnasium's checker" in sentence for sentence in checked(Outside).advice)


def test_unsupported_environment_is_rejected() -> None:
    with pytest.raises(EnvironmentFault, match=r"reset\(\) returned an array"):
        checked(ResetsToObservation)
    with pytest.raises(UnsupportedEnvironment, match="no step limit"):
        check_environment(build(Config, {"environment": register(Plain, max_steps=None)}))


def test_strategy_that_cannot_be_created_is_refused() -> None:
    with pytest.raises(ConfigError, match="max_return is neither set nor declared"):
        checked(Plain, command_strategy="maximum")


def test_command_checks_the_settings_of_a_preset() -> None:
    arguments = ["check", "MountainCar-v0", "--preset", "CartPole-v1", "--set", "seed=3"]
    result = CliRunner().invoke(cli, arguments, standalone_mode=False)
    train = "udrl train MountainCar-v0 --preset CartPole-v1 --set=seed=3"
    assert f"verdict       supported; train with: {train}" in result.stdout
    assert "settings " not in result.stdout, "a preset leaves nothing to choose"


def test_command_prints_lines_or_json() -> None:
    result = CliRunner().invoke(cli, ["check", "CartPole-v1"], standalone_mode=False)
    assert "reproducible  yes, from its seed" in result.stdout
    assert "verdict       supported; train with: udrl train CartPole-v1" in result.stdout
    result = CliRunner().invoke(cli, ["check", "CartPole-v1", "--json"], standalone_mode=False)
    assert json.loads(result.stdout)["max_episode_steps"] == 500
    result = CliRunner().invoke(cli, ["check", "MountainCar-v0"], standalone_mode=False)
    chosen = "action_mask = unset, baseline = value, guidance_kl = 0.0, hold_rate = 0.05"
    assert f"settings      {chosen}" in result.stdout
    assert (
        "All random episodes return" not in result.stdout
    )  # with actions held for 32 steps, some episodes succeed


def test_automatic_settings_are_chosen_and_listed() -> None:
    config = build(Config, {"environment": "FrozenLake-v1"})
    chosen = check_environment(config, ("baseline", "n_warm_up_episodes", "horizon_scale")).chosen
    assert chosen["baseline"] == "action_value"
    assert chosen["horizon_scale"] == 0
    assert int(chosen["n_warm_up_episodes"] or 0) > 300
