import math
import re
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given

from tests.proto.strategies import configs
from udrl.config import (
    AUTOMATIC,
    Budget,
    Config,
    build,
    change,
    flat,
    parse_assignment,
    preset,
    preset_names,
    read_toml,
    refuse_unknown,
    setting_names,
)
from udrl.errors import ConfigError
from udrl.setting_groups import BufferSettings

TABLE_2 = {
    "batch_size",
    "horizon_scale",
    "last_few",
    "learning_rate",
    "n_episodes_per_iter",
    "n_updates_per_iter",
    "n_warm_up_episodes",
    "replay_size",
    "return_scale",
}


def test_hyperparameters_are_named_as_in_table_2() -> None:
    assert set(setting_names(Config)) >= TABLE_2


@given(configs())
def test_settings_are_grouped_in_python_and_flat_in_files(config: Config) -> None:
    values = flat(config)
    assert tuple(values) == setting_names(Config)
    assert build(Config, values) == config
    assert build(Config, msgspec.json.decode(msgspec.json.encode(values))) == config


def test_setting_names_are_unique() -> None:
    kinds = (Config, Budget)
    names = [name for kind in kinds for name in setting_names(kind)]
    assert len(names) == len(set(names))


def test_group_names_are_not_accepted_from_outside() -> None:
    with pytest.raises(ConfigError, match="unknown setting 'training'"):
        build(Config, {"environment": "CartPole-v1", "training": {"batch_size": 512}})


def test_settings_of_any_group_are_changed_by_name() -> None:
    config = build(Config, {"environment": "CartPole-v1", "hidden": [8], "batch_size": 2})
    changed = change(config, batch_size=3, hidden=(4, 4), seed=5)
    assert flat(changed) == flat(config) | {"batch_size": 3, "hidden": [4, 4], "seed": 5}
    assert config.training.batch_size == 2


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        ({"bach_size": 1}, r"'bach_size': did you mean 'batch_size'\?"),
        ({"batch_size": 0}, r"^batch_size = 0: "),
        ({"last_few": 501}, r"^last_few = 501: expected at most replay_size = 500"),
        ({"segments": "all", "baseline": "value"}, r"^segments = 'all' with baseline = 'value'"),
    ],
)
def test_invalid_change_is_rejected(values: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        change(Config(environment="CartPole-v1"), **values)


def test_rules_across_groups_are_checked_on_every_construction() -> None:
    with pytest.raises(ConfigError, match="last_few = 75: expected at most replay_size = 10"):
        Config(environment="CartPole-v1", buffer=BufferSettings(replay_size=10))


def test_values_are_converted_to_the_types_of_the_fields() -> None:
    config = build(Config, {"environment": "CartPole-v1", "hidden": [8, 16], "learning_rate": 1})
    assert config.network.hidden == (8, 16)
    assert config.training.learning_rate == 1.0


def test_unset_is_none_for_optional_settings_only() -> None:
    limited = build(Config, {"environment": "CartPole-v1", "max_age": 3, "max_return": 1.0})
    unlimited = change(limited, max_age="unset", max_return="unset")
    assert (unlimited.buffer.max_age, unlimited.max_return) == (None, None)
    with pytest.raises(ConfigError, match=r"^batch_size = 'unset': "):
        change(limited, batch_size="unset")


def test_environment_is_required() -> None:
    with pytest.raises(ConfigError, match="environment"):
        build(Config, {"seed": 1})


def test_unknown_name_is_rejected_with_the_closest_match() -> None:
    with pytest.raises(ConfigError, match=r"'bach_size': did you mean 'batch_size'\?"):
        build(Config, {"environment": "CartPole-v1", "bach_size": 512})


def test_unknown_name_without_a_close_match_is_rejected_with_all_names() -> None:
    with pytest.raises(ConfigError, match=r"'xyzzy': expected one of one, two"):
        refuse_unknown({"xyzzy": 1}, ("one", "two"))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("batch_size", 0),
        ("batch_size", -1),
        ("batch_size", 1.5),
        ("batch_size", "many"),
        ("batch_size", True),
        ("environment", ""),
        ("environment_kwargs", {"gravity": math.nan}),
        ("environment_kwargs", {"wind": None}),
        ("eval_episodes", 0),
        ("eval_every", 0),
        ("eval_temperature", "low"),
        ("hidden", []),
        ("hidden", [32, 0]),
        ("hidden", 32),
        ("horizon_scale", -0.1),
        ("initialisation", "zeros"),
        ("lead", -1),
        ("learning_rate", 0.0),
        ("learning_rate", math.inf),
        ("learning_rate", math.nan),
        ("max_episode_steps", 0),
        ("max_return", -math.inf),
        ("max_return", math.nan),
        ("n_warm_up_episodes", 0),
        ("replay_size", 0),
        ("return_scale", math.inf),
        ("return_scale", math.nan),
        ("seed", -1),
        ("segments", "some"),
    ],
)
def test_invalid_value_is_rejected_with_name_and_value(name: str, value: object) -> None:
    with pytest.raises(ConfigError, match=f"^{name} = {re.escape(repr(value))}: "):
        build(Config, {"environment": "CartPole-v1", name: value})


