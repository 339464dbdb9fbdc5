import inspect
from typing import Any

import pytest

from udrl import errors
from udrl.errors import Refused, UdrlError

CLASSES: list[Any] = [
    member for _, member in inspect.getmembers(errors, inspect.isclass) if member is not UdrlError
]


@pytest.mark.parametrize("error", CLASSES, ids=lambda e: e.__name__)
def test_every_error_derives_from_the_base_class(error: Any) -> None:
    assert issubclass(error, UdrlError)
    assert error.__name__ in str(errors.__doc__)


@pytest.mark.parametrize("error", CLASSES, ids=lambda e: e.__name__)
def test_every_exit_code_is_a_failure_to_a_shell(error: Any) -> None:
    assert 1 < error.exit_code <= 255


def test_direct_subclasses_have_distinct_exit_codes() -> None:
    codes = [error.exit_code for error in CLASSES if error.__base__ is UdrlError]
    assert len(set(codes)) == len(codes)


def test_refusal_has_the_protocols_code() -> None:
    refused = Refused("other-environment", "the run trains another environment")
    assert refused.code == "other-environment"
    assert str(refused) == "the run trains another environment"
