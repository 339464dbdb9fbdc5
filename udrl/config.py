"""Settings: what a run is (:class:`Config`) and how far it goes (:class:`Budget`).

A run is a function of its :class:`Config`, which holds the paper's hyperparameters (Table 2) under
the paper's names, the architecture, and the few choices that the paper leaves open. The
:class:`Budget` says when to stop and may be changed when a run is resumed.
"""

import difflib
import math
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

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
KeywordValue = bool | int | float | str

Settings = TypeVar("Settings", bound=msgspec.Struct)

#: Command ids are ``iteration * COMMANDS_PER_ITERATION + index`` (see :mod:`udrl.commands`).
COMMANDS_PER_ITERATION = 1_000_000


class Config(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a run is. Two runs of equal ``Config`` on the same kind of hardware are bit-identical.

    Attributes:
        environment: a Gymnasium id, registered or importable (``package.module:Env-v0``).
        environment_kwargs: keyword arguments for ``gymnasium.make``.
        max_episode_steps: time limit of an episode in steps; None: the environment's own.
        max_train_steps: time limit of warm-up and exploratory episodes only; None: no other.
        max_return: the greatest return that the environment can give, which caps the desired
            return in evaluation (2.3.2); None: what the environment declares, if anything.
        seed: the seed that every random stream is keyed by.
        lead: how many iterations acting may run ahead of training; 0 is Algorithm 1 to the letter.
        baseline: what desired returns are relative to where the network reads them: ``none``, the
            paper's; or ``value``: what a learned value function expects (:mod:`udrl.value`).
        batch_size: examples in one update.
        command_strategy: what exploratory commands ask for: ``uniform`` (2.3.4), ``ranked``,
            ``maximum``, or a class of your own as ``package.module:Class``
            (:mod:`udrl.strategies`).
        dataset: a Minari dataset whose episodes take the place of the warm-up's; None: none.
        dataset_sha256: digest of these; empty: whatever they are when the run is created.
        desired_horizon: what exploratory and evaluation commands ask for: ``mean``, the mean
            length of the best episodes; or ``return``: as many steps as return, as an integer,
            where each step gives a reward of 1 (TakeCover, 3.1).
        held_actions: share of exploratory episodes in which one random action is held for
            ``hold_steps`` steps, whatever the network says; 0 is the paper's.
        hold_steps: steps that such an action is held for.
        horizon_scale: factor on the desired horizon at the network's input.
        last_few: number of best episodes that exploratory commands are drawn from (2.3.4).
        learning_rate: Adam's.
        n_episodes_per_iter: exploratory episodes in an iteration.
        n_updates_per_iter: gradient steps in an iteration.
        n_warm_up_episodes: episodes of random actions before the first iteration; with a
            ``dataset`` as many as it has.
        warm_up_hold: steps that a random action of the warm-up is held for; 1 is the paper's.
        replay_size: episodes that the replay buffer holds (2.3.1).
        max_age: iterations after which an episode leaves the replay buffer; None, as in the paper:
            never.
        recent_size: newest episodes that the replay buffer holds besides, whatever they returned;
            0 is the paper's.
        return_lambda: with a ``baseline``, the lambda of the lambda-returns that examples are
            labelled with: 1 for the observed return, 0 for one reward and the value after it.
        return_scale: factor on the desired return at the network's input.
        segments: ``trailing`` segments only (the paper's experiments) or ``all`` (2.3.3).
        frame_stack: most recent observations that the network sees at once, one after another
            along the first dimension; before an episode's first there is the first again.
        convolutions: channels of each convolutional layer, for images (3.2, B.2).
        hidden: units of each fully connected layer; for vectors, the first is multiplied with the
            embedded command (3.2).
        activation: of the hidden layers.
        initialisation: ``orthogonal``, or ``uniform`` (PyTorch's default for linear layers).
        eval_every: env steps between two evaluations.
        eval_episodes: episodes in one evaluation.
        eval_temperature: of the action distribution in evaluations (2.3.6): logits are divided by
            it; 1 is the paper's, 0 takes the mode.
        eval_seeds: reset seeds of evaluations: ``final``, in [1, 0.5M), or ``search``, in
            [0.5M, 1M), for choosing hyperparameters (3.2).
        precision: what the learner's network computes in; weights, optimizer and acting are float32
            always. ``auto``: bfloat16 if the machine that creates the run is fast in it.
        training_threads: threads that the learner computes with on a CPU; everything else has one.
        device: what the learner trains on; ``auto``: ``cuda`` if the machine that creates the run
            has it.
    """

    environment: Annotated[str, Meta(min_length=1, max_length=200)]
    environment_kwargs: dict[str, KeywordValue] = {}
    max_episode_steps: PositiveInt | None = None
    max_train_steps: PositiveInt | None = None
    max_return: float | None = None
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 1
    lead: Annotated[int, Meta(ge=0, le=64)] = 0

    baseline: Literal["none", "value"] = "none"
    batch_size: Annotated[int, Meta(ge=1, le=2**20)] = 768
    command_strategy: Annotated[str, Meta(min_length=1, max_length=200)] = "uniform"
    dataset: Annotated[str, Meta(min_length=1, max_length=200)] | None = None
    dataset_sha256: Annotated[str, Meta(min_length=0, max_length=64)] = ""
    desired_horizon: Literal["mean", "return"] = "mean"
    held_actions: Annotated[float, Meta(ge=0, le=1)] = 0.0
    hold_steps: PositiveInt = 30
    horizon_scale: Scale = 0.01
    last_few: PositiveInt = 75
    learning_rate: Annotated[float, Meta(gt=0, le=10)] = 3.5e-4
    n_episodes_per_iter: Annotated[int, Meta(ge=1, le=100_000)] = 20
    n_updates_per_iter: Annotated[int, Meta(ge=1, le=100_000)] = 100
    n_warm_up_episodes: Annotated[int, Meta(ge=1, le=100_000)] = 50
    warm_up_hold: PositiveInt = 1
    replay_size: Annotated[int, Meta(ge=1, le=1_000_000)] = 500
    max_age: PositiveInt | None = None
    recent_size: Annotated[int, Meta(ge=0, le=1_000_000)] = 0
    return_lambda: Annotated[float, Meta(ge=0, le=1)] = 0.95
    return_scale: Scale = 0.025

    segments: Literal["trailing", "all"] = "trailing"
    frame_stack: Annotated[int, Meta(ge=1, le=64)] = 1
    convolutions: Widths = (32, 48, 96, 128)
    hidden: Widths = (32, 128, 128, 128)
    activation: Literal["relu", "tanh"] = "relu"
    initialisation: Literal["orthogonal", "uniform"] = "orthogonal"

    eval_every: PositiveInt = 50_000
    eval_episodes: Annotated[int, Meta(ge=1, le=100_000)] = 100
    eval_temperature: Temperature = 1.0
    eval_seeds: Literal["final", "search"] = "final"

    precision: Literal["auto", "float32", "bfloat16"] = "float32"
    training_threads: Annotated[int, Meta(ge=1, le=256)] = 1
    device: Literal["auto", "cpu", "cuda"] = "cpu"

    def __post_init__(self) -> None:
        _refuse_non_finite(self)
        if self.baseline != "none" and self.segments != "trailing":
            raise ConfigError(
                f"segments = {self.segments!r} with baseline = {self.baseline!r}: lambda-returns "
                f"reach to the end of an episode; set segments = 'trailing' or baseline = 'none'"
            )
        if self.last_few > self.replay_size:
            raise ConfigError(
                f"last_few = {self.last_few}: must be at most replay_size = {self.replay_size}, "
                f"because exploratory commands are drawn from the replay buffer; "
                f"lower last_few or raise replay_size"
            )


class Budget(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When a run ends: at the first iteration whose completion reaches one of these.

    Attributes:
        max_env_steps: env steps of warm-up and exploratory episodes.
        stop_return: mean return of an evaluation; None: never.
    """

    max_env_steps: Annotated[int, Meta(ge=1, le=2**53)] = 1_000_000
    stop_return: float | None = None

    def __post_init__(self) -> None:
        _refuse_non_finite(self)


def _refuse_non_finite(settings: msgspec.Struct) -> None:
    for name, value in msgspec.structs.asdict(settings).items():
        for number in value.values() if isinstance(value, dict) else [value]:
            if isinstance(number, float) and not math.isfinite(number):
                raise ConfigError(f"{name} = {value}: must be a finite number")


#: What some settings need to have an effect.
_NEEDS: dict[str, tuple[Callable[[Config], bool], str]] = {
    "dataset_sha256": (lambda config: config.dataset is not None, "a dataset"),
    "hold_steps": (lambda config: config.held_actions > 0, "held_actions above 0"),
    "return_lambda": (lambda config: config.baseline == "value", "baseline = 'value'"),
    "training_threads": (lambda config: config.device != "cuda", "device = 'cpu'"),
}


def refuse_idle(config: Config, names: Iterable[str]) -> None:
    """Raise :class:`ConfigError` for a setting that has no effect beside the others.

    Args:
        config: all settings.
        names: those that somebody asked for.
    """
    for name in names:
        has_effect, need = _NEEDS.get(name, (lambda config: True, ""))
        if not has_effect(config):
            raise ConfigError(
                f"{name} = {getattr(config, name)!r} has no effect: it needs {need}; leave it out, "
                f"or set that too"
            )


def preset_names() -> list[str]:
    """Return the names of the presets that ship with the package."""
    folder = resources.files("udrl") / "presets"
    return sorted(
        f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml")
    )


def preset(name: str) -> dict[str, Any]:
    """Return the settings of a shipped preset.

    Raises:
        ConfigError: there is no such preset.
    """
    if name not in preset_names():
        raise ConfigError(f"preset {name!r}: there are {', '.join(preset_names())}")
    text = (resources.files("udrl") / "presets" / f"{name}.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def read_toml(path: Path) -> dict[str, Any]:
    """Return the settings in a TOML file.

    Raises:
        ConfigError: the file cannot be read, or is not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"configuration file {path}: {error}; name a readable TOML file"
        ) from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"configuration file {path} is not TOML: {error}") from error


def parse_assignment(text: str) -> tuple[str, Any]:
    """Return name and value of ``NAME=VALUE``, VALUE as TOML; a bare word is a string.

    Raises:
        ConfigError: there is no ``=``.
    """
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise ConfigError(f"--set {text}: expected HYPERPARAMETER=VALUE, e.g. --set batch_size=512")
    try:
        return name.strip(), tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return name.strip(), value.strip()


def build(kind: type[Settings], values: Mapping[str, Any]) -> Settings:
    """Return ``kind(**values)`` after checking every value's type and range.

    Raises:
        ConfigError: a name is unknown or a value impossible; the message says which.
    """
    refuse_unknown(values, kind.__struct_fields__)
    try:
        return msgspec.convert(dict(values), kind)
    except msgspec.ValidationError as error:
        named = [n for n in values if re.search(rf"\$\.{n}\b", str(error))]
        given = f"{named[0]} = {values[named[0]]!r}: " if named else ""
        raise ConfigError(f"{given}{error}; see docs/configuration.md") from error


def refuse_unknown(values: Mapping[str, Any], known: tuple[str, ...]) -> None:
    """Raise :class:`ConfigError` for a name that is not in ``known``, with the nearest that is."""
    for name in values:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(known)}"
            raise ConfigError(f"unknown setting {name!r}: {hint}")
