"""Algorithms of Stable-Baselines3 under UDRL's protocol (section 3.2).

Networks and evaluations are the same as UDRL's, with reset seeds from the same ranges. An
evaluation is Algorithm 2 with commands that the policy ignores.
"""

import contextlib
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.atomic_files import replacing
from udrl.commands import CommandSampler
from udrl.config import change
from udrl.errors import ConfigError, Interrupted, InvalidData
from udrl.evaluation import Evaluation, summarise
from udrl.frame_stack import FrameStack
from udrl.inference import Acting
from udrl.numerics import resolve_arithmetic
from udrl.replay_buffer import Entry, ReplayBuffer
from udrl_experiments.jobs import Job
from udrl_experiments.records import EvaluationRecord
from udrl_experiments.tuned import complete
from udrl_inspect.csv_tables import write

if TYPE_CHECKING:
    from udrl_experiments.policies import Model

#: Number of environments of an evaluation. The result does not depend on it.
_ENVIRONMENTS = 16


class _State(msgspec.Struct, frozen=True, kw_only=True):
    """State of a run, except for tensors.

    Attributes:
        exploration_steps: env steps over which DQN's exploration rate decreases; 0 for others.
        counters: counters of the model.
        rows: the evaluations so far.
    """

    exploration_steps: int
    counters: dict[str, int]
    rows: list[EvaluationRecord]


def train_baseline(
    job: Job, folder: Path, stop: threading.Event | None = None
) -> list[EvaluationRecord]:
    """Train, or resume the run in a folder, with an evaluation every ``eval_every`` env steps.

    Training ends at the first update that reaches ``max_env_steps``; a larger one extends a
    finished run. A run is resumed from its last evaluation, without bit-identical results: episodes
    in progress are lost, and random numbers differ.

    Args:
        job: the run. A resumed run keeps its original ``exploration_steps``. DQN always acts
            greedily in evaluations.
        folder: folder of this run only. Each evaluation adds a row to ``evaluations.csv``.
        stop: ends training early. Steps since the last evaluation are lost.

    Returns:
        All evaluations of the run.

    Raises:
        ConfigError: Stable-Baselines3 is not installed, or a hyperparameter is unknown or invalid.
        UnsupportedEnvironment: the environment cannot be created or is not supported.
        EnvironmentFault: the environment failed repeatedly in an evaluation.
        InvalidData: the state in the folder is damaged.
        Interrupted: ``stop`` was set.
    """
    stop = stop or threading.Event()
    _require_stable_baselines3()
    from udrl_experiments import policies

    algorithm = job.algorithm
    assert algorithm != "UDRL"
    hyperparameters = complete(algorithm, job.hyperparameters)
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    config = resolve_arithmetic(job.config)
    path, table = folder / "state.safetensors", folder / "evaluations.csv"
    state = _State(exploration_steps=job.exploration_steps, counters={}, rows=[])
    tensors: dict[str, Tensor] = {}
    if path.exists():
        state, tensors = _load(path)
        # The process may have ended after it saved the state, and before it wrote the table.
        write(table, EvaluationRecord, state.rows)
    rows = state.rows
    began = time.monotonic() - (rows[-1].wall_s if rows else 0.0)

    with contextlib.ExitStack() as opened:
        model = policies.make(
            algorithm, msgspec.structs.asdict(hyperparameters), config, part=len(rows)
        )
        assert model.env is not None
        opened.callback(model.env.close)
        if tensors:
            with _reading(path):
                policies.restore(model, tensors, state.counters)
        tensors.clear()
        policies.set_exploration(model, state.exploration_steps)
        generator = EpisodeGenerator(config, min(_ENVIRONMENTS, config.evaluation.eval_episodes))
        opened.callback(generator.close)
        (shape,) = FrameStack(generator.spec.observation_space, config.network.frame_stack).shapes
        every = config.evaluation.eval_every
        while (env_steps := model.num_timesteps) < job.max_env_steps:
            due = (env_steps // every + 1) * every
            _learn(model, min(due, job.max_env_steps) - env_steps, stop)
            policy = policies.ModelPolicy(model, shape)
            evaluation = _evaluate(job, generator, policy, len(rows) + 1)
            row = EvaluationRecord(
                environment=config.environment, algorithm=algorithm, variant="",
                seed=config.seed, env_steps=model.num_timesteps,
                wall_s=time.monotonic() - began, mean=evaluation.mean, std=evaluation.std,
                episodes=evaluation.episodes,
            )  # fmt: skip
            rows.append(row)
            state = msgspec.structs.replace(state, counters=policies.counters(model))
            _save(path, state, policies.tensors(model))
            write(table, EvaluationRecord, rows)
    return rows


def _require_stable_baselines3() -> None:
    try:
        import stable_baselines3  # noqa: F401 - only checks that it is installed
    except ImportError as error:
        raise ConfigError(
            f"algorithms other than UDRL need Stable-Baselines3: {error}; "
            f'install it with: pip install "udrl[studies]"'
        ) from error


def _learn(model: "Model", env_steps: int, stop: threading.Event) -> None:
    """Train for a number of env steps, up to the end of an update.

    Raises:
        Interrupted: ``stop`` was set.
    """
    model.learn(
        env_steps,
        callback=lambda local, shared: not stop.is_set(),
        reset_num_timesteps=False,
    )
    if stop.is_set():
        raise Interrupted(f"stopped after {model.num_timesteps:,} env steps")


def _evaluate(job: Job, generator: EpisodeGenerator, policy: Acting, number: int) -> Evaluation:
    """Evaluate a policy as UDRL is evaluated in an iteration ``number``."""
    config = job.config
    if job.algorithm == "DQN":
        config = change(config, eval_temperature=0.0)
    sampler = CommandSampler(config, generator.spec)
    # Desired returns and horizons come from the buffer. The policy ignores them.
    buffer = ReplayBuffer(config.buffer, [Entry(0.0, 0, 1)])
    episodes = generate_episodes(generator, sampler.evaluate(number, buffer), policy)
    return summarise([episode.episode_return for episode in episodes])


def _save(path: Path, state: _State, tensors: dict[str, Tensor]) -> None:
    metadata = {"state": msgspec.json.encode(state).decode()}
    with replacing(path) as unfinished:
        safetensors.torch.save_file(tensors, unfinished, metadata)


def _load(path: Path) -> tuple[_State, dict[str, Tensor]]:
    with _reading(path), safetensors.safe_open(path, "pt") as file:
        state = msgspec.json.decode(file.metadata()["state"], type=_State)
        return state, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Raise :class:`InvalidData` in place of errors that a damaged file causes."""
    try:
        yield
    except (
        OSError, KeyError, TypeError, ValueError, msgspec.DecodeError, safetensors.SafetensorError
    ) as error:  # fmt: skip
        raise InvalidData(
            f"{path}: {type(error).__name__}: {error}; "
            f"delete the folder {path.parent} to repeat the run"
        ) from error
