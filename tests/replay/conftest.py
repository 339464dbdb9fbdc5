"""Runs, each in its own directory."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.replay.synthetic import create, reopen
from udrl.config import Budget
from udrl_replay.run import StoredRun


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    """Closes what it contains at the end of the test."""
    with ExitStack() as entered:
        yield entered


@pytest.fixture
def make_run(stack: ExitStack, tmp_path: Path) -> Callable[..., StoredRun]:
    """Makes a new run in ``tmp_path``."""

    def make(
        lead: int = 0,
        max_env_steps: int = 1_000_000,
        stop_return: float | None = None,
        keep_versions: int | None = None,
    ) -> StoredRun:
        store = create(tmp_path, lead)
        stack.callback(store.close)
        budget = Budget(
            max_env_steps=max_env_steps, stop_return=stop_return, keep_versions=keep_versions
        )
        return StoredRun(store, budget)

    return make


@pytest.fixture
def reopened(stack: ExitStack, tmp_path: Path) -> Callable[..., StoredRun]:
    """Ends a replay service and starts another on the same run."""

    def start(run: StoredRun, budget: Budget | None = None) -> StoredRun:
        again = reopen(run, tmp_path, budget)
        stack.callback(again.store.close)
        return again

    return start
