"""Looking at a run from outside: its status, its weights, its learning curve."""

import faulthandler
import json
import logging
import os
from contextlib import closing
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.behavior import BehaviorFunction
from udrl.checkpoint import decode_weights
from udrl.commands import Command, CommandSampler
from udrl.config import Budget, Config, build, read_toml
from udrl.episode import Episode
from udrl.errors import ConfigError, StoreError, UdrlError
from udrl.evaluation import Evaluation, summarise
from udrl.numerics import use_one_thread
from udrl.replay import ReplayBuffer
from udrl_launch.address import Address, connected
from udrl_launch.roles import ENDPOINT_FILE
from udrl_proto import keys
from udrl_proto.asking import Asker
from udrl_proto.messages import Hello, Status, StatusRequest
from udrl_replay.reporting import Throughput, Waits, status
from udrl_replay.run import Progress, Run
from udrl_replay.store import Store

log = logging.getLogger("udrl")

_ANSWER_S = 3.0
#: Seconds after which a command that is reproduced shows where it is, again and again.
_SHOW_S = 60.0


def status_at(address: Address) -> Status:
    """Return the status of a run that is being worked on.

    Raises:
        Unreachable: nobody answers there.
        ConfigError: the endpoint or the keys cannot be used, or the run must be named.
    """
    with connected("observer", address) as (session, hello):
        asker = Asker(session, hello.run_id, "udrl status", patience_s=_ANSWER_S)
        return asker.ask(keys.STATUS, StatusRequest(), Status)


def status_of(run_dir: Path, keys_dir: Path | None = None) -> Status:
    """Return the status of a run by its directory, whether somebody works on it or not.

    Raises:
        StoreError: there is no run, or it is damaged.
    """
    try:
        where = json.loads((run_dir / ENDPOINT_FILE).read_text(encoding="utf-8"))
        os.kill(int(where["pid"]), 0)  # raises unless the service that wrote the file is there
        with closing(Store(run_dir, read_only=True)) as store:
            run_id = store.fact("hello", Hello).run_id
        return status_at(Address(str(where["endpoint"]), run_id, _ANSWER_S, keys_dir))
    except (OSError, ValueError, KeyError, TypeError, UdrlError) as error:
        log.debug("no live status: %s", error)
        return read_status(run_dir)


def read_status(run_dir: Path) -> Status:
    """Return the status of a run as its file says it.

    Raises:
        StoreError: there is no run, or it is damaged.
    """
    with closing(Store(run_dir, read_only=True)) as store:
        run = Run(store, _budget(run_dir))
        return status(run, Throughput(), Waits(), 0.0, 0.0)


def _budget(run_dir: Path) -> Budget:
    path = run_dir / "config.toml"
    values = read_toml(path) if path.exists() else {}
    return build(Budget, {n: v for n, v in values.items() if n in Budget.__struct_fields__})


def settings_of(run_dir: Path) -> dict[str, Any]:
    """Return the settings that a run was created with, and the last budget that it was given."""
    with closing(Store(run_dir, read_only=True)) as store:
        config = store.fact("hello", Hello).config
    values: dict[str, Any] = msgspec.to_builtins(config) | msgspec.to_builtins(_budget(run_dir))
    return values


class Agent(NamedTuple):
    """A trained behavior function and the run that it comes from."""

    config: Config
    version: int
    behavior: BehaviorFunction
    buffer: ReplayBuffer
    iteration: int
    weights: bytes


def load_agent(run_dir: Path, version: int | Literal["latest", "best"] = "latest") -> Agent:
    """Return an agent from a run's directory.

    Raises:
        StoreError: there is no run, or it does not keep that version.
    """
    with closing(Store(run_dir, read_only=True)) as store:
        hello = store.fact("hello", Hello)
        progress = store.fact("progress", Progress)
        named = {"latest": progress.latest_version, "best": progress.best_version}
        wanted = version if isinstance(version, int) else named[version]
        found = store.version(wanted)
        if found is None or not found.weights:
            raise StoreError(
                f"weights {version!r} are not kept in {run_dir}; kept are versions "
                f"{store.versions_kept()}"
            )
        held = store.buffer(progress.iteration)
        return Agent(
            config=hello.config,
            version=wanted,
            behavior=decode_weights(found.weights, hello.config, hello.environment),
            buffer=ReplayBuffer(hello.config, (p.entry for p in held)),
            iteration=progress.iteration,
            weights=found.weights,
        )


def reproduce(run_dir: Path, command_id: int) -> Episode:
    """Carry out one outstanding command of a run.

    Raises:
        StoreError: there is no such command, or its weights are not kept.
        EnvironmentFault: the environment failed, with what it raised as the cause.
    """
    with closing(Store(run_dir, read_only=True)) as store:
        config = store.fact("hello", Hello).config
        outstanding = {c.id: c for c in store.commands(cancelled=False)}
    if command_id not in outstanding:
        raise StoreError(f"command {command_id} is not outstanding in {run_dir}")
    command = outstanding[command_id]
    version = command.weights_version
    behavior = load_agent(run_dir, version).behavior if version else None
    use_one_thread()
    faulthandler.dump_traceback_later(_SHOW_S, repeat=True)  # it may hang, in native code too
    try:
        return generate_episodes(EpisodeGenerator(config, 1), [command], behavior)[0]
    finally:
        faulthandler.cancel_dump_traceback_later()


class Result(NamedTuple):
    """What an evaluation was told, and what came of it."""

    desired_return: float
    desired_horizon: int
    temperature: float
    evaluation: Evaluation
    returns: list[float]


def evaluate(
    agent: Agent,
    *,
    episodes: int,
    temperature: float | None = None,
    desired_return: float | None = None,
    desired_horizon: int | None = None,
    environments: int = 16,
) -> Result:
    """Evaluate an agent; without a command of its own, by that of section 2.3.6.

    With the run's own settings this repeats its closing evaluation exactly.

    Raises:
        ConfigError: a horizon is given, and the run's horizons follow from the returns.
    """
    if agent.config.desired_horizon == "return" and desired_horizon is not None:
        raise ConfigError(
            f"desired horizon {desired_horizon}: in this run it is the desired return, as an "
            f"integer, at every step; give the return only"
        )
    use_one_thread()
    if temperature is None:
        temperature = agent.config.eval_temperature
    config = msgspec.structs.replace(
        agent.config, eval_episodes=episodes, eval_temperature=temperature
    )
    generator = EpisodeGenerator(config, environments)
    sampler = CommandSampler(config, generator.spec.max_episode_steps)
    commands: list[Command] = sampler.close(agent.iteration, agent.buffer)
    told = commands[0]
    wanted = sampler.desired(
        told.desired_return if desired_return is None else desired_return,
        told.desired_horizon if desired_horizon is None else desired_horizon,
    )
    commands = [
        msgspec.structs.replace(c, desired_return=wanted[0], desired_horizon=wanted[1])
        for c in commands
    ]
    done = generate_episodes(generator, commands, agent.behavior)
    generator.close()
    returns = [e.episode_return for e in done]
    return Result(*wanted, temperature, summarise(returns), returns)
