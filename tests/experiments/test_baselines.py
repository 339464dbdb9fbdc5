import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import gymnasium as gym
import msgspec
import numpy as np
import numpy.typing as npt
import pytest
import safetensors.torch
import torch
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from stable_baselines3 import DQN
from torch import Tensor, nn

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.behavior import BehaviorFunction
from udrl.commands import Command, CommandSampler
from udrl.config import Config, KeywordValue, build
from udrl.environments.making import make_environment
from udrl.environments.specification import specify
from udrl.errors import ConfigError, InvalidData
from udrl.frame_stack import FrameStack
from udrl.replay_buffer import Entry, ReplayBuffer
from udrl_experiments import baselines, policies
from udrl_experiments.baselines import train_baseline
from udrl_experiments.jobs import Job, make_job
from udrl_experiments.protocol import TASKS, BaselineAlgorithm, Task
from udrl_experiments.records import EvaluationRecord
from udrl_experiments.search_space import shipped_space
from udrl_experiments.tuned import PpoHyperparameters, complete, tuned
from udrl_inspect.csv_tables import read

ALGORITHMS: tuple[BaselineAlgorithm, ...] = get_args(BaselineAlgorithm)
FAST: dict[str, dict[str, KeywordValue]] = {
    "DQN": {"buffer_size": 500, "learning_starts": 50, "train_freq": 4},
    "A2C": {"n_envs": 2, "n_steps": 5},
    "PPO": {"n_envs": 2, "n_steps": 5, "batch_size": 5, "n_epochs": 2},
}

seeds: list[int | None] = []


class Balance(CartPoleEnv):
    """CartPole that records its reset seeds."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        seeds.append(seed)
        observation, info = super().reset(seed=seed, options=options)
        return observation, info


class Pictures(gym.Env[npt.NDArray[np.uint8], np.int64]):
    """Small images of noise; the number of stacked frames is not the smallest dimension."""

    observation_space = gym.spaces.Box(0, 255, (5, 6), np.uint8)
    action_space = gym.spaces.Discrete(3)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.uint8], dict[str, Any]]:
        super().reset(seed=seed)
        return self._picture(), {}

    def step(
        self, action: np.int64
    ) -> tuple[npt.NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        return self._picture(), 1.0, False, False, {}

    def _picture(self) -> npt.NDArray[np.uint8]:
        return self.np_random.integers(0, 256, (5, 6), np.uint8)


@pytest.fixture(autouse=True)
def _environments() -> Iterator[None]:
    gym.register("Balance-v0", lambda **_: Balance(), max_episode_steps=100)
    gym.register("Pictures-v0", lambda **_: Pictures(), max_episode_steps=20)
    seeds.clear()
    yield
    del gym.registry["Balance-v0"], gym.registry["Pictures-v0"]


def baseline(
    algorithm: BaselineAlgorithm,
    max_env_steps: int = 600,
    hyperparameters: dict[str, KeywordValue] | None = None,
    **changes: Any,
) -> Job:
    settings = {"environment": "Balance-v0", "hidden": [16, 8], "eval_every": 200} | changes
    config = build(Config, {"eval_episodes": 4} | settings)
    chosen = FAST[algorithm] if hyperparameters is None else hyperparameters
    return make_job(algorithm, config, max_env_steps, hyperparameters=chosen)


def pictures(algorithm: BaselineAlgorithm, max_env_steps: int = 600) -> Job:
    return baseline(
        algorithm, max_env_steps, environment="Pictures-v0", frame_stack=7, convolutions=[4, 5]
    )


def made(job: Job) -> policies.Model:
    assert job.algorithm != "UDRL"
    chosen = complete(job.algorithm, job.hyperparameters)
    return policies.make(job.algorithm, msgspec.structs.asdict(chosen), job.config)


def held(folder: Path) -> dict[str, Tensor]:
    return safetensors.torch.load_file(folder / "state.safetensors")


class Stopped(Exception):
    pass


def stop_after(n: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stop a run after its n-th evaluation, before it writes its table."""

    def write(path: Path, kind: type[EvaluationRecord], rows: list[EvaluationRecord]) -> None:
        if len(rows) == n:
            raise Stopped

    monkeypatch.setattr(baselines, "write", write)


