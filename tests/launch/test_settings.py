"""Precedence of settings: preset, file, options, ``--set``."""

from pathlib import Path

import pytest

from udrl.config import AUTOMATIC, preset, preset_names
from udrl.errors import ConfigError
from udrl_launch.settings import gather
from udrl_launch.subcommands.train_command import warn_of_idle_environments
from udrl_replay.creation import write_config


def test_preset_of_the_environment_is_the_default() -> None:
    settings = gather("CartPole-v1", options={})
    assert settings.config.training.batch_size == preset("CartPole-v1")["batch_size"]
    assert settings.budget.max_env_steps == preset("CartPole-v1")["max_env_steps"]


def test_unknown_strategy_is_refused_before_an_environment_is_made() -> None:
    for name, message in (("own", "expected uniform, ranked"), ("not.there:Own", "PYTHONPATH")):
        with pytest.raises(ConfigError, match=message):
            gather("NoSuchEnvironment-v0", options={"command_strategy": name})


def test_another_preset_can_be_selected() -> None:
    settings = gather("LunarLander-v3", preset_name="CartPole-v1", options={})
    assert settings.config.environment == "LunarLander-v3"
    assert settings.config.buffer.replay_size == preset("CartPole-v1")["replay_size"]


def test_preset_in_place_of_the_environment_is_refused() -> None:
    with pytest.raises(ConfigError, match="use LunarLander-v3 --preset LunarLander-v3-fleet"):
        gather("LunarLander-v3-fleet", options={})


def test_environment_without_preset_gets_the_generic_one() -> None:
    settings = gather("Figure2-v0", options={})
    assert settings.automatic == AUTOMATIC.keys()
    assert settings.config.training.batch_size == preset("any")["batch_size"]
    assert gather("Figure2-v0", preset_name="none", options={}).automatic == frozenset()


def test_setting_is_automatic_or_has_a_value() -> None:
    settings = gather(
        "Figure2-v0", options={"return_scale": 0.5}, assignments=["warm_up_hold_steps=4"]
    )
    assert settings.automatic == AUTOMATIC.keys() - {"return_scale", "warm_up_hold_steps"}
    assert settings.config.network.return_scale == 0.5
    assert gather("CartPole-v1", options={}, assignments=["warm_up_hold_steps=auto"]).automatic == {
        "warm_up_hold_steps"
    }


def test_all_segments_exclude_a_baseline() -> None:
    settings = gather("Figure2-v0", options={"segments": "all"})
    assert settings.config.network.baseline == "none"
    assert "baseline" in settings.automatic


def test_existing_run_keeps_its_automatic_settings() -> None:
    stored = {"return_scale": 0.5, "last_few": 4}
    settings = gather("Figure2-v0", stored=stored, options={}, assignments=["return_scale=auto"])
    assert settings.automatic == frozenset()
    assert settings.config.network.return_scale == 0.5


def test_only_some_settings_can_be_automatic() -> None:
    with pytest.raises(ConfigError, match=r"batch_size = 'auto'"):
        gather("Figure2-v0", options={}, assignments=["batch_size=auto"])


def test_each_source_overrides_the_previous_one(tmp_path: Path) -> None:
    file = tmp_path / "settings.toml"
    file.write_text("seed = 2\nlead = 2\nbatch_size = 2\nactors = 3\n")
    settings = gather(
        "CartPole-v1", file=file, options={"seed": 3, "lead": 3, "eval_every": None},
        assignments=["seed=4"],
    )  # fmt: skip
    config = settings.config
    assert (config.training.batch_size, config.lead, config.seed) == (2, 3, 4)
    assert config.evaluation.eval_every == preset("CartPole-v1")["eval_every"]
    assert settings.fleet.actors == 3


def test_stored_settings_replace_the_preset() -> None:
    settings = gather("CartPole-v1", stored={"batch_size": 5}, options={})
    assert settings.config.training.batch_size == 5
    assert settings.config.network.hidden != tuple(preset("CartPole-v1")["hidden"])


