"""Resuming a run, after checking that its configuration and environment are unchanged."""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from udrl.acting import MAX_FAILURES, EpisodeGenerator
from udrl.commands import Command, CommandSampler
from udrl.config import COMMANDS_PER_ITERATION, Config, flat
from udrl.determinism import difference, environment_digest
from udrl.episode import Episode
from udrl.errors import EnvironmentFault, OtherConfiguration, StoreError
from udrl.numerics import resolve_as
from udrl_proto.codec import LARGEST, decode, decode_episode
from udrl_proto.messages import EpisodeMessage, Hello
from udrl_replay.progress import RunProgress
from udrl_replay.store import Store

log = logging.getLogger("udrl")

#: Number of stored episodes to repeat, and seconds after which no further one is started.
_EPISODES = 3
_PATIENCE_S = 10.0


def resume(
    run_dir: Path, config: Config, *, allow_inexact: bool = False, check_environment: bool = True
) -> Store:
    """Open a run to continue it.

    Args:
        run_dir: its directory.
        config: must be the run's own.
        allow_inexact: accept services of other numerics classes from now on.
        check_environment: repeat some stored episodes to check the environment.

    Raises:
        StoreError: there is no run, it is in use, its creation was interrupted, its configuration
            differs, or its environment behaves differently than before.
        EnvironmentFault: the environment fails in its first steps.
    """
    store = Store(run_dir)
    with closed_on_error(store):
        hello, progress = store.fact("hello", Hello), store.fact("progress", RunProgress)
        if hello.config.commands.dataset is not None and progress.iteration < 0:
            raise StoreError(
                f"{run_dir} does not have all episodes of its dataset, because creating the run "
                f"was interrupted; remove it and start the run again"
            )
        held, given = flat(hello.config), flat(resolve_as(hello.config, config))
        different = [f"{k} = {held[k]!r}, not {given[k]!r}" for k in held if held[k] != given[k]]
        if different:
            raise OtherConfiguration(
                f"{run_dir} belongs to a run with {'; '.join(different)}; use its "
                f"configuration, or use another --run-dir"
            )
        if allow_inexact and not hello.allow_inexact:
            hello = msgspec.structs.replace(hello, allow_inexact=True)
            with store.transaction():
                store.set_fact("hello", hello)
        # The episodes of a run with a false episode are not the environment's.
        if check_environment and progress.exact and not progress.deceived:
            _check_environment(store, hello, allow_inexact=allow_inexact)
    return store


def _check_environment(store: Store, hello: Hello, *, allow_inexact: bool) -> None:
    """Check that the environment behaves as in the stored episodes."""
    found = _changed(store, hello)
    if found is None:
        return
    environment = hello.config.environment
    if not allow_inexact:
        raise OtherConfiguration(
            f"environment {environment} has changed since the run was created: {found}; restore "
            f"the versions of its package and dependencies, or resume with --allow-inexact"
        )
    progress = store.fact("progress", RunProgress)
    progress.exact = False
    progress.inexact_reason = f"environment {environment} has changed: {found}"
    log.warning("the run is no longer exact: %s", progress.inexact_reason)
    with store.transaction():
        # Without a digest, actors with the changed environment can join.
        store.set_fact("hello", msgspec.structs.replace(hello, environment_digest="", exact=False))
        store.set_fact("progress", progress)


def _changed(store: Store, hello: Hello) -> str | None:
    """Return a description of how the environment has changed; None: no change was found."""
    config, began = hello.config, time.monotonic()
    generator = EpisodeGenerator(config, 1)
    spec = generator.spec
    try:
        if spec != hello.environment:
            return f"it is {spec}, it was {hello.environment}"
        if environment_digest(generator) != hello.environment_digest:
            return "its first steps differ"
    except EnvironmentFault as fault:
        # Even with --allow-inexact, the run cannot continue with such an environment.
        raise EnvironmentFault(
            f"{fault}; it did not fail when the run was created: restore the versions of its "
            f"package and dependencies, and what it needs, such as a server"
        ) from fault
    finally:
        generator.close()
    sampler = CommandSampler(config, spec)
    for episode_id in _episodes_to_repeat(store, config):
        if time.monotonic() - began > _PATIENCE_S:
            break
        (body,) = store.episode_bodies([episode_id], 1)
        episode = decode_episode(decode(body, EpisodeMessage, LARGEST), spec.observation_space)
        command = sampler.training_command(episode_id)
        found = _difference(config, episode, command)
        if found is not None:
            return f"in episode {episode_id} {found}"
    return None


def _difference(config: Config, episode: Episode, command: Command) -> str | None:
    """Return how an episode differs when it is repeated; None: it does not.

    As in training, only an environment that fails repeatedly cannot run a command.
    """
    for _ in range(MAX_FAILURES):
        try:
            return difference(config, episode, command.environment_seed, command.max_steps)
        except EnvironmentFault as error:
            fault = str(error)
    return fault


def _episodes_to_repeat(store: Store, config: Config) -> Iterator[int]:
    """Yield ids of stored episodes: the longest, to check late steps, then the newest."""
    held = [p.entry for p in store.buffer(store.fact("progress", RunProgress).iteration)]
    if config.commands.dataset is not None:  # its episodes have no seeds
        held = [e for e in held if e.id >= COMMANDS_PER_ITERATION]
    by_length = sorted(held, key=lambda e: e.length, reverse=True)
    newest = sorted(held, key=lambda e: e.id, reverse=True)
    yield from dict.fromkeys(e.id for e in by_length[:1] + newest[: _EPISODES - 1])


@contextmanager
def closed_on_error(store: Store) -> Iterator[None]:
    """Close a store if the block raises."""
    try:
        yield
    except BaseException:
        store.close()
        raise
