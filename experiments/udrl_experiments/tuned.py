"""Hyperparameters of algorithms other than UDRL: their names, and the values in ``tuned.toml``."""

import tomllib
from collections.abc import Mapping
from importlib import resources
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from udrl.config import KeywordValue, build
from udrl.errors import ConfigError
from udrl.setting_groups import Count, PositiveInt
from udrl_experiments.protocol import BaselineAlgorithm

Part = Annotated[float, Meta(ge=0, le=1)]
Rate = Annotated[float, Meta(gt=0, le=10)]
Coefficient = Annotated[float, Meta(ge=0, le=1e6)]


class DqnHyperparameters(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """DQN's, by Stable-Baselines3's names and with its defaults.

    Attributes:
        activation: of the fully connected layers.
        batch_size: transitions in one update.
        buffer_size: transitions that the replay buffer holds.
        gamma: discount factor.
        exploration_fraction: part of a run in which the part of random actions falls, from 1.
        exploration_final_eps: what it falls to.
        learning_rate: Adam's.
        train_freq: env steps between updates.
        target_update_interval: env steps between updates of the target network.
        learning_starts: env steps of random actions before the first update.
        gradient_steps: updates every ``train_freq`` env steps; -1: as many as these.
        n_steps: rewards in a return before it is bootstrapped.
    """

    activation: Literal["relu", "tanh"] = "relu"
    batch_size: PositiveInt = 32
    buffer_size: PositiveInt = 1_000_000
    gamma: Part = 0.99
    exploration_fraction: Part = 0.1
    exploration_final_eps: Part = 0.05
    learning_rate: Rate = 1e-4
    train_freq: PositiveInt = 4
    target_update_interval: PositiveInt = 10_000
    learning_starts: Count = 100
    gradient_steps: Annotated[int, Meta(ge=-1, le=100_000)] = 1
    n_steps: PositiveInt = 1


class A2cHyperparameters(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A2C's, by Stable-Baselines3's names and with its defaults; it has none for ``n_envs``.

    Attributes:
        activation: of the fully connected layers.
        gamma: discount factor.
        ent_coef: factor of the entropy in the loss.
        learning_rate: RMSprop's.
        vf_coef: factor of the value function's error in the loss.
        rms_prop_decay: alpha, RMSprop's decay.
        n_steps: steps of each environment before an update.
        n_envs: environments that it acts in at the same time.
        gae_lambda: of generalised advantage estimation; 1: advantages as in the paper.
        normalize_advantage: scale the advantages of an update to a standard deviation of 1.
    """

    activation: Literal["relu", "tanh"] = "tanh"
    gamma: Part = 0.99
    ent_coef: Coefficient = 0.0
    learning_rate: Rate = 7e-4
    vf_coef: Coefficient = 0.5
    rms_prop_decay: Part = 0.99
    n_steps: PositiveInt = 5
    n_envs: Annotated[int, Meta(ge=1, le=1024)] = 8
    gae_lambda: Part = 1.0
    normalize_advantage: bool = False


class PpoHyperparameters(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """PPO's, by Stable-Baselines3's names and with its defaults; it has none for ``n_envs``.

    Attributes:
        activation: of the fully connected layers.
        gamma: discount factor.
        learning_rate: Adam's.
        n_envs: environments that it acts in at the same time.
        n_steps: steps of each environment before an update.
        batch_size: of a minibatch, in env steps.
        n_epochs: passes over the steps of an update.
        gae_lambda: of generalised advantage estimation.
        clip_range: largest change of an action's probability ratio that is rewarded.
        ent_coef: factor of the entropy in the loss.
        vf_coef: factor of the value function's error in the loss.
        max_grad_norm: gradients are scaled down to this norm.
    """

    activation: Literal["relu", "tanh"] = "tanh"
    gamma: Part = 0.99
    learning_rate: Rate = 3e-4
    n_envs: Annotated[int, Meta(ge=1, le=1024)] = 1
    # Advantages are divided by the standard deviation of a minibatch, which takes two.
    n_steps: Annotated[int, Meta(ge=2)] = 2048
    batch_size: Annotated[int, Meta(ge=2)] = 64
    n_epochs: PositiveInt = 10
    gae_lambda: Part = 0.95
    clip_range: Annotated[float, Meta(gt=0, le=1)] = 0.2
    ent_coef: Coefficient = 0.0
    vf_coef: Coefficient = 0.5
    max_grad_norm: Annotated[float, Meta(gt=0, le=1e6)] = 0.5


Hyperparameters = DqnHyperparameters | A2cHyperparameters | PpoHyperparameters

_KINDS: dict[BaselineAlgorithm, type[Hyperparameters]] = {
    "DQN": DqnHyperparameters,
    "A2C": A2cHyperparameters,
    "PPO": PpoHyperparameters,
}


def complete(algorithm: BaselineAlgorithm, chosen: Mapping[str, KeywordValue]) -> Hyperparameters:
    """Return some hyperparameters and the defaults of all others.

    Raises:
        ConfigError: a name is unknown or a value impossible.
    """
    kind = _KINDS[algorithm]
    for name in chosen:
        if name not in kind.__struct_fields__:
            raise ConfigError(
                f"unknown hyperparameter {name!r} of {algorithm}: "
                f"there are {', '.join(kind.__struct_fields__)}"
            )
    return build(kind, chosen)


def tuned(algorithm: BaselineAlgorithm, environment: str) -> dict[str, KeywordValue]:
    """Return an algorithm's hyperparameters for an environment.

    Raises:
        ConfigError: there are none.
    """
    text = (resources.files("udrl_experiments") / "tuned.toml").read_text(encoding="utf-8")
    shipped: dict[str, dict[str, dict[str, KeywordValue]]] = tomllib.loads(text)
    if environment not in shipped:
        raise ConfigError(
            f"no hyperparameters of {algorithm} ship for {environment!r}: "
            f"there are some for {', '.join(shipped)}"
        )
    return shipped[environment][algorithm]
