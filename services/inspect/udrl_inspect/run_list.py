"""``udrl runs``: a list of runs with their states."""

import os
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Literal

import msgspec

from udrl.errors import ConfigError, UdrlError
from udrl_inspect.address import served_at
from udrl_inspect.inspection import budget_of
from udrl_proto.messages import Hello
from udrl_replay.database import STORE_FILE
from udrl_replay.progress import RunProgress
from udrl_replay.store import Store

State = Literal["running", "stopped", "ended", "failed", "unreadable"]


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """A run in one line.

    Attributes:
        run_dir: its directory.
        state: ``running``; ``stopped``: no service is running, and it can be resumed; ``ended``;
            ``failed``; ``unreadable``.
        environment: its Gymnasium id.
        seed: its seed.
        env_steps: env steps so far.
        max_env_steps: its budget.
        best_return: the highest mean return of an evaluation. None: no evaluation yet.
        changed: time of the last change of its store, seconds since 1970.
        problem: why it failed or cannot be read.
        ended_because: why it is not running. Empty if it is running or cannot be read.
    """

    run_dir: str
    state: State
    environment: str = ""
    seed: int | None = None
    env_steps: int = 0
    max_env_steps: int = 0
    best_return: float | None = None
    changed: float = 0.0
    problem: str = ""
    ended_because: str = ""


def find(folder: Path) -> list[Summary]:
    """Return the runs in a folder and in the folders below it, newest first.

    Raises:
        ConfigError: the folder does not exist.
    """
    if not os.path.isdir(folder):  # unlike Path.is_dir, it raises nothing
        raise ConfigError(f"{folder}: no such directory; give the folder of your runs")
    summaries = map(summarise_run, run_directories(folder))
    return sorted(summaries, key=lambda s: s.changed, reverse=True)


def run_directories(folder: Path, seen: set[Path] | None = None) -> Iterator[Path]:
    """Yield the directories of runs in a folder and in the folders below it, each once."""
    seen = set() if seen is None else seen
    try:
        real = folder.resolve()
        if real in seen:  # links may form a loop
            return
        seen.add(real)
        if (folder / STORE_FILE).exists():
            yield folder
            return
        below = sorted(f for f in folder.iterdir() if f.is_dir())
    except OSError:
        return  # not readable, or removed in the meantime
    for one in below:
        yield from run_directories(one, seen)


def summarise_run(run_dir: Path) -> Summary:
    """Return the summary of a run, even if it cannot be read."""
    # Without the -shm file, which readers write too.
    changed = max(map(_changed, (run_dir / STORE_FILE, run_dir / f"{STORE_FILE}-wal")))
    try:
        with closing(Store(run_dir, read_only=True)) as store:
            config = store.fact("hello", Hello).config
            progress = store.fact("progress", RunProgress)
            best = store.best_evaluation()
        state: State = "stopped"
        because = progress.why_stopped()
        if progress.state in ("ended", "failed"):
            state, because = progress.state, progress.why_ended()
        elif served_at(run_dir) is not None:
            state, because = "running", ""
        return Summary(
            run_dir=str(run_dir),
            state=state,
            environment=config.environment,
            seed=config.seed,
            env_steps=progress.env_steps,
            max_env_steps=budget_of(run_dir).max_env_steps,
            best_return=best,
            changed=changed,
            problem=progress.problem,
            ended_because=because,
        )
    except UdrlError as error:
        return Summary(
            run_dir=str(run_dir), state="unreadable", changed=changed, problem=str(error)
        )


def _changed(path: Path) -> float:
    """Return the time of a file's last change; 0 if it does not exist."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0
