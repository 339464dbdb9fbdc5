import sys
from collections import Counter
from collections.abc import Sequence
from math import floor, sqrt
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from udrl.actions import Categorical
from udrl.commands import CommandSampler
from udrl.config import Config, build
from udrl.environments import EnvironmentSpec
from udrl.errors import ConfigError
from udrl.replay_buffer import Entry, ReplayBuffer
from udrl.spaces import Vector
from udrl.strategies import STRATEGIES, choose_command, make_strategy

BEST = st.lists(st.tuples(st.floats(-500, 500), st.integers(1, 1000)), min_size=1, max_size=8).map(
    lambda rows: sorted(Entry(r, i, n) for i, (r, n) in enumerate(rows))
)
U = st.floats(0, 1, exclude_max=True)


def config(**values: Any) -> Config:
    return build(Config, {"environment": "CartPole-v1"} | values)


def strategy(name: str) -> Any:
    return make_strategy(config(command_strategy=name, max_return=500.0))


@given(BEST, U)
def test_uniform_draws_returns_from_m_to_m_plus_s_with_the_mean_length(
    best: list[Entry], u: float
) -> None:
    n = len(best)
    m = sum(e.episode_return for e in best) / n
    s = sqrt(sum((e.episode_return - m) ** 2 for e in best) / n)
    desired_return, horizon = strategy("uniform")(best, u)
    assert desired_return == pytest.approx(m + u * s, rel=1e-9, abs=1e-6)
    assert horizon == floor(sum(e.length for e in best) / n + 0.5)


@given(BEST)
def test_ranked_draws_one_of_the_k_best_with_probability_sqrt_k_of_n(best: list[Entry]) -> None:
    n, tries = len(best), 1_000
    ranked = strategy("ranked")
    drawn = Counter(ranked(best, (i + 0.5) / tries) for i in range(tries))
    for k in range(1, n + 1):
        kept = {(e.episode_return, e.length) for e in best[n - k :]}
        others = {(e.episode_return, e.length) for e in best[: n - k]}
        if not kept & others:
            share = sum(drawn[one] for one in kept) / tries
            assert abs(share - sqrt(k / n)) < 2 / tries


@given(BEST, U)
def test_maximum_commands_the_greatest_return_with_the_mean_length(
    best: list[Entry], u: float
) -> None:
    assert strategy("maximum")(best, u) == (500.0, strategy("uniform")(best, u)[1])


def test_maximum_commands_what_the_environment_declares() -> None:
    spec = msgspec.structs.replace(SPEC, max_return=8.0)
    sampler = CommandSampler(config(command_strategy="maximum"), spec)
    assert {c.desired_return for c in sampler.explore(1, buffer())} == {8.0}


def test_large_returns_are_commanded() -> None:
    best = [Entry(8e9, 1, 3)]
    assert choose_command(strategy("uniform"), best, 0.5) == (8e9, 3)


def test_maximum_requires_a_greatest_return() -> None:
    with pytest.raises(ConfigError, match=r"is neither set nor declared .*; set it, e\.g\. --set"):
        make_strategy(config(command_strategy="maximum"))


@pytest.mark.parametrize("name", STRATEGIES)
def test_strategy_is_a_function_of_its_arguments(name: str) -> None:
    best = [Entry(float(n), n, n + 1) for n in range(10)]
    first = [strategy(name)(best, u / 7) for u in range(7)]
    again = strategy(name)
    assert [again(best, u / 7) for u in range(7)][::-1] == first[::-1]


@pytest.fixture
def custom_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "own_strategies.py").write_text(
        "class Patient:\n"
        "    def __init__(self, config):\n"
        "        self.seed = config.seed\n"
        "    def __call__(self, best, u):\n"
        "        return best[0].episode_return + self.seed, 2 * best[-1].length\n"
        "class Broken(Patient):\n"
        "    def __call__(self, best, u):\n"
        "        return 1 / 0\n"
        "class Needy:\n"
        "    pass\n",
        encoding="utf-8",
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own_strategies", raising=False)
    return "own_strategies"


SPEC = EnvironmentSpec(
    observation_space=Vector(size=4), action_space=Categorical(n=2), max_episode_steps=500
)


def buffer() -> ReplayBuffer:
    return ReplayBuffer(config().buffer, [Entry(1.0, 1, 10), Entry(5.0, 2, 20)])


def test_custom_strategy_is_named_by_module_and_class(custom_module: str) -> None:
    sampler = CommandSampler(config(command_strategy=f"{custom_module}:Patient", seed=9), SPEC)
    commands = sampler.explore(1, buffer())
    assert {(c.desired_return, c.desired_horizon) for c in commands} == {(10.0, 40)}


def test_evaluation_commands_do_not_use_the_strategy() -> None:
    sampler = CommandSampler(config(command_strategy="not.there:Missing"), SPEC)
    assert {(c.desired_return, c.desired_horizon) for c in sampler.evaluate(1, buffer())} == {
        (3.0, 15)
    }


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("cautious", r"expected uniform, ranked, maximum, or a class of your own"),
        ("not.there:Missing", r"ModuleNotFoundError.*PYTHONPATH"),
        ("udrl.strategies:Missing", "AttributeError"),
    ],
)
def test_strategy_that_fails_to_import_is_rejected(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        strategy(name)


def test_strategy_that_cannot_be_constructed_is_rejected(custom_module: str) -> None:
    with pytest.raises(ConfigError, match=r"own_strategies:Needy.*TypeError"):
        strategy(f"{custom_module}:Needy")


def test_exception_of_a_strategy_is_reported(custom_module: str) -> None:
    with pytest.raises(ConfigError, match="Broken failed: ZeroDivisionError"):
        choose_command(strategy(f"{custom_module}:Broken"), [Entry(1.0, 1, 1)], 0.5)


@pytest.mark.parametrize(
    "desired",
    [(float("nan"), 3), (float("inf"), 3), (1e300, 3), (1.0, 2**31), None, (1.0,), ("a lot", 3)],
)
def test_invalid_desired_return_is_rejected(desired: Any) -> None:
    class Odd:
        def __init__(self, config: Config) -> None:
            pass

        def __call__(self, best: Sequence[Entry], u: float) -> Any:
            return desired

    with pytest.raises(ConfigError, match="Odd"):
        choose_command(Odd(config()), [Entry(1.0, 1, 1)], 0.5)


@pytest.mark.parametrize(("horizon", "expected"), [(0, 1), (-5, 1), (2.9, 2)])
def test_horizon_is_truncated_to_a_whole_number_of_at_least_one(
    horizon: float, expected: int
) -> None:
    class Odd:
        def __init__(self, config: Config) -> None:
            pass

        def __call__(self, best: Sequence[Entry], u: float) -> Any:
            return 1.0, horizon

    assert choose_command(Odd(config()), [Entry(1.0, 1, 1)], 0.5) == (1.0, expected)
