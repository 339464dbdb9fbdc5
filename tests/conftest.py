import importlib
import warnings
from importlib.util import find_spec

import hypothesis
import pytest

from udrl.numerics import use_one_thread

# Box2D's types warn while it is imported; as an error, such a warning kills the interpreter.
if find_spec("Box2D") is not None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        importlib.import_module("Box2D")

# The same examples in every run, and no deadline: machines are slow at times.
hypothesis.settings.register_profile("udrl", derandomize=True, deadline=None)
hypothesis.settings.load_profile("udrl")


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    use_one_thread()
