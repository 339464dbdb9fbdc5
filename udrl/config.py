"""Settings of a run (:class:`Config`) and its limits (:class:`Budget`).

The results of a run's iterations depend only on its :class:`Config`: the paper's hyperparameters
(Table 2) under the paper's names, the network, and choices that the paper does not specify. The
:class:`Budget` may change when a run is resumed.

A ``Config`` holds its settings in groups (:mod:`udrl.setting_groups`). In files, on the command
line, in messages and in stores, settings are flat: each has a unique name, and there are no groups
(:func:`flat`, :func:`build`, :func:`change`).
"""

import difflib
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta

from udrl.errors import ConfigError
from udrl.invalid_settings import in_words
from udrl.setting_groups import (
    ActionSettings,
    ArithmeticSettings,
    BufferSettings,
    CommandSettings,
    EvaluationSettings,
    NetworkSettings,
    PositiveInt,
    SettingsGroup,
    TrainingSettings,
)

KeywordValue = bool | int | float | str
# Lists and tables of these, with limited depth: a peer could send thousands of levels.
_Inner = KeywordValue | list[KeywordValue] | dict[str, KeywordValue]
_Outer = KeywordValue | list[_Inner] | dict[str, _Inner]
#: Keyword arguments for an environment.
Keywords = dict[str, KeywordValue | list[_Outer] | dict[str, _Outer]]
#: Settings by name, without groups, as in messages and stores.
FlatSettings = dict[str, KeywordValue | list[int | str] | Keywords | None]
#: The import path of a wrapper, with arguments if it needs any.
Wrapper = Annotated[str, Meta(min_length=1, max_length=200)]

AnyStruct = TypeVar("AnyStruct", bound=msgspec.Struct)

#: Command ids are ``iteration * COMMANDS_PER_ITERATION + index`` (see :mod:`udrl.commands`).
COMMANDS_PER_ITERATION = 1_000_000


class Config(SettingsGroup, frozen=True, kw_only=True):
    """Settings of a run. Runs of equal ``Config`` on the same kind of hardware are bit-identical.

    Attributes:
        environment: a Gymnasium id, registered or importable (``package.module:Env-v0``).
        environment_kwargs: keyword arguments for ``gymnasium.make``.
        wrappers: Gymnasium wrappers, applied in this order, as ``package.module:Wrapper`` or
            ``package.module:Wrapper(size=8)``.
        observe_time: whether the time left until the step limit is added to observations.
        observe_previous: whether the previous action and reward are added to observations.
        max_episode_steps: step limit of an episode. None: the environment's own.
        max_train_steps: shorter step limit of warm-up and exploratory episodes. None: none.
        max_return: the highest possible return, which caps the desired return in evaluation
            (2.3.2). None: the environment's own, if it declares one.
        seed: seed of all random streams.
        lead: iterations that acting may run ahead of training; 0 is Algorithm 1.
        actions: settings of action spaces.
        network: settings of the acting graph, and its initialisation.
        buffer: settings of the replay buffer.
        commands: settings of warm-up and exploratory episodes.
        training: settings of the updates of an iteration.
        evaluation: settings of evaluations.
        arithmetic: settings of the learner's arithmetic.
    """

    environment: Annotated[str, Meta(min_length=1, max_length=200)]
    environment_kwargs: Keywords = {}
    wrappers: Annotated[tuple[Wrapper, ...], Meta(min_length=0, max_length=16)] = ()
    observe_time: bool = False
    observe_previous: bool = False
    max_episode_steps: PositiveInt | None = None
    max_train_steps: PositiveInt | None = None
    max_return: float | None = None
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 1
    lead: Annotated[int, Meta(ge=0, le=64)] = 0

    actions: ActionSettings = ActionSettings()
    network: NetworkSettings = NetworkSettings()
    buffer: BufferSettings = BufferSettings()
    commands: CommandSettings = CommandSettings()
    training: TrainingSettings = TrainingSettings()
    evaluation: EvaluationSettings = EvaluationSettings()
    arithmetic: ArithmeticSettings = ArithmeticSettings()

    def __post_init__(self) -> None:
        super().__post_init__()
        baseline, segments = self.network.baseline, self.training.segments
        if baseline != "none" and segments != "trailing":
            raise ConfigError(
                f"segments = {segments!r} with baseline = {baseline!r}: lambda-returns "
                f"reach to the end of an episode; set segments = 'trailing' or baseline = 'none'"
            )
        if self.network.memory != "none" and segments != "trailing":
            raise ConfigError(
                f"segments = {segments!r} with memory = {self.network.memory!r}: windows of steps "
                f"are trained with the return until the episode's end; set segments = 'trailing'"
            )
        if self.network.behavior is not None and self.network.memory != "none":
            raise ConfigError(
                f"memory = {self.network.memory!r} with behavior = {self.network.behavior!r}: a "
                f"network of your own has no memory; set memory = 'none'"
            )
        last_few, replay_size = self.commands.last_few, self.buffer.replay_size
        if last_few > replay_size:
            raise ConfigError(
                f"last_few = {last_few}: expected at most replay_size = {replay_size}, "
                f"because exploratory commands are drawn from the replay buffer; "
                f"lower last_few or raise replay_size"
            )


