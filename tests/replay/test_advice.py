"""Advice for runs that do not learn."""

import re
from collections.abc import Callable

import msgspec
import pytest

from tests.replay.synthetic import finish
from udrl.config import Budget, change
from udrl.setting_groups import NetworkSettings
from udrl_launch.training_run import Adviser
from udrl_proto.reports import IterationStatus
from udrl_replay.advice import advice, cause
from udrl_replay.reporting import Throughput, status
from udrl_replay.run import StoredRun

WARM_UP = IterationStatus(
    iteration=0, commands=50, env_steps=5000, eval_env_steps=0, wall_s=1.0, weights_version=0,
    loss=None, return_min=-40.0, return_mean=-20.0, return_max=10.0, explored_return=-22.0,
    commanded_min=None, commanded_max=None, admitted=50,
)  # fmt: skip
NETWORK = NetworkSettings(return_scale=0.05, horizon_scale=0.01)


@pytest.fixture
def run(make_run: Callable[..., StoredRun]) -> StoredRun:
    made = make_run(max_env_steps=60)
    finish(made)
    made.progress.best_mean = -1.0  # all returns are nonnegative
    return made


def test_advice_is_given_after_a_third_of_the_budget_without_learning(run: StoredRun) -> None:
    text = advice(run)
    assert text.startswith(
        "the run does not learn: its best evaluation is -1.0, the warm-up's mean"
    )
    assert text.endswith("See 'Signs of trouble' on the documentation's page on metrics")
    assert status(run, Throughput(), 0.0, 0.0).advice == text
    run.budget = Budget(max_env_steps=3 * run.progress.env_steps + 1)
    assert advice(run) == ""


@pytest.mark.parametrize("best", [None, 100.0])
def test_there_is_no_advice_without_evaluation_or_with_a_good_one(
    run: StoredRun, best: float | None
) -> None:
    run.progress.best_mean = best
    assert advice(run) == ""


@pytest.mark.parametrize(
    ("network", "warm_up", "expected"),
    [
        ({}, {}, "too little data: give it more env steps"),
        ({"return_scale": 0.001}, {}, "return_scale = 0.001: it scales the warm-up's typical "
         "returns of 22 to 0.022, but the network needs values around 1; try return_scale = auto"),
        ({"return_scale": 1.0}, {},
         "return_scale = 1: it scales the warm-up's typical returns of 22 to 22"),
        ({"horizon_scale": 0.5}, {},
         "horizon_scale = 0.5: it scales the warm-up's typical lengths of 100 to 50"),
        # Positive and negative returns that cancel out are not small.
        ({}, {"explored_return": 0.0}, "too little data: give it more env steps"),
        ({}, {"return_min": 0.0, "return_max": 0.0, "explored_return": 0.0},
         "too little data: all warm-up episodes have the same return"),
        # A buffer that holds only the best of a thousand episodes may have equal returns.
        ({}, {"return_min": 1.0, "return_max": 1.0, "explored_return": 0.1},
         "return_scale = 0.05: it scales the warm-up's typical returns of 0.1 to 0.005"),
    ],
)  # fmt: skip
def test_most_likely_cause(
    network: dict[str, float], warm_up: dict[str, float], expected: str
) -> None:
    found = cause(
        msgspec.structs.replace(NETWORK, **network), msgspec.structs.replace(WARM_UP, **warm_up)
    )
    assert found.startswith(expected)


@pytest.mark.parametrize(
    ("network", "warm_up", "expected"),
    [
        ({}, {}, "more env steps (--max-env-steps), a dataset with more or better episodes or"),
        ({}, {"return_min": 0.0, "return_max": 0.0, "explored_return": 0.0},
         "all episodes of the dataset have the same return, so there are no better ones to learn "
         "from; start with a dataset that has better ones, too"),
        ({"return_scale": 0.001}, {}, "it scales the dataset's typical returns of 22 to"),
    ],
)  # fmt: skip
def test_advice_for_a_run_with_a_dataset_does_not_name_the_warm_up(
    network: dict[str, float], warm_up: dict[str, float], expected: str, run: StoredRun
) -> None:
    found = cause(
        msgspec.structs.replace(NETWORK, **network),
        msgspec.structs.replace(WARM_UP, **warm_up),
        has_dataset=True,
    )
    assert expected in found
    run.config = change(run.config, dataset="mine-v0")
    assert "the dataset's mean return" in advice(run)
    for text in (found, advice(run)):
        assert not re.search(r"warm.up", text)


def test_advice_is_logged_once(run: StoredRun, caplog: pytest.LogCaptureFixture) -> None:
    adviser = Adviser()
    for _ in range(3):
        adviser.show(status(run, Throughput(), 0.0, 0.0))
    assert [(r.levelname, r.message) for r in caplog.records if "learn" in r.message] == [
        ("WARNING", advice(run))
    ]
