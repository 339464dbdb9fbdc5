"""Going on with a run: its configuration and its environment must be what they were."""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from udrl.acting import EpisodeGenerator
from udrl.commands import CommandSampler
from udrl.config import COMMANDS_PER_ITERATION, Config, flat
from udrl.errors import EnvironmentFault, OtherConfiguration
from udrl.numerics import settle_as
from udrl.repeating import difference, environment_digest
from udrl_proto.codec import LARGEST, decode, decode_episode
from udrl_proto.messages import EpisodeMessage, Hello
from udrl_replay.progress import RunProgress
from udrl_replay.store import Store

log = logging.getLogger("udrl")

#: Stored episodes that are played again, and seconds after which no other one is begun.
_EPISODES = 3
_PATIENCE_S = 10.0


def resume(
    run_dir: Path, config: Config, *, allow_inexact: bool = False, check_environment: bool = True
) -> Store:
    """Open a run to go on with it.

    Args:
        run_dir: its directory.
        config: must be the run's own.
        allow_inexact: from now on, if it was not before.
        check_environment: play some stored episodes again; a service that is started again by
            another program leaves that to the program.

    Raises:
        StoreError: there is none, it is in use, its configuration is another one, or its
            environment does something else than before.
    """
    store = Store(run_dir)
    with closed_on_error(store):
        hello = store.fact("hello", Hello)
        held, asked = flat(hello.config), flat(settle_as(hello.config, config))
        different = [f"{k} = {held[k]!r}, not {asked[k]!r}" for k in held if held[k] != asked[k]]
        if different:
            raise OtherConfiguration(
                f"{run_dir} belongs to a run with {'; '.join(different)}; use its "
                f"configuration, or name another --run-dir"
            )
        if allow_inexact and not hello.allow_inexact:
            hello = msgspec.structs.replace(hello, allow_inexact=True)
            with store.transaction():
                store.set_fact("hello", hello)
        progress = store.fact("progress", RunProgress)
        # The episodes of a run with a liar are not the environment's.
        if check_environment and progress.exact and not progress.deceived:
            _check_environment(store, hello, allow_inexact=allow_inexact)
    return store


def _check_environment(store: Store, hello: Hello, *, allow_inexact: bool) -> None:
    """Compare what the environment does with what it did when the run was created and since."""
    found = _changed(store, hello)
    if found is None:
        return
    environment = hello.config.environment
    if not allow_inexact:
        raise OtherConfiguration(
            f"environment {environment} has changed since the run was created: {found}; restore "
            f"its package and what it computes with, or resume with --allow-inexact"
        )
    progress = store.fact("progress", RunProgress)
    progress.exact = False
    progress.inexact_reason = f"environment {environment} has changed: {found}"
    log.warning("the run is no longer exact: %s", progress.inexact_reason)
    with store.transaction():
        # Its actors do what it does now, and are compared with nothing.
        store.set_fact("hello", msgspec.structs.replace(hello, environment_digest="", exact=False))
        store.set_fact("progress", progress)


def _changed(store: Store, hello: Hello) -> str | None:
    """Say in what way the environment has changed; None: in none that was found."""
    config, began = hello.config, time.monotonic()
    generator = EpisodeGenerator(config, 1)
    spec = generator.spec
    try:
        if spec != hello.environment:
            return f"it is {spec}, it was {hello.environment}"
        if environment_digest(generator) != hello.environment_digest:
            return "its first steps are others"
    finally:
        generator.close()
    sampler = CommandSampler(config, spec)
    for episode_id in _telling(store, config):
        if time.monotonic() - began > _PATIENCE_S:
            break
        (body,) = store.episode_bodies([episode_id], 1)
        episode = decode_episode(decode(body, EpisodeMessage, LARGEST), spec.observation_space)
        command = sampler.training_command(episode_id)
        try:
            found = difference(config, episode, command.environment_seed, command.max_steps)
        except EnvironmentFault as fault:
            found = str(fault)
        if found is not None:
            return f"in episode {episode_id} {found}"
    return None


def _telling(store: Store, config: Config) -> Iterator[int]:
    """Yield ids of stored episodes: the longest, for late steps, then the newest."""
    held = [p.entry for p in store.buffer(store.fact("progress", RunProgress).iteration)]
    if config.commands.dataset is not None:  # its episodes have no seeds
        held = [e for e in held if e.id >= COMMANDS_PER_ITERATION]
    by_length = sorted(held, key=lambda e: e.length, reverse=True)
    newest = sorted(held, key=lambda e: e.id, reverse=True)
    yield from dict.fromkeys(e.id for e in by_length[:1] + newest[: _EPISODES - 1])


@contextmanager
def closed_on_error(store: Store) -> Iterator[None]:
    """Close a store when what is done with it fails."""
    try:
        yield
    except BaseException:
        store.close()
        raise