@pytest.mark.parametrize(
    ("algorithm", "hyperparameters", "steps"),
    [
        ("DQN", {"learning_rate": 2.3e-3, "batch_size": 64, "learning_starts": 500,
                 "target_update_interval": 10, "train_freq": 64, "gradient_steps": 32,
                 "exploration_fraction": 0.2}, 3840),
        ("A2C", {"n_envs": 8, "n_steps": 16, "learning_rate": 2e-3}, 4096),
        ("PPO", {"n_envs": 8, "n_steps": 32, "learning_rate": 2e-3}, 4096),
    ],
)  # fmt: skip
def test_baseline_learns(
    algorithm: BaselineAlgorithm,
    hyperparameters: dict[str, KeywordValue],
    steps: int,
    tmp_path: Path,
) -> None:
    changes: dict[str, Any] = {"hidden": [64, 64], "eval_every": steps // 2, "eval_episodes": 20}
    rows = train_baseline(baseline(algorithm, steps, hyperparameters, **changes), tmp_path)
    assert [row.env_steps for row in rows] == [steps // 2, steps]
    assert rows[-1].mean > 60  # random actions: 22
    assert rows == read(tmp_path / "evaluations.csv", EvaluationRecord)
    first = rows[0]
    assert (first.environment, first.algorithm, first.seed) == ("Balance-v0", algorithm, 1)
    assert first.episodes == 20


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_baseline_trains_on_images(algorithm: BaselineAlgorithm, tmp_path: Path) -> None:
    rows = train_baseline(pictures(algorithm, 450), tmp_path)
    assert [row.env_steps for row in rows][:2] == [200, 400]
    assert 450 <= rows[-1].env_steps < 460
    assert all(row.mean == 20 for row in rows)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("make", [baseline, pictures])
def test_networks_equal_the_behavior_functions(algorithm: BaselineAlgorithm, make: Any) -> None:
    """With an open gate, both are the same function of the same layers."""
    wanted: Job = make(algorithm)
    if algorithm != "DQN":
        wanted = msgspec.structs.replace(wanted, hyperparameters={"activation": "relu"})
    model, config = made(wanted), wanted.config
    spec = specify(make_environment(config), config)
    behavior = BehaviorFunction(spec, config)
    (seen,) = FrameStack(spec.observation_space, config.network.frame_stack).shapes
    if isinstance(model, DQN):
        parts: list[nn.Module] = [model.q_net]
    else:
        policy = model.policy
        parts = [policy.features_extractor, policy.mlp_extractor.policy_net, policy.action_net]
        assert len(policy.mlp_extractor.value_net) == len(policy.mlp_extractor.policy_net)
    ours = [p for n, p in behavior.named_parameters() if not n.startswith("command.")]
    theirs = [p for part in parts for p in part.parameters()]
    if make is baseline:  # the first layer of vectors is declared before the others here too
        assert ours[0].shape == (16, 4)
    assert [p.shape for p in ours] == [p.shape for p in theirs]

    nn.init.zeros_(behavior.command.weight)
    nn.init.constant_(behavior.command.bias, 100.0)
    generator = np.random.default_rng(1)
    shape = (5, *seen)
    observation = torch.from_numpy(
        generator.integers(0, 256, shape, np.uint8) if make is pictures
        else generator.normal(size=shape).astype(np.float32)
    )  # fmt: skip
    with torch.no_grad():
        for mine, their in zip(ours, theirs, strict=True):
            mine.copy_(their)
        expected = behavior((observation,), torch.zeros(5, 2))
        call = policies.ModelPolicy(model, seen).call(5)
        call.seen[0][:] = observation.numpy()
        call.run()
        logits = torch.from_numpy(call.logits)
    if algorithm != "DQN":
        expected = expected.log_softmax(dim=1)
    torch.testing.assert_close(logits, expected)


def test_training_inputs_are_the_most_recent_frames() -> None:
    model = made(pictures("DQN"))
    assert model.env is not None
    first = model.env.reset()
    assert isinstance(first, np.ndarray)
    assert first.shape == (1, 7, 1, 5, 6)
    assert (first == first[:, :1]).all()
    second, *_ = model.env.step(np.array([0]))
    assert isinstance(second, np.ndarray)
    np.testing.assert_array_equal(second[:, :6], first[:, 1:])
    assert (second[:, 6] != first[:, 6]).any()


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_reset_seeds_are_from_the_ranges(algorithm: BaselineAlgorithm, tmp_path: Path) -> None:
    config = baseline(algorithm).config
    train_baseline(baseline(algorithm, 400), tmp_path)
    in_training = [s for s in seeds if s is not None and 1_000_000 <= s < 10_000_000]
    in_evaluation = [s for s in seeds if s is not None and 1 <= s < 500_000]
    assert len(in_training) + len(in_evaluation) == len(seeds)
    assert len(set(in_training)) == len(in_training) > 5

    sampler = CommandSampler(config, specify(make_environment(config), config))
    buffer = ReplayBuffer(config.buffer, [Entry(30.0, 7, 30)])
    udrl = [c.environment_seed for i in (1, 2) for c in sampler.evaluate(i, buffer)]
    assert in_evaluation == udrl


def test_search_uses_its_own_reset_seeds(tmp_path: Path) -> None:
    train_baseline(baseline("A2C", 200, eval_seeds="search"), tmp_path)
    assert sum(500_000 <= (s or 0) < 1_000_000 for s in seeds) == 4


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_evaluations_act_like_udrl(
    algorithm: BaselineAlgorithm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    temperatures: list[float] = []

    def watched(generator: EpisodeGenerator, commands: list[Command], behavior: Any) -> Any:
        temperatures.extend(command.temperature for command in commands)
        before = torch.get_rng_state()
        episodes = generate_episodes(generator, commands, behavior)
        assert torch.equal(torch.get_rng_state(), before)
        return episodes

    monkeypatch.setattr(baselines, "generate_episodes", watched)
    train_baseline(baseline(algorithm, 200), tmp_path)
    assert temperatures == [float(algorithm != "DQN")] * 4


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_evaluations_do_not_change_training(algorithm: BaselineAlgorithm, tmp_path: Path) -> None:
    often = train_baseline(baseline(algorithm, 400), tmp_path / "often")
    once = train_baseline(baseline(algorithm, 400, eval_every=400), tmp_path / "once")
    assert (len(often), len(once)) == (2, 1)
    tensors = held(tmp_path / "often")
    others = held(tmp_path / "once")
    assert tensors.keys() == others.keys()
    assert all(torch.equal(tensors[name], others[name]) for name in tensors)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("make", [baseline, pictures])
def test_resumed_run_equals_an_uninterrupted_one(
    algorithm: BaselineAlgorithm, make: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        stop_after(2, patch)
        with pytest.raises(Stopped):
            train_baseline(make(algorithm), tmp_path)
    saved = held(tmp_path)

    restored: list[dict[str, Tensor]] = []
    counted: list[dict[str, int]] = []

    def restore(model: policies.Model, *arguments: Any) -> None:
        original(model, *arguments)
        restored.append({n: t.clone() for n, t in policies.tensors(model).items()})
        counted.append(policies.counters(model))

    original = policies.restore
    monkeypatch.setattr(policies, "restore", restore)
    rows = train_baseline(make(algorithm), tmp_path)
    assert [row.env_steps for row in rows] == [200, 400, 600]
    assert rows == read(tmp_path / "evaluations.csv", EvaluationRecord)
    assert 0 < rows[0].wall_s < rows[1].wall_s < rows[2].wall_s

    (tensors,), (counters,) = restored, counted
    assert tensors.keys() == saved.keys()
    assert all(torch.equal(tensors[name], saved[name]) for name in saved)
    assert counters["num_timesteps"] == 400
    assert any(name.startswith("optimizer.") for name in saved)
    assert (algorithm == "DQN") == ("replay.observations" in saved)


def test_full_replay_buffer_is_restored(tmp_path: Path) -> None:
    small = baseline("DQN", 200, FAST["DQN"] | {"buffer_size": 150, "n_steps": 3})
    train_baseline(small, tmp_path)
    model, saved = made(small), held(tmp_path)
    policies.restore(model, saved, {"num_timesteps": 0, "_n_updates": 0, "_n_calls": 0,
                                    "_episode_num": 0, "pos": 50})  # fmt: skip
    assert isinstance(model, DQN)
    buffer = model.replay_buffer
    assert buffer is not None
    assert (buffer.full, buffer.pos) == (True, 50)
    np.testing.assert_array_equal(buffer.observations, saved["replay.observations"].numpy())
    # The unfinished episode is truncated, so that no three-step return reaches into the next one.
    assert buffer.dones[49] or buffer.timeouts[49]


def test_run_resumes_after_a_kill_while_saving(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = safetensors.torch.save_file
    saved: list[Path] = []

    def save(tensors: dict[str, Tensor], path: Path, metadata: dict[str, str]) -> None:
        saved.append(path)
        if len(saved) == 2:
            path.write_bytes(b"half")
            raise Stopped
        original(tensors, path, metadata)

    monkeypatch.setattr(safetensors.torch, "save_file", save)
    with pytest.raises(Stopped):
        train_baseline(baseline("DQN"), tmp_path)
    rows = train_baseline(baseline("DQN"), tmp_path)
    assert [row.env_steps for row in rows] == [200, 400, 600]


def test_extended_run_keeps_its_exploration_schedule(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    explored: list[int] = []
    original = policies.set_exploration

    def set_exploration(model: policies.Model, env_steps: int) -> None:
        original(model, env_steps)
        assert isinstance(model, DQN)
        explored.append(env_steps)
        rate = 0.05 + 0.95 * max(0.0, 1 - model.num_timesteps / env_steps)
        assert model.exploration_rate == pytest.approx(rate)

    monkeypatch.setattr(policies, "set_exploration", set_exploration)
    train_baseline(baseline("DQN", 100), tmp_path)
    rows = train_baseline(baseline("DQN", 400), tmp_path)
    assert explored == [10, 10]
    assert [row.env_steps for row in rows] == [100, 200, 400]
    assert train_baseline(baseline("DQN", 300), tmp_path) == rows


@pytest.mark.parametrize("damage", ["shorter", "other tensors", "no state"])
def test_damaged_state_is_rejected(damage: str, tmp_path: Path) -> None:
    train_baseline(baseline("DQN", 200), tmp_path)
    path = tmp_path / "state.safetensors"
    if damage == "shorter":
        path.write_bytes(path.read_bytes()[:-1])
    else:
        with safetensors.safe_open(path, "pt") as file:
            metadata = file.metadata() if damage == "other tensors" else None
        safetensors.torch.save_file({"odd": torch.zeros(1)}, path, metadata)
    with pytest.raises(InvalidData, match=rf"{path}.*delete the folder {tmp_path}"):
        train_baseline(baseline("DQN", 400), tmp_path)


def test_missing_stable_baselines3_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    with pytest.raises(ConfigError, match=r'pip install "udrl\[studies\]"'):
        train_baseline(baseline("DQN", 100), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("environment", ["LunarLander-v3", "LunarLanderSparse-v3", "TakeCover-v0"])
@pytest.mark.parametrize("algorithm", ["DQN", "A2C"])
def test_shipped_hyperparameters_are_in_the_papers_lists(algorithm: Any, environment: str) -> None:
    space = shipped_space(environment)
    chosen, networks = tuned(algorithm, environment)
    complete(algorithm, chosen)
    for name, value in networks.items():
        assert value in space.networks[name], name
    for name, values in space.lists[algorithm].items():
        if name == "learning_rate":
            assert np.isclose(values, chosen[name], rtol=1e-3).any()
        else:
            assert chosen[name] in values, name


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_minibatches_of_ppo_divide_its_rollouts(task: Task) -> None:
    shipped = complete("PPO", tuned("PPO", task.environment).hyperparameters)
    assert isinstance(shipped, PpoHyperparameters)
    assert (shipped.n_envs * shipped.n_steps) % shipped.batch_size == 0
    # Every point of a curve has exactly one evaluation.
    assert shipped.n_envs * shipped.n_steps < 50_000


def test_other_environments_have_no_hyperparameters() -> None:
    with pytest.raises(ConfigError, match=r"'CartPole-v1'.*TakeCover-v0"):
        tuned("DQN", "CartPole-v1")
