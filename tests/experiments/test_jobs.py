from typing import Any

import msgspec
import pytest

from tests.experiments.finished_runs import CONFIG, job
from udrl.config import KeywordValue, change, flat
from udrl.errors import ConfigError
from udrl_experiments.jobs import Job, make_job, merge_jobs


def test_runs_of_equal_settings_share_a_folder() -> None:
    planned = [job(100), job(50, "short"), job(300, "long"), job(10, seed=2)]
    assert [(one.config.seed, one.max_env_steps) for one in merge_jobs(planned)] == [
        (1, 300),
        (2, 10),
    ]


@pytest.mark.parametrize("change", [{"seed": 2}, {"lead": 1}, {"environment": "Acrobot-v1"}])
def test_other_settings_give_another_folder(change: dict[str, Any]) -> None:
    assert job(**change).name != job().name


def test_names_do_not_depend_on_defaults() -> None:
    settings = {name: v for name, v in flat(CONFIG).items() if name != "advantage_bound"}
    before = Job(algorithm="UDRL", settings=settings, max_env_steps=1)
    after = Job(algorithm="UDRL", settings=flat(CONFIG), max_env_steps=1)
    assert before.name == after.name
    assert job().name == "udrl-cartpole-v1-seed1-9b61e2eb49be"


def test_dqn_explores_for_a_share_of_the_run_by_default_too() -> None:
    short, long = (
        make_job("DQN", CONFIG, n, hyperparameters={"gamma": 0.98}) for n in (100_000, 1_000_000)
    )
    assert (short.exploration_steps, long.exploration_steps) == (10_000, 100_000)
    assert short.name != long.name
    assert make_job("A2C", CONFIG, 100_000).exploration_steps == 0


def test_baselines_do_not_depend_on_udrls_settings() -> None:
    other = change(CONFIG, last_few=7, lead=3, command_strategy="record", batch_size=9)
    assert make_job("A2C", other, 1) == make_job("A2C", CONFIG, 1)
    shared = make_job("A2C", change(CONFIG, hidden=[8], seed=3), 1).config
    assert (shared.network.hidden, shared.seed, shared.environment) == ((8,), 3, "CartPole-v1")


@pytest.mark.parametrize(
    ("hyperparameters", "message"),
    [
        ({"rms_prop_decay": 0.9}, "unknown hyperparameter 'rms_prop_decay' of DQN.*batch_size"),
        ({"gamma": 1.5}, "gamma = 1.5"),
        ({"activation": "step"}, "activation = 'step'"),
    ],
)
def test_invalid_hyperparameters_are_rejected(
    hyperparameters: dict[str, KeywordValue], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        make_job("DQN", CONFIG, 1, hyperparameters=hyperparameters)


def test_other_hyperparameters_give_another_folder() -> None:
    dqn = Job(algorithm="DQN", settings=flat(CONFIG), max_env_steps=1)
    other = msgspec.structs.replace(dqn, hyperparameters={"gamma": 0.9})
    assert len({job().name, dqn.name, other.name}) == 3
