import inspect
from typing import Any

import pytest

from udrl import errors
from udrl.errors import Refused, UdrlError

CLASSES: list[Any] = [
    member for _, member in inspect.getmembers(errors, inspect.isclass) if member is not UdrlError
]


@pytest.mark.parametrize("error", CLASSES, ids=lambda e: e.__name__)
def test_every_error_can_be_caught_as_ours_and_stands_in_the_tree(error: Any) -> None:
    assert issubclass(error, UdrlError)
    assert error.__name__ in str(errors.__doc__)


@pytest.mark.parametrize("error", CLASSES, ids=lambda e: e.__name__)
def test_every_exit_code_is_one_that_a_shell_sees_as_a_failure(error: Any) -> None:
    assert 1 < error.exit_code <= 255


def test_direct_descendants_have_exit_codes_of_their_own() -> None:
    codes = [error.exit_code for error in CLASSES if error.__base__ is UdrlError]
    assert len(set(codes)) == len(codes)


def test_a_refusal_carries_the_protocols_name_for_its_reason() -> None:
    refused = Refused("other-environment", "the run trains another environment")
    assert refused.code == "other-environment"
    assert str(refused) == "the run trains another environment"
