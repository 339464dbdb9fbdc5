"""Agents of runs: loading and evaluating them, and running a command again."""

import faulthandler
from collections.abc import Callable, Sequence
from contextlib import closing
from itertools import chain, islice
from pathlib import Path
from typing import Literal, NamedTuple

import msgspec

from udrl.acting import EpisodeGenerator, generate_episodes, iterate_episodes
from udrl.commands import Command, CommandSampler
from udrl.config import Config, change
from udrl.environments.specification import EnvironmentSpec
from udrl.episode import Episode
from udrl.errors import ConfigError, StoreError
from udrl.evaluation import Evaluation, summarise
from udrl.folder import load_folder
from udrl.inference import ActingFunction
from udrl.policy import Policy
from udrl.replay_buffer import ReplayBuffer
from udrl.targets import ReturnInTime
from udrl.weights import decode_behavior
from udrl_inspect.hub import HUB_SCHEME, download
from udrl_proto.messages import MAX_NUMBER, Hello
from udrl_replay.database import exists
from udrl_replay.progress import RunProgress
from udrl_replay.store import EvaluationRow, Store

#: Seconds between tracebacks while a command is reproduced.
_TRACEBACK_S = 60.0


class Agent(NamedTuple):
    """A trained behavior function and the state of its run.

    Attributes:
        run_id: id of the run.
        config: settings of the run.
        environment: specification of its environment.
        version: weights version.
        behavior: the behavior function of this version.
        buffer: replay buffer after ``iteration``.
        iteration: last completed iteration of the run.
        weights: the version's weights, safetensors.
    """

    run_id: str
    config: Config
    environment: EnvironmentSpec
    version: int
    behavior: ActingFunction
    buffer: ReplayBuffer
    iteration: int
    weights: bytes

    @property
    def policy(self) -> Policy:
        """The policy; its default command is that of evaluations (2.3.6)."""
        command = evaluation_commands(self, episodes=1)[0]
        return Policy(
            self.behavior,
            self.config,
            self.environment,
            desired_return=command.desired_return,
            desired_horizon=command.desired_horizon,
        )


def load_agent(run_dir: Path, version: int | Literal["latest", "best"] = "latest") -> Agent:
    """Return the agent of a run.

    Raises:
        ConfigError: the version is neither a number nor ``latest`` or ``best``.
        StoreError: the directory holds no run, or the run does not keep that version.
        InvalidWeights: the weights do not belong to the run's graph.
    """
    with closing(Store(run_dir, read_only=True)) as store:
        hello = store.fact("hello", Hello)
        progress = store.fact("progress", RunProgress)
        is_number = isinstance(version, int) and abs(version) <= MAX_NUMBER
        if not is_number and version not in ("latest", "best"):
            raise ConfigError(f"weights {version!r}: expected latest, best or a version number")
        wanted = progress.version_named(version)
        found = store.version(wanted)
        if progress.latest_version == 0:
            raise StoreError(
                f"{run_dir} has no weights yet: nothing has been trained since the warm-up; wait "
                f"for the first version, or resume the run if it is not running, with a larger "
                f"max_env_steps if its budget is spent"
            )
        if found is None or not found.weights:
            raise StoreError(
                f"weights version {version} is not kept in {run_dir}; choose latest, best or one "
                f"of {', '.join(map(str, store.versions_kept()))}"
            )
        held = store.buffer(progress.iteration)
        return Agent(
            run_id=hello.run_id,
            config=hello.config,
            environment=hello.environment,
            version=wanted,
            behavior=decode_behavior(hello.graph, found.weights),
            buffer=ReplayBuffer(hello.config.buffer, (p.entry for p in held)),
            iteration=progress.iteration,
            weights=found.weights,
        )


def load(path: str | Path, weights: int | Literal["latest", "best"] = "latest") -> Policy:
    """Return the agent of a run, or an exported one.

    Its ``desired_return`` and ``desired_horizon`` are those of its evaluations.

    Args:
        path: the directory of a run, a folder written by ``udrl export --folder``, or
            ``hf://OWNER/NAME`` for an agent on the Hugging Face Hub, ``hf://OWNER/NAME@REVISION``
            for one of its revisions.
        weights: a weights version that the run keeps, ``latest`` or ``best``.

    Raises:
        ConfigError: the path is none of these, or ``weights`` cannot be chosen.
        InvalidData: the files are invalid.
        StoreError: the run has no such version.
        Unreachable: the Hub does not respond.
    """
    is_on_hub = isinstance(path, str) and path.startswith(HUB_SCHEME)
    if not is_on_hub and exists(Path(path)):
        return load_agent(Path(path), weights).policy
    if weights != "latest":
        raise ConfigError(
            f"weights = {weights!r}: {path} is not a run directory, and an exported agent has one "
            f"version; leave weights out"
        )
    return load_folder(download(str(path)) if is_on_hub else path)


def stored_evaluation(store: Store, agent: Agent) -> EvaluationRow | None:
    """Return the run's own evaluation of an agent; None if there was none."""
    # With a lead the same weights are evaluated in a later iteration.
    return store.evaluation_of(agent.version, is_final=True) or store.evaluation_of(
        agent.version + agent.config.lead, is_final=False
    )


