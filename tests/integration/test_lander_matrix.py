"""Determinism on LunarLander: equal digests for all fleets, kills and interruptions."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from udrl_proto.reports import Status
from whole_run import (
    LANDER,
    Cli,
    arguments,
    assert_conserved,
    digests,
    kill_at,
    lander,
    reference,
)

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

BUDGET = 20_000
LEADS = (0, 1, 3)

Runner = Callable[..., Status]


@pytest.fixture(scope="module")
def expected() -> dict[int, Any]:
    """Digests, by lead, of the undisturbed run with one actor in one process."""
    return {}


@pytest.fixture
def check_digests(expected: dict[int, Any], run: Runner) -> Callable[[int, Status], None]:
    def check(lead: int, status: Status) -> None:
        if lead not in expected:
            expected[lead] = digests(run(lander(lead=lead), BUDGET))
        assert_conserved(status)
        assert status.exact
        assert digests(status) == expected[lead]

    return check


Same = Callable[[int, Status], None]


def test_reference_equals_the_services_at_lead_0(run: Runner) -> None:
    assert digests(reference(lander(lead=0), BUDGET)) == digests(run(lander(lead=0), BUDGET))


@pytest.mark.parametrize("lead", LEADS)
@pytest.mark.parametrize(
    ("actors", "envs", "in_process"), [(2, 16, False), (4, 3, True), (1, 40, True)]
)
def test_result_is_independent_of_the_fleet(
    lead: int, actors: int, envs: int, in_process: bool, run: Runner, check_digests: Same
) -> None:
    config = lander(lead=lead)
    check_digests(lead, run(config, BUDGET, actors=actors, envs=envs, in_process=in_process))


@pytest.mark.parametrize("lead", LEADS)
def test_result_is_independent_of_kills(
    lead: int, cli: Callable[..., Cli], check_digests: Same, tmp_path: Path
) -> None:
    run_dir = tmp_path / "killed"
    process = cli(*arguments(LANDER | {"lead": lead}, BUDGET, run_dir), "--actors", "1")
    for role, iteration in [("actor", 1), ("learner", 3), ("replay", 5), ("actor", 7)]:
        kill_at(process, run_dir, role, iteration)
    check_digests(lead, process.status(timeout=120))


@pytest.mark.parametrize("lead", LEADS)
def test_result_is_independent_of_interruptions(
    lead: int, run: Runner, check_digests: Same, tmp_path: Path
) -> None:
    config, run_dir = lander(lead=lead), tmp_path / "stopped"
    run(config, 6_000, run_dir=run_dir)
    run(config, 12_000, run_dir=run_dir, resume=True, actors=2)
    check_digests(lead, run(config, BUDGET, run_dir=run_dir, resume=True))
