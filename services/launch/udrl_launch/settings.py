"""Settings of a command: preset, then file, then command line; the last one wins."""

import re
from collections.abc import Iterable, Mapping
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

import msgspec
from msgspec import Meta

from udrl.config import (
    AUTOMATIC,
    Budget,
    Config,
    build,
    parse_assignment,
    preset,
    preset_names,
    read_toml,
    refuse_ineffective,
    refuse_unknown,
    setting_names,
)
from udrl.errors import ConfigError
from udrl.strategies import strategy_class

AnyStruct = TypeVar("AnyStruct", bound=msgspec.Struct)


#: The name for no preset.
NO_PRESET = "none"
#: The preset for environments without their own.
ANY_PRESET = "any"
#: The value of a setting that is chosen automatically.
_AUTO = "auto"
#: Settings that are numbers of env steps, and accept :func:`read_steps`'s spellings.
_STEPS = "max_env_steps", "eval_every"


class Fleet(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parallelism of a run. It changes the speed, never the result.

    Attributes:
        actors: actor processes on this machine.
        envs_per_actor: environments that each actor steps at once. None: chosen to suit the run.
        hang_timeout: seconds per round of environment steps after which an actor ends and is
            restarted. Creating an environment may take five minutes, or this long if it is more.
    """

    actors: Annotated[int, Meta(ge=0, le=1024)] = 2
    envs_per_actor: Annotated[int, Meta(ge=1, le=4096)] | None = None
    hang_timeout: Annotated[float, Meta(ge=1, le=86_400)] = 60.0


def _from_file(file: Path, environment: str) -> dict[str, Any]:
    values = read_toml(file)
    named = values.get("environment", environment)
    if named != environment:
        raise ConfigError(
            f"environment = {named!r} in {file}, but ENV is {environment!r}; they must be the same"
        )
    return values


#: Maximum number of environments per actor by default; more rows per call gain little.
_MOST_ENVS = 16


def read_steps(text: str) -> int:
    """Return a number of env steps: ``250000``, ``500K``, ``1.5M`` or ``1e6``.

    Raises:
        ConfigError: the text is not such a number, or it is not from 1 to 2^53.
    """
    digits = re.sub(r"(?<=[0-9])[,_](?=[0-9]{3}(?![0-9]))", "", text)
    found = re.fullmatch(r"([0-9]{1,16}(?:\.[0-9]{1,16})?)([kKmM]|[eE][0-9]{1,2})?", digits)
    steps = 0
    if found is not None:
        number, suffix = Decimal(found[1]), (found[2] or "").lower()
        factors = {"": 0, "k": 3, "m": 6}
        exponent = factors[suffix] if suffix in factors else int(suffix[1:])
        steps = round(number.scaleb(exponent))
    if not 1 <= steps <= 2**53:
        raise ConfigError(
            f"{text!r}: expected a number of steps from 1 to 2^53, e.g. 500K, 10M, 1e6 or 250000"
        )
    return steps


def with_steps_as_numbers(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings in which numbers of env steps are integers, e.g. 500000 for ``500K``.

    Raises:
        ConfigError: one of them is not a number of steps.
    """
    read = dict(values)
    for name in _STEPS:
        given = values.get(name)
        if isinstance(given, float) and given.is_integer():  # 1e6 in Python and TOML
            read[name] = int(given)
        elif isinstance(given, str):
            try:
                read[name] = read_steps(given)
            except ConfigError as error:
                raise ConfigError(f"{name} = {error}") from error
    return read


class Settings(NamedTuple):
    """All settings of a command.

    Attributes:
        config: the settings that define the run.
        budget: when it ends.
        fleet: its parallelism.
        automatic: settings of ``config`` that are chosen automatically when the run is created
            (:mod:`udrl.automatic_settings`). Until then their values have no meaning.
    """

    config: Config
    budget: Budget
    fleet: Fleet
    automatic: frozenset[str] = frozenset()

    @property
    def envs_per_actor(self) -> int:
        """Number of environments per actor; by default no more than can be busy."""
        if self.fleet.envs_per_actor is not None:
            return self.fleet.envs_per_actor
        commands, evaluation = self.config.commands, self.config.evaluation
        exploring = commands.n_episodes_per_iter * (self.config.lead + 1)
        most = max(commands.n_warm_up_episodes, exploring + evaluation.eval_episodes)
        return max(1, min(_MOST_ENVS, most // max(1, self.fleet.actors)))


def gather(
    environment: str,
    *,
    preset_name: str | None = None,
    file: Path | None = None,
    stored: Mapping[str, Any] | None = None,
    options: Mapping[str, Any],
    assignments: Iterable[str] = (),
) -> Settings:
    """Return the settings of a command.

    Args:
        environment: the argument ENV, which overrides everything else.
        preset_name: a preset, or :data:`NO_PRESET`. None: the one named after the environment, or
            :data:`ANY_PRESET` if there is none.
        file: a TOML file.
        stored: the settings of a run to resume, in place of a preset's.
        options: command-line options. A value of None means that the option was not given.
        assignments: the values of ``--set``.

    Raises:
        ConfigError: a setting is unknown or invalid, one of ``--set`` has no effect, the command
            strategy cannot be imported, or ``environment`` is a preset of another one.
    """
    values: dict[str, Any] = dict(stored or {})
    own = preset(environment) if environment in preset_names() else {}
    if (meant := own.get("environment", environment)) != environment:
        raise ConfigError(
            f"ENV {environment!r}: this is a preset, expected an environment; use "
            f"{meant} --preset {environment}"
        )
    if preset_name is None and stored is None:
        preset_name = environment if "environment" in own else ANY_PRESET
    if preset_name not in (None, NO_PRESET):
        values |= preset(preset_name)
    if file is not None:
        values |= _from_file(file, environment)
    values |= {name: value for name, value in options.items() if value is not None}
    assigned: list[str] = []
    for text in assignments:
        name, value = parse_assignment(text)
        assigned.append(name)
        if name == "environment":
            raise ConfigError(
                f"--set {text}: the environment is the argument ENV, {environment!r}; leave it out"
            )
        values[name] = value
    values["environment"] = environment
    values = with_steps_as_numbers(values)
    kinds = (Config, Budget, Fleet)
    refuse_unknown(values, tuple(name for kind in kinds for name in setting_names(kind)))

    automatic = {n for n in AUTOMATIC if values.get(n) == _AUTO}
    values |= {name: AUTOMATIC[name] for name in automatic}
    if "baseline" in automatic and values.get("segments") == "all":
        values["baseline"] = "none"  # the only one that supports them
    if stored is not None:  # these were chosen when the run was created
        values |= {name: stored[name] for name in automatic if name in stored}
        automatic.clear()

    def part(kind: type[AnyStruct]) -> AnyStruct:
        return build(kind, {n: v for n, v in values.items() if n in setting_names(kind)})

    config = part(Config)
    refuse_ineffective(config, assigned)
    strategy_class(config.commands.command_strategy)  # raises if there is none
    return Settings(config, part(Budget), part(Fleet), frozenset(automatic))
