import importlib
import signal
import warnings
from importlib.util import find_spec
from pathlib import Path

import hypothesis
import pytest

from udrl.training import compute_deterministically
from udrl_launch import authority

# Box2D's types warn on import. As an error, such a warning kills the interpreter.
if find_spec("Box2D") is not None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        importlib.import_module("Box2D")

# Shells ignore SIGINT in background jobs, whose children would ignore it too.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The same examples in every run, and no deadline, because machines are sometimes slow.
hypothesis.settings.register_profile("udrl", derandomize=True, deadline=None)
hypothesis.settings.load_profile("udrl")


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    compute_deterministically()


@pytest.fixture(scope="session")
def keys_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keys for all roles."""
    folder = tmp_path_factory.mktemp("keys")
    authority.create_keys(folder)
    return folder


@pytest.fixture(scope="session")
def foreign_keys_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keys for all roles of an untrusted authority."""
    folder = tmp_path_factory.mktemp("foreign")
    authority.create_keys(folder)
    return folder
