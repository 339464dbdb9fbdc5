"""The settings of a run in groups, so that a part of the algorithm can be given its own alone.

A :class:`udrl.config.Config` holds one of each. The hyperparameters of Table 2 have the paper's
names.
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
    """Base of all groups: every number is finite."""

    def __post_init__(self) -> None:
        for name, value in msgspec.structs.asdict(self).items():
            if not all(map(math.isfinite, _floats(value))):
                raise ConfigError(f"{name} = {value}: must be a finite number")


def _floats(value: Any) -> Iterator[float]:
    """Yield the floats in a value, however deep."""
    if isinstance(value, float):
        yield value
    elif isinstance(value, dict | list | tuple):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _floats(part)


class NetworkSettings(SettingsGroup, frozen=True, kw_only=True):
    """The network, and how it reads a command (section 3.2, Appendix B.2).

    Attributes:
        behavior: a class of your own instead of the paper's network, as ``package.module:Class``
            (:mod:`udrl.custom`); None: the paper's.
        frame_stack: most recent observations that the network sees at once, one after another
            along the first dimension; before an episode's first there is the first again.
        memory: ``none``, or ``gru``: a gated recurrent unit between encoder and command, which
            remembers the episode so far (section 6).
        memory_size: numbers that it remembers.
        normalise_observations: whether numbers are read relative to their mean in the warm-up, in
            units of their deviation there.
        convolutions: channels of each convolutional layer, for images (3.2, B.2).
        hidden: units of each fully connected layer; for vectors, the first is multiplied with the
            embedded command (3.2).
        activation: of the hidden layers.
        initialisation: ``orthogonal``, or ``uniform`` (PyTorch's default for linear layers).
        return_scale: factor on the desired return at the network's input.
        horizon_scale: factor on the desired horizon at the network's input; 0: it is not read.
        desired_horizon: what exploratory and evaluation commands ask for: ``mean``, the mean
            length of the best episodes; or ``return``: as many steps as return, as an integer,
            where each step gives a reward of 1 (TakeCover, 3.1).
        baseline: what desired returns are relative to where the network reads them: ``none``, the
            paper's; ``value``: what a learned value function expects; or ``action_value``: the
            same, of what actions bring on average (:mod:`udrl.value`).
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
    desired_horizon: Literal["mean", "return"] = "mean"
    baseline: Literal["none", "value", "action_value"] = "none"


class ActionSettings(SettingsGroup, frozen=True, kw_only=True):
    """How actions are read (:mod:`udrl.environments.action_conversions`).

    Attributes:
        action_mask: where it says which actions are allowed: ``info``, in ``info["action_mask"]``;
            or the name of an entry of a ``Dict`` observation; None: all are, always.
        action_bins: values that each dimension can take, evenly from the lowest to the highest;
            None: as many as suit the number of dimensions.
        action_low: the lowest value of dimensions for which the environment declares none.
        action_high: the highest, likewise.
    """

    action_mask: Annotated[str, Meta(min_length=1, max_length=200)] | None = None
    action_bins: Annotated[int, Meta(ge=2, le=1000)] | None = None
    action_low: float | None = None
    action_high: float | None = None


class BufferSettings(SettingsGroup, frozen=True, kw_only=True):
    """Which episodes the replay buffer holds (section 2.3.1).

    Attributes:
        replay_size: episodes that it holds, those of the greatest returns.
        recent_size: newest episodes that it holds besides, whatever they returned; 0 is the
            paper's.
        max_age: iterations after which an episode leaves; None, as in the paper: never.
    """

    replay_size: Annotated[int, Meta(ge=1, le=1_000_000)] = 500
    recent_size: Annotated[int, Meta(ge=0, le=1_000_000)] = 0
    max_age: PositiveInt | None = None


class CommandSettings(SettingsGroup, frozen=True, kw_only=True):
    """The episodes of an iteration, and what they are told (sections 2.3.1 and 2.3.4).

    Attributes:
        command_strategy: what exploratory commands ask for: ``uniform`` (2.3.4), ``ranked``,
            ``maximum``, or a class of your own as ``package.module:Class``
            (:mod:`udrl.strategies`).
        last_few: number of best episodes that exploratory commands are drawn from (2.3.4).
        n_episodes_per_iter: exploratory episodes in an iteration.
        held_actions: share of exploratory episodes in which random actions are held for some
            steps, whatever the network says; 0 is the paper's.
        held_rate: with what probability one begins at each step of such an episode; 0: there is
            one in an episode.
        hold_steps: steps that such an action is held for; with a ``held_rate`` at least n times as
            many with probability 1 / n.
        n_warm_up_episodes: episodes of random actions before the first iteration; with a
            ``dataset`` as many as it has.
        warm_up_hold: steps that a random action of the warm-up is held for; 1 is the paper's.
        dataset: a Minari dataset whose episodes take the place of the warm-up's; None: none.
        dataset_sha256: digest of these; empty: whatever they are when the run is created.
    """

    command_strategy: Annotated[str, Meta(min_length=1, max_length=200)] = "uniform"
    last_few: PositiveInt = 75
    n_episodes_per_iter: Annotated[int, Meta(ge=1, le=100_000)] = 20
    held_actions: Annotated[float, Meta(ge=0, le=1)] = 0.0
    held_rate: Annotated[float, Meta(ge=0, le=1)] = 0.0
    hold_steps: PositiveInt = 30
    n_warm_up_episodes: Annotated[int, Meta(ge=1, le=100_000)] = 50
    warm_up_hold: PositiveInt = 1
    dataset: Annotated[str, Meta(min_length=1, max_length=200)] | None = None
    dataset_sha256: Annotated[str, Meta(min_length=0, max_length=64)] = ""


class TrainingSettings(SettingsGroup, frozen=True, kw_only=True):
    """How an iteration trains (section 2.3.3).

    Attributes:
        segments: ``trailing`` segments only (the paper's experiments) or ``all`` (2.3.3).
        batch_size: examples in one update.
        learning_rate: Adam's.
        n_updates_per_iter: gradient steps in an iteration.
        memory_window: with a ``memory``, consecutive steps of an episode that are trained on
            together, so that what is remembered is learned over as many.
        drop_previous: with ``observe_previous``, share of the examples without these, so that the
            agent learns more than to copy itself.
        return_lambda: with a ``baseline``, the lambda of the lambda-returns that examples are
            labelled with: 1 for the observed return, 0 for one reward and the value after it.
    """

    segments: Literal["trailing", "all"] = "trailing"
    batch_size: Annotated[int, Meta(ge=1, le=2**20)] = 768
    learning_rate: Annotated[float, Meta(gt=0, le=10)] = 3.5e-4
    n_updates_per_iter: Annotated[int, Meta(ge=1, le=100_000)] = 100
    memory_window: Annotated[int, Meta(ge=1, le=65_536)] = 32
    drop_previous: Annotated[float, Meta(ge=0, le=1)] = 0.25
    return_lambda: Annotated[float, Meta(ge=0, le=1)] = 0.95


class EvaluationSettings(SettingsGroup, frozen=True, kw_only=True):
    """When and how the agent is evaluated (sections 2.3.6 and 3.2).

    Attributes:
        eval_every: env steps between two evaluations.
        eval_episodes: episodes in one evaluation.
        eval_temperature: of the action distribution in evaluations (2.3.6): logits are divided by
            it; 1 is the paper's, 0 takes the mode.
        eval_seeds: reset seeds of evaluations: ``final``, in [1, 0.5M), or ``search``, in
            [0.5M, 1M), for choosing hyperparameters (3.2).
    """

    eval_every: PositiveInt = 50_000
    eval_episodes: Annotated[int, Meta(ge=1, le=100_000)] = 100
    eval_temperature: Temperature = 1.0
    eval_seeds: Literal["final", "search"] = "final"


class ArithmeticSettings(SettingsGroup, frozen=True, kw_only=True):
    """What the learner computes on and in.

    Attributes:
        precision: what the learner's network computes in; weights, optimizer and acting are float32
            always. ``auto``: bfloat16 if the machine that creates the run is fast in it.
        training_threads: threads that the learner computes with on a CPU; everything else has one.
        device: what the learner trains on; ``auto``: ``cuda`` if the machine that creates the run
            has it.
    """

    precision: Literal["auto", "float32", "bfloat16"] = "float32"
    training_threads: Annotated[int, Meta(ge=1, le=256)] = 1
    device: Literal["auto", "cpu", "cuda"] = "cpu"
