import pytest

from udrl.config import flat, preset
from udrl.errors import ConfigError
from udrl_experiments.protocol import TASKS, StudyPlan, parse_seeds, tasks


@pytest.mark.parametrize(
    ("text", "seeds"),
    [("1-20", tuple(range(1, 21))), ("7", (7,)), ("1,2,7-9", (1, 2, 7, 8, 9)), ("3-3, 3", (3,))],
)
def test_seeds_are_numbers_and_ranges(text: str, seeds: tuple[int, ...]) -> None:
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize("text", ["", "a", "3-1", "1-", "-1", "1-99999", "1;2", "1.5"])
def test_invalid_seeds_are_rejected(text: str) -> None:
    with pytest.raises(ConfigError, match="--seeds"):
        parse_seeds(text)


def test_papers_scale_has_the_papers_values() -> None:
    plan = StudyPlan("paper")
    assert plan.seeds_of_runs() == tuple(range(1, 21))
    assert {plan.steps(task, "DQN") for task in TASKS.values()} == {10_000_000}
    assert {plan.config(task, 1).evaluation.eval_every for task in TASKS.values()} == {50_000}
    assert {plan.config(task, 1).evaluation.eval_episodes for task in TASKS.values()} == {100}


def test_explicit_values_override_the_scale() -> None:
    plan = StudyPlan("paper", (4, 5), 1000, ("batch_size=64", "eval_every=77"))
    assert plan.seeds_of_runs() == (4, 5)
    assert plan.steps(TASKS["lander"]) == 1000
    config = plan.config(TASKS["lander"], 5, lead=3)
    assert (config.seed, config.lead) == (5, 3)
    assert (config.training.batch_size, config.evaluation.eval_every) == (64, 77)


def test_config_is_the_preset_with_the_protocols_values() -> None:
    for task in TASKS.values():
        config = StudyPlan().config(task, 2)
        expected = preset(task.environment) | {"eval_every": 50_000, "seed": 2}
        del expected["max_env_steps"]
        assert flat(config).items() >= expected.items()


def test_unknown_setting_is_rejected() -> None:
    with pytest.raises(ConfigError, match="bach_size"):
        StudyPlan(assignments=("bach_size=3",)).config(TASKS["lander"], 1)


def test_tasks_are_found_by_name() -> None:
    assert tasks(["sparse", "lander"]) == [TASKS["sparse"], TASKS["lander"]]
    with pytest.raises(ConfigError, match=r"task 'moon': expected one of lander"):
        tasks(["moon"])


@pytest.mark.parametrize("name", ["lead", "seed", "environment"])
def test_settings_of_the_protocol_cannot_be_changed(name: str) -> None:
    with pytest.raises(ConfigError, match=f"--set {name}=...: this study sets {name} itself"):
        StudyPlan(assignments=(f"{name}=1",)).config(TASKS["lander"], 1, lead=2)


def test_assignments_change_defaults_of_the_study() -> None:
    hidden = {"hidden": [8]}
    assert StudyPlan().config(TASKS["lander"], 1, defaults=hidden).network.hidden == (8,)
    plan = StudyPlan(assignments=("hidden=[9]",))
    assert plan.config(TASKS["lander"], 1, defaults=hidden).network.hidden == (9,)


def test_step_counts_may_have_suffixes() -> None:
    config = StudyPlan(assignments=("eval_every=10K",)).config(TASKS["lander"], 1)
    assert config.evaluation.eval_every == 10_000
    with pytest.raises(ConfigError, match="eval_every = 'often': expected a number of steps"):
        StudyPlan(assignments=("eval_every=often",)).config(TASKS["lander"], 1)