class Budget(SettingsGroup, frozen=True, kw_only=True):
    """Limits of a run: its stopping criteria, and the weights that it keeps.

    A run ends after the first iteration that meets a stopping criterion.

    Attributes:
        max_env_steps: env steps of warm-up and exploratory episodes.
        stop_return: mean return of an evaluation. None: no such criterion.
        keep_versions: number of evaluated weights versions to keep, the newest ones, in addition to
            those that the run needs and the best one. None: all.
    """

    max_env_steps: Annotated[int, Meta(ge=1, le=2**53)] = 1_000_000
    stop_return: float | None = None
    keep_versions: Annotated[int, Meta(ge=0, le=1_000_000)] | None = None


#: Settings that accept ``auto``, with placeholders until :mod:`udrl.automatic_settings` chooses
#: values.
AUTOMATIC: Mapping[str, Any] = {
    "action_mask": None,
    "observe_time": False,
    "return_scale": 1.0,
    "horizon_scale": 1.0,
    "baseline": "value",
    "return_lambda": 0.95,
    "replay_size": 12_000,
    "recent_size": 0,
    "max_age": 12,
    "guidance_kl": 0.0,
    "reset_every": None,
    "n_warm_up_episodes": 1,
    "warm_up_hold_steps": 1,
    "hold_share": 1.0,
    "hold_rate": 0.0,
    "hold_steps": 1,
}

#: The value of an optional setting that is None, which TOML cannot write.
UNSET = "unset"

#: Conditions under which some settings have an effect.
_NEEDS: dict[str, tuple[Callable[[Config], bool], str]] = {
    "dataset_sha256": (lambda config: config.commands.dataset is not None, "a dataset"),
    "previous_dropout": (lambda config: config.observe_previous, "observe_previous"),
    "hold_rate": (lambda config: config.commands.hold_share > 0, "hold_share above 0"),
    "memory_size": (lambda config: config.network.memory != "none", "memory = 'gru'"),
    "memory_window": (lambda config: config.network.memory != "none", "memory = 'gru'"),
    "hold_steps": (lambda config: config.commands.hold_share > 0, "hold_share above 0"),
    "advantage_bound": (lambda config: config.network.baseline != "none", "a baseline"),
    "return_lambda": (lambda config: config.network.baseline != "none", "a baseline"),
    "training_threads": (lambda config: config.arithmetic.device != "cuda", "device = 'cpu'"),
}


def refuse_ineffective(config: Config, names: Iterable[str]) -> None:
    """Raise :class:`ConfigError` for a setting without effect in this configuration.

    Args:
        config: all settings.
        names: settings that were set explicitly.
    """
    for name in names:
        has_effect, need = _NEEDS.get(name, (lambda config: True, ""))
        if not has_effect(config):
            raise ConfigError(
                f"{name} = {flat(config)[name]!r} has no effect: it needs {need}; leave it out, "
                f"or set that too"
            )


def preset_names() -> list[str]:
    """Return the names of the presets that ship with the package."""
    folder = resources.files("udrl") / "presets"
    return sorted(
        f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml")
    )