def reproduce(run_dir: Path, command_id: int) -> Episode:
    """Run one outstanding command of a run.

    Raises:
        StoreError: there is no such command, or its weights are not kept.
        EnvironmentFault: the environment failed; its exception is the cause.
    """
    with closing(Store(run_dir, read_only=True)) as store:
        config = store.fact("hello", Hello).config
        outstanding = {c.id: c for c in store.commands(cancelled=False)}
    if command_id not in outstanding:
        raise StoreError(
            f"command {command_id} is not outstanding in {run_dir}; use the id in the run's error "
            f"or log"
        )
    command = outstanding[command_id]
    version = command.weights_version
    behavior = load_agent(run_dir, version).behavior if version else None
    faulthandler.dump_traceback_later(_TRACEBACK_S, repeat=True)  # it may hang, in native code too
    try:
        with closing(EpisodeGenerator(config, 1)) as generator:
            return generate_episodes(generator, [command], behavior)[0]
    finally:
        faulthandler.cancel_dump_traceback_later()


class EvaluationResult(NamedTuple):
    """The command of an evaluation, and its results.

    Attributes:
        desired_return: desired return of all commands.
        desired_horizon: desired horizon of all commands, steps.
        temperature: sampling temperature of all commands.
        evaluation: statistics of the returns.
        returns: the episodes' returns, in the order of their commands.
        lengths: the episodes' lengths in steps.
    """

    desired_return: float
    desired_horizon: int
    temperature: float
    evaluation: Evaluation
    returns: list[float]
    lengths: list[int]


def evaluation_commands(
    agent: Agent,
    *,
    episodes: int,
    temperature: float | None = None,
    desired_return: float | None = None,
    desired_horizon: int | None = None,
) -> list[Command]:
    """Return the commands of an evaluation; None means as in the run's final evaluation (2.3.6).

    Raises:
        ConfigError: a horizon is given, but the run's horizons follow from the returns, or its
            agents have no horizon as input.
    """
    if agent.config.network.horizon_scale == 0 and desired_horizon is not None:
        raise ConfigError(
            f"desired horizon {desired_horizon}: this run's agents do not use it (horizon_scale = "
            f"0); give only a desired return"
        )
    if agent.config.network.horizon_equals_return and desired_horizon is not None:
        raise ConfigError(
            f"desired horizon {desired_horizon}: in this run it always equals the desired return, "
            f"as an integer; give only a desired return"
        )
    if temperature is None:
        temperature = agent.config.evaluation.eval_temperature
    config = change(agent.config, eval_episodes=episodes, eval_temperature=temperature)
    sampler = CommandSampler(config, agent.environment)
    commands = sampler.evaluate_final(agent.iteration, agent.buffer)
    default = commands[0]
    desired = ReturnInTime(config.network).initial(
        default.desired_return if desired_return is None else desired_return,
        default.desired_horizon if desired_horizon is None else desired_horizon,
    )
    return [
        msgspec.structs.replace(c, desired_return=desired[0], desired_horizon=desired[1])
        for c in commands
    ]


def evaluate(agent: Agent, commands: Sequence[Command], environments: int = 16) -> EvaluationResult:
    """Evaluate an agent with given commands (:func:`evaluation_commands`).

    With the run's own settings this repeats its final evaluation exactly.

    Raises:
        EnvironmentFault: the environment failed three times under the same command.
    """
    (result,) = evaluate_all(agent, [commands], environments)
    return result


def evaluate_all(
    agent: Agent,
    evaluations: Sequence[Sequence[Command]],
    environments: int = 16,
    ended: Callable[[], object] = lambda: None,
) -> list[EvaluationResult]:
    """Run several evaluations together, so that all environments stay busy.

    Each result equals that of :func:`evaluate`: an episode depends only on its command.

    Args:
        agent: the agent.
        evaluations: the commands of each evaluation, at least one.
        environments: most episodes at the same time.
        ended: called at the end of each episode.

    Raises:
        EnvironmentFault: the environment failed three times under the same command.
    """
    # Evaluations of the same run use the same command ids, so make them unique.
    first = evaluations[0][0].id if evaluations else 0
    numbered = [
        msgspec.structs.replace(command, id=first + k)
        for k, command in enumerate(chain.from_iterable(evaluations))
    ]
    outcomes = [(0.0, 0)] * len(numbered)
    at_once = max(1, min(environments, len(numbered)))
    with closing(EpisodeGenerator(agent.config, at_once)) as generator:
        for episode in iterate_episodes(generator, numbered, agent.behavior):
            outcomes[episode.command_id - first] = episode.episode_return, episode.length
            ended()
    following = iter(outcomes)
    results = []
    for commands in evaluations:
        returns, lengths = zip(*islice(following, len(commands)), strict=True)
        command = commands[0]
        results.append(
            EvaluationResult(
                command.desired_return, command.desired_horizon, command.temperature,
                summarise(returns), list(returns), list(lengths),
            )
        )  # fmt: skip
    return results
