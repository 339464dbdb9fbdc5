"""Models of Stable-Baselines3 with the behavior function's networks (section 3.2).

This module imports Stable-Baselines3, so :mod:`udrl_experiments.baselines` imports it on first use.
"""

from collections.abc import Mapping
from functools import partial
from itertools import pairwise
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import Tensor, nn

from udrl.commands import TRAINING_SEEDS
from udrl.config import Config
from udrl.environments.adapter import Environment
from udrl.environments.making import make_environment
from udrl.frame_stack import Seen
from udrl.inference import Call
from udrl.streams import Purpose, Stream, stream_key
from udrl_experiments.protocol import BaselineAlgorithm

Model = DQN | A2C | PPO

_ACTIVATIONS = {"relu": nn.ReLU, "tanh": nn.Tanh}

#: Stable-Baselines3's default, which does not apply if the optimizer's arguments are given.
_RMS_PROP_EPS = 1e-5

#: Attributes of a model that are part of its state, besides tensors.
_COUNTERS = ("num_timesteps", "_n_updates", "_n_calls", "_episode_num")
#: Arrays of DQN's replay buffer, which are part of the state as tensors.
_TRANSITIONS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class TrainingResets(gym.Wrapper[Any, Any, Any, Any]):
    """Resets an environment with the paper's training seeds, and ignores the seed argument.

    Args:
        env: the environment.
        stream: random stream of the seeds.
    """

    def __init__(self, env: Environment, stream: Stream) -> None:
        super().__init__(env)
        self._stream = stream

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode with the next seed of the stream."""
        (seed,) = self._stream.integers(1, *TRAINING_SEEDS).tolist()
        return self.env.reset(seed=seed, options=options)


class Convolutions(BaseFeaturesExtractor):
    """The behavior function's convolutional layers (Appendix B.2).

    Args:
        observation_space: uint8 images, [frame_stack, channels, height, width].
        channels: output channels of each layer.
    """

    def __init__(self, observation_space: spaces.Box, channels: tuple[int, ...]) -> None:
        frames, colours, *size = observation_space.shape
        layers: list[nn.Module] = []
        for before, after in pairwise((frames * colours, *channels)):
            layers += [nn.Conv2d(before, after, 3, 2, 1), nn.ReLU()]
        embed = nn.Sequential(*layers, nn.Flatten())
        with torch.no_grad():
            embedding = embed(torch.zeros(1, frames * colours, *size))
        super().__init__(observation_space, embedding.shape[1])
        self.embed = embed

    def forward(self, observations: Tensor) -> Tensor:
        """Return the embedding of images.

        Args:
            observations: float32 [n, frame_stack, channels, height, width], from 0 to 255.

        Returns:
            float32 [n, features_dim].
        """
        embedding: Tensor = self.embed(observations.flatten(1, 2) * (1 / 255))
        return embedding


def make(
    algorithm: BaselineAlgorithm,
    hyperparameters: Mapping[str, Any],
    config: Config,
    part: int = 0,
) -> Model:
    """Return an untrained model with its environments.

    Args:
        algorithm: the algorithm.
        hyperparameters: all hyperparameters of the algorithm (:mod:`udrl_experiments.tuned`).
        config: environment, networks, seed and device, which must not be ``auto``.
        part: number of evaluations before this process; a resumed run has other random numbers.

    Raises:
        UnsupportedEnvironment: the environment cannot be created or is not supported.
    """
    chosen = dict(hyperparameters)
    envs = DummyVecEnv(
        [partial(_environment, config, part, i) for i in range(chosen.pop("n_envs", 1))]
    )
    networks: dict[str, Any] = {
        "net_arch": list(config.network.hidden),
        "activation_fn": _ACTIVATIONS[chosen.pop("activation")],
    }
    policy = "MlpPolicy"
    if len(envs.observation_space.shape or ()) == 4:
        policy = "CnnPolicy"
        networks["features_extractor_class"] = Convolutions
        networks["features_extractor_kwargs"] = {"channels": config.network.convolutions}
    # Stable-Baselines3 seeds numpy's global generator, which takes 32 bits.
    (seed,) = Stream(stream_key(config.seed, Purpose.INITIALISE, part)).integers(1, 0, 2**32)
    common: dict[str, Any] = {
        "policy_kwargs": networks, "seed": int(seed), "device": config.arithmetic.device,
    }  # fmt: skip
    model: Model
    if algorithm == "DQN":
        del chosen["exploration_fraction"]  # see `set_exploration`
        model = DQN(policy, envs, **chosen, **common)
    elif algorithm == "PPO":
        model = PPO(policy, envs, **chosen, **common)
    else:
        networks["optimizer_class"] = torch.optim.RMSprop
        networks["optimizer_kwargs"] = {
            "alpha": chosen.pop("rms_prop_decay"), "eps": _RMS_PROP_EPS,
        }  # fmt: skip
        model = A2C(policy, envs, **chosen, **common)
    model.set_logger(Logger(None, []))  # the default logger creates a folder in /tmp
    return model


def _environment(config: Config, part: int, index: int) -> Environment:
    env: Environment = make_environment(config)
    # With a dimension for frames, even for a single one, Stable-Baselines3 does not guess which
    # dimension of an image has the channels.
    env = gym.wrappers.FrameStackObservation(env, config.network.frame_stack)
    return TrainingResets(env, Stream(stream_key(config.seed, Purpose.TRAINING, part, index)))


def set_exploration(model: Model, env_steps: int) -> None:
    """Decrease DQN's exploration rate linearly over ``env_steps``; ignore other models.

    Stable-Baselines3's own schedule restarts with every call of ``learn``.
    """
    if not isinstance(model, DQN):
        return
    last = model.exploration_final_eps

    def rate(_: float = 1.0) -> float:
        return last + (1.0 - last) * max(0.0, 1.0 - model.num_timesteps / max(1, env_steps))

    model.exploration_schedule, model.exploration_rate = rate, rate()


class ModelPolicy:
    """A model as a policy for :mod:`udrl.acting`. It ignores commands.

    Args:
        model: the model; it must not be trained while the policy is in use.
        shape: shape of an observation, with frames stacked along the first dimension.
    """

    def __init__(self, model: Model, shape: tuple[int, ...]) -> None:
        model.policy.set_training_mode(mode=False)
        self.model = model
        self.shape = shape

    def call(self, n: int) -> Call:
        """Return a call of ``n`` rows."""
        return _ModelCall(self, n)


class _ModelCall:
    def __init__(self, policy: ModelPolicy, n: int) -> None:
        self._model = policy.model
        space = policy.model.observation_space
        self.seen: Seen = (np.zeros((n, *policy.shape), space.dtype),)
        self.state = self.next_state = np.zeros((n, 0), np.float32)
        self.command = np.zeros((n, 2))
        assert isinstance(policy.model.action_space, spaces.Discrete)
        self.logits = np.zeros((n, int(policy.model.action_space.n)), np.float32)

    def run(self) -> None:
        """Compute the logits. DQN's are Q-values: their maximum is the greedy action."""
        model = self._model
        shape = model.observation_space.shape
        assert shape is not None
        with torch.inference_mode():
            seen = torch.from_numpy(self.seen[0]).reshape(-1, *shape).to(model.device)
            if isinstance(model, DQN):
                logits: Tensor = model.q_net(seen)
            else:
                distribution = model.policy.get_distribution(seen).distribution
                assert isinstance(distribution, torch.distributions.Categorical)
                logits = distribution.logits
        self.logits[:] = logits.cpu().numpy()