def preset(name: str) -> dict[str, Any]:
    """Return the settings of a preset.

    Raises:
        ConfigError: there is no preset of that name.
    """
    if name not in preset_names():
        near = difflib.get_close_matches(name, preset_names(), n=1)
        hint = f"did you mean {near[0]!r}? Presets: " if near else "expected one of "
        names = ", ".join((*preset_names(), "none"))
        raise ConfigError(f"unknown preset {name!r}: {hint}{names}")
    text = (resources.files("udrl") / "presets" / f"{name}.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def read_toml(path: Path) -> dict[str, Any]:
    """Return the settings in a TOML file.

    Raises:
        ConfigError: the file cannot be read, or is not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(
            f"configuration file {path}: {error.strerror}; name a readable TOML file"
        ) from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"configuration file {path}: {error}; name a TOML file") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(
            f"configuration file {path} is not TOML: {error}; correct that line"
        ) from error


def parse_assignment(text: str) -> tuple[str, Any]:
    """Return name and value of ``NAME=VALUE``. VALUE is TOML; a bare word is a string.

    ``True`` and ``False`` are accepted as Python writes them.

    Raises:
        ConfigError: there is no ``=``.
    """
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise ConfigError(f"--set {text}: expected NAME=VALUE, e.g. --set batch_size=512")
    try:
        return name.strip(), tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        word = value.strip()
        return name.strip(), {"True": True, "False": False}.get(word, word)


@cache
def _groups(kind: type[msgspec.Struct]) -> dict[str, type[SettingsGroup]]:
    return {
        field.name: field.type
        for field in msgspec.structs.fields(kind)
        if isinstance(field.type, type) and issubclass(field.type, SettingsGroup)
    }


@cache
def setting_names(kind: type[msgspec.Struct]) -> tuple[str, ...]:
    """Return the names of all settings of a kind, including those in groups."""
    groups = _groups(kind)
    return tuple(
        name
        for field in kind.__struct_fields__
        for name in (groups[field].__struct_fields__ if field in groups else [field])
    )


def flat(settings: msgspec.Struct) -> dict[str, Any]:
    """Return all settings by name, without groups, as in TOML and JSON."""
    values: dict[str, Any] = {}
    for field, value in msgspec.to_builtins(settings).items():
        values |= value if field in _groups(type(settings)) else {field: value}
    return {n: list(value) if isinstance(value, tuple) else value for n, value in values.items()}


def build(kind: type[AnyStruct], values: Mapping[str, Any]) -> AnyStruct:
    """Return settings of a kind, in their groups, after checking every value's type and range.

    Args:
        kind: :class:`Config`, :class:`Budget` or a group.
        values: settings by name, without groups. Missing settings have their defaults. ``"unset"``
            is None, which TOML cannot write, for settings that may be None.

    Raises:
        ConfigError: a name is unknown or a value is invalid; the message names it.
    """
    refuse_unknown(values, setting_names(kind))
    given = {name: value for name, value in values.items() if name in kind.__struct_fields__}
    optional = (f.name for f in msgspec.structs.fields(kind) if f.default is None)
    given |= {name: None for name in optional if given.get(name) == UNSET}
    for field, group in _groups(kind).items():
        given[field] = build(group, {n: values[n] for n in setting_names(group) if n in values})
    try:
        return msgspec.convert(given, kind)
    except msgspec.ValidationError as error:
        named = [n for n in values if re.search(rf"\$\.{n}\b", str(error))]
        if not named:
            raise ConfigError(str(error)) from error
        name, value = named[0], values[named[0]]
        raise ConfigError(f"{name} = {value!r}: {in_words(error, kind, name, value)}") from error


def change(settings: AnyStruct, **values: Any) -> AnyStruct:
    """Return settings with some values changed, in any group.

    Raises:
        ConfigError: as :func:`build`.
    """
    return build(type(settings), flat(settings) | values)


def refuse_unknown(values: Mapping[str, Any], known: tuple[str, ...]) -> None:
    """Raise :class:`ConfigError` for a name that is not in ``known``, naming the closest match."""
    for name in values:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(known)}"
            raise ConfigError(f"unknown setting {name!r}: {hint}")


class Configured:
    """Base of messages and records that contain the settings of a run, without groups.

    Attributes:
        settings: the settings by name. A struct declares it as ``msgspec.field(name="config")``.
    """

    __slots__ = ()
    settings: FlatSettings

    def __post_init__(self) -> None:
        build(Config, self.settings)

    @property
    def config(self) -> Config:
        """The settings in their groups."""
        return build(Config, self.settings)
