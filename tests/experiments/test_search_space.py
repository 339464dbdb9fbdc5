import math
from pathlib import Path

import numpy as np
import pytest

from udrl.config import Config, build
from udrl.errors import ConfigError
from udrl_experiments.protocol import TASKS, Algorithm
from udrl_experiments.search_space import read_space, shipped_space

ENVIRONMENTS = [task.environment for task in TASKS.values()]
#: Sizes of the paper's search spaces.
ALGORITHMS: tuple[Algorithm, ...] = ("UDRL", "DQN", "A2C")


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_shipped_spaces_have_the_papers_algorithms(environment: str) -> None:
    space = shipped_space(environment)
    assert set(space.lists) == set(ALGORITHMS)
    logarithmic = space.lists["UDRL"]["learning_rate"]
    assert np.allclose(logarithmic, [10 ** (-4 + 2 * i / 100) for i in range(101)], rtol=1e-9)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_configurations_are_from_the_lists_and_cover_them(
    environment: str, algorithm: Algorithm
) -> None:
    space = shipped_space(environment)
    lists = space.networks | space.lists[algorithm]
    drawn = [space.draw(algorithm, number) for number in range(1500)]
    for name, allowed in lists.items():
        found = [one[name] for one in drawn]
        assert all(value in allowed for value in found)
        counts = [found.count(value) for value in allowed]
        expected = len(drawn) / len(allowed)
        assert all(abs(count - expected) < 5 * math.sqrt(expected) for count in counts)
    assert all(set(one) == set(lists) for one in drawn)


def test_configuration_is_a_function_of_its_number() -> None:
    space = shipped_space("LunarLander-v3")
    assert space.draw("DQN", 5) == shipped_space("LunarLander-v3").draw("DQN", 5)
    assert space.draw("DQN", 5) != space.draw("DQN", 6)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_every_configuration_of_udrl_is_valid(environment: str) -> None:
    space = shipped_space(environment)
    for number in range(100):
        build(Config, {"environment": environment} | space.draw("UDRL", number))


def test_space_belongs_to_one_environment(tmp_path: Path) -> None:
    file = tmp_path / "space.toml"
    file.write_text('[UDRL]\nenvironment = ["CartPole-v1"]\n', encoding="utf-8")
    with pytest.raises(ConfigError, match=r"\[UDRL\] environment: .*ENV, 'Acrobot-v1'"):
        read_space("Acrobot-v1", file)


@pytest.mark.parametrize("setting", ["seed", "eval_seeds", "eval_every", "eval_episodes"])
def test_seeds_and_evaluations_are_not_drawn(setting: str, tmp_path: Path) -> None:
    file = tmp_path / "space.toml"
    file.write_text(f"[UDRL]\n{setting} = [1, 2]\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=rf"\[UDRL\] {setting}: .*leave it out"):
        read_space("Acrobot-v1", file)
