from typing import Any

import pytest

from udrl.config import Config, build
from udrl.errors import ConfigError


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("observe_time", "no", "observe_time = 'no': expected true or false, got a string"),
        ("batch_size", 0, "batch_size = 0: expected an integer >= 1"),
        ("max_return", "x", "max_return = 'x': expected a number or unset, got a string"),
        ("hidden", 128, "hidden = 128: expected a list, got an integer; e.g. [128]"),
        ("wrappers", "a:b", "wrappers = 'a:b': expected a list, got a string; e.g. [\"a:b\"]"),
        (
            "hidden",
            ["a"],
            "hidden = ['a']: expected an integer, got a string - at `$.hidden[0]`",
        ),
        (
            "environment_kwargs",
            "{obs=box}",
            "environment_kwargs = '{obs=box}': expected a table, got a string; "
            'e.g. {name="value"}',
        ),
        ("memory", "lstm", "memory = 'lstm': expected 'gru' or 'none'"),
    ],
)
def test_message_says_what_is_expected_in_plain_words(name: str, value: Any, message: str) -> None:
    with pytest.raises(ConfigError) as refused:
        build(Config, {"environment": "CartPole-v1", name: value})
    assert str(refused.value) == message
