"""Creating a run: settle once what every service of it will be told."""

import logging
import os
import re
import uuid
from collections.abc import Collection, Iterator
from contextlib import closing, contextmanager, suppress
from datetime import datetime
from pathlib import Path

import msgspec

from udrl.acting import EpisodeGenerator
from udrl.config import Budget, Config, flat
from udrl.cost import slow_training_warning
from udrl.episode import Episode
from udrl.errors import StoreError
from udrl.fitting import fit
from udrl.graph import acting_graph
from udrl.numerics import settle
from udrl.offline import settle_dataset
from udrl.repeating import repeated_digest
from udrl.strategies import make_strategy
from udrl.version import __version__
from udrl_proto import PROTOCOL
from udrl_proto.codec import LARGEST, decode, encode_episode
from udrl_proto.messages import EpisodeMessage, Hello
from udrl_replay.arrival import inspect
from udrl_replay.database import FILE
from udrl_replay.progress import RunProgress
from udrl_replay.remedies import remedy
from udrl_replay.resuming import closed_on_error
from udrl_replay.run import StoredRun
from udrl_replay.store import Store

log = logging.getLogger("udrl")

#: Who brings the episodes of a dataset.
OFFLINE = "dataset"


def directory_name(config: Config) -> str:
    """Return a name for a new run's directory."""
    now = datetime.now().astimezone().strftime("%Y%m%d-%H%M%S")
    return f"{_slug(config.environment)}-seed{config.seed}-{now}"


def _run_id(run_dir: Path) -> str:
    """Return a name that no other run has, on whatever router: the directory's, and some chance."""
    return f"{_slug(Path(os.path.realpath(run_dir)).name)}-{uuid.uuid4().hex[:8]}"


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:50].rstrip("-") or "run"


def create(
    run_dir: Path,
    config: Config,
    *,
    left_open: Collection[str] = (),
    allow_inexact: bool = False,
) -> Store:
    """Make a new run.

    What the settings leave to the machine or to the environment is chosen. The environment is made
    once and asked to replay an episode after another one; if it cannot, the run is marked inexact,
    and goes on.

    Args:
        run_dir: its directory.
        config: its settings.
        left_open: those to choose by what the environment is like (:mod:`udrl.fitting`).
        allow_inexact: accept services of other numerics classes.

    Raises:
        ConfigError: the command strategy cannot be made, or the dataset cannot be used.
        UnsupportedEnvironment: the environment does not exist or is not supported.
        EnvironmentFault: it raises, or returns what it may not.
        StoreError: the directory holds a run already, or cannot be written.
    """
    with no_empty_folder_left(run_dir):
        return _create(run_dir.absolute(), config, left_open, allow_inexact=allow_inexact)


@contextmanager
def no_empty_folder_left(run_dir: Path) -> Iterator[None]:
    """Remove a folder that was made for a run if the run is not made and nothing is in it."""
    try:
        yield
    except BaseException:
        with suppress(OSError):
            run_dir.rmdir()
        raise


def _create(
    run_dir: Path, config: Config, left_open: Collection[str], *, allow_inexact: bool
) -> Store:
    make_strategy(config)
    if left_open:
        log.info("choosing settings by random episodes of %s", config.environment)
    config = settle(fit(config, left_open))
    with closing(EpisodeGenerator(config, 1)) as generator:
        # First, as an actor does it: in an instance that has seen nothing else.
        digest = repeated_digest(generator)
        config, offline = settle_dataset(config, generator.spec)
    exact = digest != ""
    progress = RunProgress(exact=exact)
    if not exact:
        progress.inexact_reason = (
            f"environment {config.environment} does not repeat an episode from its seed"
        )
        log.warning("the run is not exact: %s", progress.inexact_reason)
    if long := slow_training_warning(config, generator.spec):
        log.warning("%s", long)
    hello = Hello(
        protocol=PROTOCOL,
        software=__version__,
        run_id=_run_id(run_dir),
        settings=flat(config),
        environment=generator.spec,
        environment_digest=digest,
        graph=acting_graph(config.network, generator.spec),
        allow_inexact=allow_inexact,
        exact=exact,
    )
    store = Store.create(run_dir, hello=hello, progress=progress)
    if offline is not None:
        with closed_on_error(store):
            _begin_with(store, offline)
    return store


def _begin_with(store: Store, episodes: list[Episode]) -> None:
    """Let episodes of others answer the commands of the warm-up."""
    spec = store.fact("hello", Hello).environment
    run = StoredRun(store, Budget(max_env_steps=2**53))
    with store.transaction():
        for episode in episodes:
            message = decode(encode_episode(episode, OFFLINE), EpisodeMessage, LARGEST)
            run.accept(inspect(message, spec), 0.0)
        run.save()


def config_of(store: Store) -> Config:
    """Return the settings of a run, with nothing left to the machine."""
    return store.fact("hello", Hello).config


def write_config(run_dir: Path, config: Config, budget: Budget) -> None:
    """Write the effective configuration, as TOML that ``--config`` reads.

    Args:
        run_dir: where to.
        config: the run's.
        budget: when it ends.

    Raises:
        StoreError: it cannot be written; a file that was there before is still there.
    """
    lines = []
    for settings in (config, budget):
        for name, value in flat(settings).items():
            if value is not None and value != {}:
                lines.append(f"{name} = {_toml(value)}")
    path = run_dir / "config.toml"
    unfinished = path.with_suffix(".new")
    try:
        # Aside and renamed: it holds the budget, which a full disk must not take.
        unfinished.write_text("\n".join(lines) + "\n", encoding="utf-8")
        unfinished.replace(path)
    except OSError as error:
        what_to_do = remedy(error, "free some disk space, or name a directory that you may write")
        raise StoreError(f"{path} cannot be written: {error}; {what_to_do}") from error


def _toml(value: object) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_toml(k)} = {_toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    # JSON's booleans, numbers and strings are TOML's.
    return msgspec.json.encode(value).decode()


def exists(run_dir: Path) -> bool:
    """Say whether a directory holds a run."""
    return (run_dir / FILE).exists()
