"""A run is a function of its configuration and seed."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from udrl.config import Config
from udrl_proto.reports import Status
from whole_run import digests, reference, small, toy

Runner = Callable[..., Status]

CASES = [
    (small, 3000),
    (toy, 300),
    (partial(small, n_episodes_per_iter=2, n_steps_per_iter=300, last_few=2), 3000),
    (partial(small, baseline="value", guidance_kl=0.05, reset_every=4), 2000),
]


@pytest.mark.parametrize(("make", "budget"), CASES)
def test_services_at_lead_0_equal_the_reference(
    make: Callable[..., Config], budget: int, run: Runner
) -> None:
    expected = reference(make(lead=0), budget)
    status = run(make(lead=0), budget)
    assert digests(status) == digests(expected)
    assert status.env_steps == expected.env_steps
    assert status.evaluation is not None
    assert status.evaluation.mean == expected.evaluations[status.evaluation.iteration].mean


@pytest.mark.parametrize(
    "lead", [pytest.param(0, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.slow), 3]
)
@pytest.mark.parametrize(("make", "budget"), CASES)
def test_result_is_independent_of_actors_and_environments(
    make: Callable[..., Config], budget: int, lead: int, run: Runner
) -> None:
    results = [
        run(make(lead=lead), budget, actors=actors, envs=envs)
        for actors, envs in [(1, 16), (2, 3), (4, 20)]
    ]
    assert len({digests(status) for status in results}) == 1
    assert all(status.exact for status in results)


def test_separate_processes_equal_one_process(run: Runner) -> None:
    config = small(lead=1)
    apart = run(config, 4000, actors=2, in_process=False)
    assert digests(apart) == digests(run(config, 4000))


def test_another_seed_gives_another_result(run: Runner) -> None:
    assert digests(run(toy(), 300)) != digests(run(toy(seed=2), 300))


@pytest.mark.parametrize("lead", [0, 2])
def test_resumed_run_equals_an_uninterrupted_one(lead: int, run: Runner, tmp_path: Path) -> None:
    config, run_dir = small(lead=lead), tmp_path / "short"
    first = run(config, 2000, run_dir=run_dir)
    longer = run(config, 4000, run_dir=run_dir, resume=True)
    straight = run(config, 4000)
    assert first.iteration < longer.iteration
    assert digests(longer) == digests(straight)
    assert longer.eval_env_steps > straight.eval_env_steps  # its final evaluation ran twice


def test_resuming_an_ended_run_with_the_same_budget_changes_nothing(
    run: Runner, tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    first = run(toy(), 300, run_dir=run_dir)
    again = run(toy(), 300, run_dir=run_dir, resume=True)
    assert digests(again) == digests(first)
    assert again.commands == first.commands
    assert again.final_evaluation == first.final_evaluation