def counters(model: Model) -> dict[str, int]:
    """Return a model's counters by name."""
    counted = {name: getattr(model, name) for name in _COUNTERS if hasattr(model, name)}
    if isinstance(model, DQN):
        assert model.replay_buffer is not None
        counted["pos"] = model.replay_buffer.pos
    return counted


def tensors(model: Model) -> dict[str, Tensor]:
    """Return weights, optimizer state and the filled part of the replay buffer, by name.

    They share memory with the model, but not with each other.
    """
    named = {f"policy.{n}": p.detach() for n, p in model.policy.named_parameters()}
    for index, state in model.policy.optimizer.state_dict()["state"].items():
        named |= {f"optimizer.{index}.{key}": value for key, value in state.items()}
    if isinstance(model, DQN):
        buffer = model.replay_buffer
        assert buffer is not None
        for name in _TRANSITIONS:
            named[f"replay.{name}"] = torch.from_numpy(getattr(buffer, name)[: buffer.size()])
    return named


def restore(model: Model, named: Mapping[str, Tensor], counted: Mapping[str, int]) -> None:
    """Restore a model from :func:`tensors` and :func:`counters`.

    Raises:
        KeyError: a tensor or counter is missing.
        ValueError: a tensor has the wrong shape.
    """
    for name in _COUNTERS:
        if hasattr(model, name):
            setattr(model, name, counted[name])
    for name, parameter in model.policy.named_parameters():
        value = named[f"policy.{name}"]
        if value.shape != parameter.shape:
            raise ValueError(
                f"{name}: shape {tuple(value.shape)}, expected {tuple(parameter.shape)}"
            )
        parameter.data.copy_(value)
    optimizer = model.policy.optimizer
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in named.items():
        if name.startswith("optimizer."):
            _, index, key = name.split(".", 2)
            state.setdefault(int(index), {})[key] = value.clone()
    optimizer.load_state_dict(optimizer.state_dict() | {"state": state})
    if isinstance(model, DQN):
        _restore_replay(model, named, counted["pos"])


def _restore_replay(model: DQN, named: Mapping[str, Tensor], pos: int) -> None:
    buffer = model.replay_buffer
    assert buffer is not None
    for name in _TRANSITIONS:
        value = named[f"replay.{name}"].numpy()
        getattr(buffer, name)[: len(value)] = value
    buffer.pos, buffer.full = pos, len(value) == buffer.buffer_size
    if model.n_steps > 1:
        # The episode in progress is lost. An n-step return must not extend into the next one.
        buffer.timeouts[pos - 1] = 1 - buffer.dones[pos - 1]
