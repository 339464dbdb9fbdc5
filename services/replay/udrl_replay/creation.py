"""Creating a run: determine all that its services need to know, once."""

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
from udrl.atomic_files import write_atomically
from udrl.automatic_settings import resolve_automatic
from udrl.commands import strategy_of
from udrl.config import UNSET, Budget, Config, flat
from udrl.cost import slow_training_warning
from udrl.datasets import resolve_dataset
from udrl.determinism import repeated_digest
from udrl.episode import Episode
from udrl.errors import StoreError
from udrl.graph import acting_graph
from udrl.numerics import resolve_arithmetic
from udrl.version import __version__
from udrl_proto import PROTOCOL
from udrl_proto.codec import LARGEST, decode, encode_episode
from udrl_proto.messages import EpisodeMessage, Hello
from udrl_replay.arrival import inspect_episode
from udrl_replay.progress import RunProgress
from udrl_replay.remedies import remedy
from udrl_replay.run import StoredRun
from udrl_replay.store import Store

log = logging.getLogger("udrl")

#: Name of the actor of a dataset's episodes.
OFFLINE = "dataset"


def directory_name(config: Config) -> str:
    """Return a name for a new run's directory."""
    now = datetime.now().astimezone().strftime("%Y%m%d-%H%M%S")
    return f"{_slug(config.environment)}-seed{config.seed}-{now}"


def _run_id(run_dir: Path) -> str:
    """Return a globally unique name: the directory's with a random suffix."""
    return f"{_slug(Path(os.path.realpath(run_dir)).name)}-{uuid.uuid4().hex[:8]}"


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:50].rstrip("-") or "run"


def create_run(
    run_dir: Path,
    config: Config,
    *,
    automatic: Collection[str] = (),
    allow_inexact: bool = False,
) -> Store:
    """Create a new run.

    Settings that depend on the machine or the environment are chosen. The environment is checked
    for determinism: it must repeat an episode after another one. If it does not, the run is marked
    inexact.

    Args:
        run_dir: its directory.
        config: its settings.
        automatic: settings to choose by properties of the environment
            (:mod:`udrl.automatic_settings`).
        allow_inexact: accept services of other numerics classes.

    Raises:
        ConfigError: the command strategy cannot be created, or the dataset cannot be used.
        UnsupportedEnvironment: the environment does not exist or is not supported.
        EnvironmentFault: the environment raised an exception, or returned an invalid value.
        StoreError: the directory already holds a run, or cannot be written.
    """
    with no_empty_folder_left(run_dir):
        return _create(run_dir.absolute(), config, automatic, allow_inexact=allow_inexact)


@contextmanager
def no_empty_folder_left(run_dir: Path) -> Iterator[None]:
    """Remove the folder made for a run if creating the run fails and the folder is empty."""
    try:
        yield
    except BaseException:
        with suppress(OSError):
            run_dir.rmdir()
        raise


def _create(
    run_dir: Path, config: Config, automatic: Collection[str], *, allow_inexact: bool
) -> Store:
    if automatic:
        log.info("choosing settings from random episodes of %s", config.environment)
    config = resolve_arithmetic(resolve_automatic(config, automatic))
    with closing(EpisodeGenerator(config, 1)) as generator:
        strategy_of(config, generator.spec)
        # First and in a fresh instance, as actors do.
        digest = repeated_digest(generator)
        config, offline = resolve_dataset(config, generator.spec)
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
        try:
            _begin_with(store, offline)
        except BaseException:
            store.delete()
            raise
    return store


def _begin_with(store: Store, episodes: list[Episode]) -> None:
    """Use a dataset's episodes as those of the warm-up commands."""
    spec = store.fact("hello", Hello).environment
    run = StoredRun(store, Budget(max_env_steps=2**53))
    with store.transaction():
        for episode in episodes:
            message = decode(encode_episode(episode, OFFLINE), EpisodeMessage, LARGEST)
            run.accept(inspect_episode(message, spec), 0.0)
        run.save()


def config_of(store: Store) -> Config:
    """Return the settings of a run, all of them chosen."""
    return store.fact("hello", Hello).config


def write_config(run_dir: Path, config: Config, budget: Budget) -> None:
    """Write the effective configuration as TOML, for ``--config``.

    Args:
        run_dir: directory of the run.
        config: settings of the run.
        budget: budget of the run.

    Raises:
        StoreError: the file cannot be written; an existing file is unchanged.
    """
    lines = []
    for settings in (config, budget):
        lines += [f"{name} = {as_toml(value)}" for name, value in flat(settings).items()]
    path = run_dir / "config.toml"
    try:
        # A full disk must not destroy the old budget.
        write_atomically(path, ("\n".join(lines) + "\n").encode())
    except OSError as error:
        what_to_do = remedy(error, "use a writable directory")
        raise StoreError(f"{path} cannot be written: {error.strerror}; {what_to_do}") from error


def as_toml(value: object) -> str:
    """Return a setting's value in TOML."""
    if value is None:
        value = UNSET  # left out, it would be a preset's value
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{as_toml(k)} = {as_toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(as_toml, value)) + "]"
    # JSON's booleans, numbers and strings are TOML's.
    return msgspec.json.encode(value).decode()