def test_last_few_above_replay_size_is_rejected_with_both_values_and_the_remedy() -> None:
    with pytest.raises(ConfigError, match=r"last_few = 11.*replay_size = 10.*lower last_few"):
        build(Config, {"environment": "CartPole-v1", "last_few": 11, "replay_size": 10})


def test_last_few_may_equal_replay_size() -> None:
    config = build(Config, {"environment": "CartPole-v1", "last_few": 10, "replay_size": 10})
    assert config.commands.last_few == config.buffer.replay_size


@pytest.mark.parametrize(
    ("name", "value"),
    [("max_env_steps", 0), ("stop_return", math.nan), ("stop_return", math.inf)],
)
def test_invalid_budget_is_rejected(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=f"^{name} = {value}: "):
        build(Budget, {name: value})


def test_presets_of_the_three_environments_are_included() -> None:
    assert {"CartPole-v1", "LunarLander-v3", "LunarLanderSparse-v3"} <= set(preset_names())


@pytest.mark.parametrize("name", [n for n in preset_names() if n != "any"])
def test_preset_is_valid_and_named_after_its_environment(name: str) -> None:
    values = preset(name)
    budget = {key: values.pop(key) for key in Budget.__struct_fields__ if key in values}
    build(Budget, budget)
    named = name.removesuffix("-paper").removesuffix("-fleet")
    assert build(Config, values).environment == named


def test_generic_preset_has_automatic_settings() -> None:
    values = preset("any")
    automatic = {name for name, value in values.items() if value == "auto"}
    assert automatic == AUTOMATIC.keys()
    build(Config, {n: v for n, v in values.items() if n not in AUTOMATIC} | {"environment": "X-v0"})


def test_unknown_preset_is_rejected_with_the_available_ones() -> None:
    with pytest.raises(
        ConfigError, match=r"'Pong': expected one of CartPole-v1, Hopper-v5, LunarLander-v3"
    ):
        preset("Pong")


@pytest.mark.parametrize(
    ("text", "name", "value"),
    [
        ("batch_size=512", "batch_size", 512),
        ("learning_rate = 1e-3", "learning_rate", 1e-3),
        ("hidden=[64, 128]", "hidden", [64, 128]),
        ("eval_temperature=0.5", "eval_temperature", 0.5),
        ("segments=all", "segments", "all"),
        ("observe_time=True", "observe_time", True),
        ("observe_time=False", "observe_time", False),
        ('segments="all"', "segments", "all"),
        ("environment_kwargs={steps = 4}", "environment_kwargs", {"steps": 4}),
        ("environment=module:Env-v0", "environment", "module:Env-v0"),
        ("return_scale=inf", "return_scale", math.inf),
    ],
)
def test_assignment_value_is_toml_or_a_bare_word(text: str, name: str, value: Any) -> None:
    assert parse_assignment(text) == (name, value)


@pytest.mark.parametrize("text", ["batch_size", "=512", " =512", ""])
def test_assignment_without_name_or_equals_sign_is_rejected(text: str) -> None:
    with pytest.raises(ConfigError, match="expected NAME=VALUE"):
        parse_assignment(text)


def test_toml_file_is_read(tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text('environment = "CartPole-v1"\nhidden = [8]\n')
    assert read_toml(file) == {"environment": "CartPole-v1", "hidden": [8]}


def test_missing_file_is_rejected_by_name(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"absent\.toml: No such file or directory; name a readable TOML file$"
    ):
        read_toml(tmp_path / "absent.toml")


@pytest.mark.parametrize("content", [b"batch_size 512", b"\xff\xfe"])
def test_invalid_toml_file_is_rejected_by_name(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "broken.toml"
    file.write_bytes(content)
    with pytest.raises(ConfigError, match=r"broken\.toml"):
        read_toml(file)