def test_file_of_another_environment_is_rejected(tmp_path: Path) -> None:
    file = tmp_path / "settings.toml"
    file.write_text('environment = "Acrobot-v1"\n')
    with pytest.raises(ConfigError, match=r"'Acrobot-v1' in .*, but ENV is 'CartPole-v1'"):
        gather("CartPole-v1", file=file, options={})


@pytest.mark.parametrize("name", ["actor", "max_steps", "envs"])
def test_unknown_setting_is_rejected(name: str) -> None:
    with pytest.raises(ConfigError, match=f"unknown setting '{name}'"):
        gather("CartPole-v1", options={name: 1})


@pytest.mark.parametrize(
    ("idle", "needed"),
    [
        ("hold_steps=9", "hold_share=0.5"),
        ("return_lambda=0.5", "baseline=value"),
        ("dataset_sha256=00", "dataset=some/thing-v0"),
        ("training_threads=2", "device=cpu"),
    ],
)
def test_ineffective_setting_is_rejected(idle: str, needed: str) -> None:
    name = idle.partition("=")[0]
    without = ["device=cuda"] if name == "training_threads" else []
    with pytest.raises(
        ConfigError, match=rf"^{name} = .* has no effect: it needs .*; leave it out"
    ):
        gather("Figure2-v0", preset_name="none", options={}, assignments=[*without, idle])
    gather("Figure2-v0", preset_name="none", options={}, assignments=[idle, needed])


def test_written_configuration_is_complete_without_its_preset(tmp_path: Path) -> None:
    assigned = ["max_age=unset", "environment_kwargs={}", "keep_versions=unset"]
    written = gather("Figure2-v0", preset_name="CartPole-v1", options={}, assignments=assigned)
    write_config(tmp_path, written.config, written.budget)
    again = gather("Figure2-v0", file=tmp_path / "config.toml", options={})
    assert again == written
    assert again.config.buffer.max_age is None  # and not chosen, as the preset "any" asks for


def test_ineffective_setting_of_a_file_is_accepted(tmp_path: Path) -> None:
    file = tmp_path / "config.toml"
    file.write_text("hold_steps = 9\n")
    assert gather("Figure2-v0", file=file, options={}).config.commands.hold_steps == 9


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, 16),
        ({"actors": 0}, 16),
        ({"actors": 10}, 10),  # 100 episodes of an evaluation beside 2 others
        ({"actors": 3, "eval_episodes": 4, "n_warm_up_episodes": 5}, 2),
        ({"actors": 500}, 1),
        ({"actors": 500, "envs_per_actor": 30}, 30),
    ],
)
def test_actors_have_environments_for_all_concurrent_episodes(
    options: dict[str, int], expected: int
) -> None:
    assert gather("CartPole-v1", options=options).envs_per_actor == expected


@pytest.mark.parametrize("environment", preset_names())
def test_presets_cause_no_warning(environment: str, caplog: pytest.LogCaptureFixture) -> None:
    warn_of_idle_environments(gather("Figure2-v0", preset_name=environment, options={}))
    assert not caplog.records


def test_unused_environments_are_warned_of(
    caplog: pytest.LogCaptureFixture,
) -> None:
    warn_of_idle_environments(gather("CartPole-v1", options={"envs_per_actor": 16}))
    assert "32 environments, but at most 2 episodes can run at once" in caplog.text


@pytest.mark.parametrize(
    ("given", "steps"), [("3M", 3_000_000), ("1e5", 100_000), (1e5, 100_000), (250, 250)]
)
def test_step_counts_may_have_suffixes(given: object, steps: int) -> None:
    settings = gather("CartPole-v1", options={"max_env_steps": given, "eval_every": given})
    assert settings.budget.max_env_steps == steps
    assert settings.config.evaluation.eval_every == steps
    assigned = gather("CartPole-v1", options={}, assignments=[f"max_env_steps={given}"])
    assert assigned.budget.max_env_steps == steps


@pytest.mark.parametrize("given", ["many", 1.5, "0.1"])
def test_invalid_step_count_is_rejected(given: object) -> None:
    with pytest.raises(ConfigError, match=f"max_env_steps = '?{given}"):
        gather("CartPole-v1", options={"max_env_steps": given})
