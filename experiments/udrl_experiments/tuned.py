"""Hyperparameters of algorithms other than UDRL: names, defaults, and values in ``tuned.toml``."""

import tomllib
from collections.abc import Mapping
from importlib import resources
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
from msgspec import Meta

from udrl.config import KeywordValue, build
from udrl.errors import ConfigError
from udrl.setting_groups import Count, PositiveInt
from udrl_experiments.protocol import NETWORKS, BaselineAlgorithm

Fraction = Annotated[float, Meta(ge=0, le=1)]
Rate = Annotated[float, Meta(gt=0, le=10)]
Coefficient = Annotated[float, Meta(ge=0, le=1e6)]


class DqnHyperparameters(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Hyperparameters of DQN, with Stable-Baselines3's names and defaults.

    Attributes:
        activation: activation function of the fully connected layers.
        batch_size: transitions per update.
        buffer_size: capacity of the replay buffer in transitions.
        gamma: discount factor.
        exploration_fraction: fraction of a run over which the exploration rate decreases from 1.
        exploration_final_eps: final exploration rate.
        learning_rate: learning rate of Adam.
        train_freq: env steps between updates.
        target_update_interval: env steps between updates of the target network.
        learning_starts: env steps of random actions before the first update.
        gradient_steps: updates every ``train_freq`` env steps; -1: one per env step.
        n_steps: number of rewards in an n-step return.
    """

    activation: Literal["relu", "tanh"] = "relu"
    batch_size: PositiveInt = 32
    buffer_size: PositiveInt = 1_000_000
    gamma: Fraction = 0.99
    exploration_fraction: Fraction = 0.1
    exploration_final_eps: Fraction = 0.05
    learning_rate: Rate = 1e-4
    train_freq: PositiveInt = 4
    target_update_interval: PositiveInt = 10_000
    learning_starts: Count = 100
    gradient_steps: Annotated[int, Meta(ge=-1, le=100_000)] = 1
    n_steps: PositiveInt = 1


class A2cHyperparameters(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Hyperparameters of A2C, with Stable-Baselines3's names and defaults, except for ``n_envs``.

    Attributes:
        activation: activation function of the fully connected layers.
        gamma: discount factor.
        ent_coef: coefficient of the entropy in the loss.
        learning_rate: learning rate of RMSprop.
        vf_coef: coefficient of the value loss.
        rms_prop_decay: alpha, the decay of RMSprop.
        n_steps: steps per environment and update.
        n_envs: number of parallel environments.
        gae_lambda: lambda of generalised advantage estimation; 1: advantages as in the paper.
        normalize_advantage: normalise the advantages of an update to mean 0 and standard deviation
            1.
    """

    activation: Literal["relu", "tanh"] = "tanh"
    gamma: Fraction = 0.99
    ent_coef: Coefficient = 0.0
    learning_rate: Rate = 7e-4
    vf_coef: Coefficient = 0.5
    rms_prop_decay: Fraction = 0.99
    n_steps: PositiveInt = 5
    n_envs: Annotated[int, Meta(ge=1, le=1024)] = 8
    gae_lambda: Fraction = 1.0
    normalize_advantage: bool = False


class PpoHyperparameters(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Hyperparameters of PPO, with Stable-Baselines3's names and defaults, except for ``n_envs``.

    Attributes:
        activation: activation function of the fully connected layers.
        gamma: discount factor.
        learning_rate: learning rate of Adam.
        n_envs: number of parallel environments.
        n_steps: steps per environment and update.
        batch_size: env steps per minibatch.
        n_epochs: passes over the steps of an update.
        gae_lambda: lambda of generalised advantage estimation.
        clip_range: range to which the probability ratio of an action is clipped, around 1.
        ent_coef: coefficient of the entropy in the loss.
        vf_coef: coefficient of the value loss.
        max_grad_norm: maximum norm of the gradient, which is clipped.
    """

    activation: Literal["relu", "tanh"] = "tanh"
    gamma: Fraction = 0.99
    learning_rate: Rate = 3e-4
    n_envs: Annotated[int, Meta(ge=1, le=1024)] = 1
    # At least 2: advantages are divided by their standard deviation in a minibatch.
    n_steps: Annotated[int, Meta(ge=2)] = 2048
    batch_size: Annotated[int, Meta(ge=2)] = 64
    n_epochs: PositiveInt = 10
    gae_lambda: Fraction = 0.95
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
    """Return all hyperparameters, with defaults for those that are not given.

    Raises:
        ConfigError: a name is unknown or a value is invalid.
    """
    kind = _KINDS[algorithm]
    for name in chosen:
        if name not in kind.__struct_fields__:
            raise ConfigError(
                f"unknown hyperparameter {name!r} of {algorithm}: "
                f"expected one of {', '.join(kind.__struct_fields__)}"
            )
    return build(kind, chosen)


class Tuned(NamedTuple):
    """Settings of an algorithm for an environment.

    Attributes:
        hyperparameters: those that differ from the defaults.
        networks: settings of the networks (:data:`~udrl_experiments.protocol.NETWORKS`) that
            differ from those of UDRL's preset.
    """

    hyperparameters: dict[str, KeywordValue]
    networks: dict[str, Any]


def tuned(algorithm: BaselineAlgorithm, environment: str) -> Tuned:
    """Return an algorithm's settings for an environment from ``tuned.toml``.

    Raises:
        ConfigError: ``tuned.toml`` has none.
    """
    text = (resources.files("udrl_experiments") / "tuned.toml").read_text(encoding="utf-8")
    shipped: dict[str, dict[str, dict[str, Any]]] = tomllib.loads(text)
    chosen = shipped.get(environment, {}).get(algorithm)
    if chosen is None:
        known = ", ".join(name for name, of in shipped.items() if algorithm in of)
        raise ConfigError(
            f"tuned.toml has no hyperparameters of {algorithm} for {environment!r}, only for "
            f"{known}; search for some with: udrl study search {environment} --space FILE"
        )
    networks = {name: chosen.pop(name) for name in NETWORKS if name in chosen}
    return Tuned(chosen, networks)
