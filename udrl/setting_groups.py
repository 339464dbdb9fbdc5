"""Groups of settings, one for each part of the algorithm.

A :class:`udrl.config.Config` has one group of each kind. The hyperparameters of Table 2 have the
paper's names.
"""

import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from udrl.errors import ConfigError

PositiveInt = Annotated[int, Meta(ge=1, le=2**31)]
Count = Annotated[int, Meta(ge=0, le=2**31)]
Temperature = Annotated[float, Meta(ge=0, le=1000)]
Scale = Annotated[float, Meta(gt=0, le=1e6)]
Widths = Annotated[
    tuple[Annotated[int, Meta(ge=1, le=65_536)], ...], Meta(min_length=1, max_length=16)
]


class SettingsGroup(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all groups. Every number must be finite."""

    def __post_init__(self) -> None:
        for name, value in msgspec.structs.asdict(self).items():
            if not all(map(math.isfinite, _floats(value))):
                raise ConfigError(f"{name} = {value}: expected a finite number")


def _floats(value: Any) -> Iterator[float]:
    """Yield all floats in a nested value."""
    if isinstance(value, float):
        yield value
    elif isinstance(value, dict | list | tuple):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _floats(part)


class NetworkSettings(SettingsGroup, frozen=True, kw_only=True):
    """The network, and its command input (section 3.2, Appendix B.2).

    Attributes:
        behavior: a torch module in place of the paper's network, as ``package.module:Class``
            (:mod:`udrl.custom_networks`). None: the paper's network.
        frame_stack: number of most recent observations in the input, concatenated along the first
            dimension. At the start of an episode, the first observation is repeated.
        memory: ``none``, or ``gru``: a gated recurrent unit between encoder and command, which
            remembers the episode so far (section 6).
        memory_size: units of the memory.
        normalise_observations: whether vectors are normalised by their mean and standard deviation
            in the warm-up.
        convolutions: channels of each convolutional layer, for images (3.2, B.2).
        hidden: units of each fully connected layer. For vectors, the output of the first is
            multiplied with the embedded command (3.2).
        activation: activation of the hidden layers.
        initialisation: ``orthogonal``, or ``uniform`` (PyTorch's default for linear layers).
        return_scale: factor on the desired return at the network's input.
        horizon_scale: factor on the desired horizon at the network's input. 0: the network ignores
            the horizon.
        horizon_equals_return: whether the desired horizon of exploratory and evaluation commands
            is their desired return, as an integer, for environments with a reward of 1 per step
            (TakeCover, 3.1). Otherwise it is the mean length of the best episodes.
        baseline: baseline of desired returns at the network's input. ``none``: none, as in the
            paper. ``value``: a learned value function. ``action_value``: the same, with examples
            labelled with the average outcome of their action (:mod:`udrl.value`).
        advantage_bound: with a ``baseline``, largest absolute value of relative desired returns, in
            mean absolute deviations of the return.
        guidance_kl: mean KL divergence, in nats, of the policy for the highest return from that for
            the lowest, to which guidance raises it (:mod:`udrl.guidance`). 0: no guidance.
    """

    behavior: Annotated[str, Meta(min_length=1, max_length=200)] | None = None
    frame_stack: Annotated[int, Meta(ge=1, le=64)] = 1
    memory: Literal["none", "gru"] = "none"
    memory_size: Annotated[int, Meta(ge=1, le=65_536)] = 64
    normalise_observations: bool = False
    convolutions: Widths = (32, 48, 96, 128)
    hidden: Widths = (32, 128, 128, 128)
    activation: Literal["relu", "tanh"] = "relu"
    initialisation: Literal["orthogonal", "uniform"] = "orthogonal"
    return_scale: Scale = 0.025
    horizon_scale: Annotated[float, Meta(ge=0, le=1e6)] = 0.01
    horizon_equals_return: bool = False
    baseline: Literal["none", "value", "action_value"] = "none"
    advantage_bound: Annotated[float, Meta(gt=0, le=1000)] = 2.0
    guidance_kl: Annotated[float, Meta(ge=0, le=100)] = 0.0

    @property
    def is_guided(self) -> bool:
        """Whether acting uses guidance."""
        return self.guidance_kl > 0


class ActionSettings(SettingsGroup, frozen=True, kw_only=True):
    """The action space (:mod:`udrl.environments.action_conversions`).

    Attributes:
        action_mask: where the environment provides its action mask: ``info`` for
            ``info["action_mask"]``, or the name of an entry of a ``Dict`` observation. None: all
            actions are allowed.
        action_bins: values per dimension of a ``Box``, evenly spaced. None: chosen by the number of
            dimensions.
        action_low: lower bound for ``Box`` dimensions that declare none.
        action_high: upper bound for ``Box`` dimensions that declare none.
    """

    action_mask: Annotated[str, Meta(min_length=1, max_length=200)] | None = None
    action_bins: Annotated[int, Meta(ge=2, le=1000)] | None = None
    action_low: float | None = None
    action_high: float | None = None


class BufferSettings(SettingsGroup, frozen=True, kw_only=True):
    """The replay buffer (section 2.3.1).

    Attributes:
        replay_size: episodes with the highest returns that it holds.
        recent_size: newest episodes that it holds in addition, whatever their return; 0 in the
            paper.
        max_age: iterations after which an episode is removed. None: never, as in the paper.
    """

    replay_size: Annotated[int, Meta(ge=1, le=1_000_000)] = 500
    recent_size: Annotated[int, Meta(ge=0, le=1_000_000)] = 0
    max_age: PositiveInt | None = None


class CommandSettings(SettingsGroup, frozen=True, kw_only=True):
    """The episodes of an iteration and their commands (sections 2.3.1 and 2.3.4).

    Attributes:
        command_strategy: how exploratory commands are chosen: ``uniform`` (2.3.4), ``ranked``,
            ``maximum``, or a class of your own as ``package.module:Class``
            (:mod:`udrl.strategies`).
        last_few: number of best episodes that exploratory commands are drawn from (2.3.4).
        n_episodes_per_iter: exploratory episodes per iteration.
        n_steps_per_iter: exploratory env steps per iteration, roughly. An iteration has as many
            episodes as this takes at the mean length of the newest ones, ``n_episodes_per_iter`` at
            least. None, as in the paper: a fixed number.
        hold_share: share of exploratory episodes with held random actions; 0 in the paper.
        hold_rate: probability per step of such an episode that a held action begins. 0: one held
            action per episode.
        hold_steps: steps for which such an action is held. With a ``hold_rate``, at least n times
            as many with probability 1 / n.
        n_warm_up_episodes: episodes with random actions before the first iteration. With a
            ``dataset``, the number of its episodes.
        warm_up_hold_steps: steps for which each random action of the warm-up is held; 1 in the
            paper.
        dataset: Minari dataset to use in place of the warm-up. None: none.
        dataset_sha256: digest of the dataset's episodes. Empty: set when the run is created.
    """

    command_strategy: Annotated[str, Meta(min_length=1, max_length=200)] = "uniform"
    last_few: PositiveInt = 75
    n_episodes_per_iter: Annotated[int, Meta(ge=1, le=100_000)] = 20
    n_steps_per_iter: PositiveInt | None = None
    hold_share: Annotated[float, Meta(ge=0, le=1)] = 0.0
    hold_rate: Annotated[float, Meta(ge=0, le=1)] = 0.0
    hold_steps: PositiveInt = 30
    n_warm_up_episodes: Annotated[int, Meta(ge=1, le=100_000)] = 50
    warm_up_hold_steps: PositiveInt = 1
    dataset: Annotated[str, Meta(min_length=1, max_length=200)] | None = None
    dataset_sha256: Annotated[str, Meta(min_length=0, max_length=64)] = ""


class TrainingSettings(SettingsGroup, frozen=True, kw_only=True):
    """The updates of an iteration (section 2.3.3).

    Attributes:
        segments: ``trailing`` segments only (the paper's experiments) or ``all`` (2.3.3).
        batch_size: examples per update.
        learning_rate: learning rate of Adam.
        n_updates_per_iter: gradient steps per iteration.
        memory_window: with a ``memory``, number of consecutive steps trained together (truncated
            backpropagation through time).
        previous_dropout: with ``observe_previous``, share of examples that hide the previous action
            and reward, so that the agent does not only learn to repeat its actions.
        return_lambda: with a ``baseline``, lambda of the lambda-returns that label examples. 1: the
            observed return. 0: one reward and the value after it.
        reset_every: versions after which all networks are reset to their initial weights, with
            :data:`udrl.training.RESET_ROUNDS` times the updates. None: never, as in the paper.
    """

    segments: Literal["trailing", "all"] = "trailing"
    batch_size: Annotated[int, Meta(ge=1, le=2**20)] = 768
    learning_rate: Annotated[float, Meta(gt=0, le=10)] = 3.5e-4
    n_updates_per_iter: Annotated[int, Meta(ge=1, le=100_000)] = 100
    memory_window: Annotated[int, Meta(ge=1, le=65_536)] = 32
    previous_dropout: Annotated[float, Meta(ge=0, le=1)] = 0.25
    return_lambda: Annotated[float, Meta(ge=0, le=1)] = 0.95
    reset_every: PositiveInt | None = None


class EvaluationSettings(SettingsGroup, frozen=True, kw_only=True):
    """When and how the agent is evaluated (sections 2.3.6 and 3.2).

    Attributes:
        eval_every: env steps between evaluations.
        eval_episodes: episodes per evaluation.
        eval_temperature: sampling temperature in evaluations (2.3.6), by which logits are divided;
            1 in the paper. 0: the most likely action.
        eval_seeds: reset seeds of evaluations: ``final`` in [1, 0.5M), or ``search`` in [0.5M, 1M),
            for choosing hyperparameters (3.2).
    """

    eval_every: PositiveInt = 50_000
    eval_episodes: Annotated[int, Meta(ge=1, le=100_000)] = 100
    eval_temperature: Temperature = 1.0
    eval_seeds: Literal["final", "search"] = "final"


class ArithmeticSettings(SettingsGroup, frozen=True, kw_only=True):
    """Arithmetic of the learner.

    Attributes:
        precision: precision of the learner's network; weights, optimizer and acting are always
            float32. ``auto``: bfloat16 if the machine that creates the run has instructions for it.
        training_threads: threads of the learner on a CPU; everything else uses one.
        device: device of the learner. ``auto``: ``cuda`` if the machine that creates the run has
            a GPU.
    """

    precision: Literal["auto", "float32", "bfloat16"] = "float32"
    training_threads: Annotated[int, Meta(ge=1, le=256)] = 1
    device: Literal["auto", "cpu", "cuda"] = "cpu"
