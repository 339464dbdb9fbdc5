"""Search spaces: those of Appendix B (``spaces/``), and files of users."""

import hashlib
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args

import msgspec
import numpy as np
from msgspec import Meta

from udrl.config import read_toml
from udrl.errors import ConfigError
from udrl.setting_groups import PositiveInt
from udrl.streams import Stream
from udrl_experiments.protocol import NETWORKS, Algorithm

#: Settings that a space must not draw: scores would not be comparable.
_SAME_FOR_ALL = ("seed", "eval_seeds", "eval_every", "eval_episodes")


class SearchSpace(NamedTuple):
    """Values from which the configurations of an environment are drawn.

    Attributes:
        source: the file, as errors name it.
        environment: Gymnasium's id.
        configurations: number of configurations per algorithm at the paper's scale; None: the
            number at the small scale.
        seeds: runs per configuration at the paper's scale.
        networks: values of settings that all algorithms have
            (:data:`~udrl_experiments.protocol.NETWORKS`), by setting.
        lists: for each algorithm, values of its settings or hyperparameters, by name.
    """

    source: str
    environment: str
    configurations: int | None
    seeds: int
    networks: dict[str, list[Any]]
    lists: dict[Algorithm, dict[str, list[Any]]]

    def draw(self, algorithm: Algorithm, configuration: int) -> dict[str, Any]:
        """Return the settings of a configuration: from each list a value, uniformly drawn.

        Args:
            algorithm: an algorithm in the space.
            configuration: number of the configuration, from 0; it determines the settings.
        """
        lists = self.networks | self.lists[algorithm]
        name = f"udrl/search/1|{self.environment}|{algorithm}|{configuration}"
        stream = Stream(hashlib.sha256(name.encode()).digest()[:16])
        numbers = stream.uniforms(len(lists)).tolist()
        return {
            key: values[int(u * len(values))]
            for (key, values), u in zip(sorted(lists.items()), numbers, strict=True)
        }

    @contextmanager
    def errors_of(self, table: str) -> Iterator[None]:
        """Name the file and a table in each :class:`ConfigError` that is raised within."""
        try:
            yield
        except ConfigError as error:
            raise ConfigError(f"{self.source}: [{table}] {error}") from error


def shipped_space(environment: str) -> SearchSpace:
    """Return the space of Appendix B for one of the paper's environments."""
    spaces = resources.files("udrl_experiments") / "spaces"
    own, baselines = (
        tomllib.loads((spaces / f"{name}.toml").read_text(encoding="utf-8"))
        for name in (environment, "baselines")
    )
    return _space(environment, own | baselines, f"{environment}.toml")


def read_space(environment: str, file: Path) -> SearchSpace:
    """Return the space in a file.

    Raises:
        ConfigError: the file cannot be read, or is not a valid space.
    """
    return _space(environment, read_toml(file), str(file))


class _Logspace(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[low, high, n]``: n numbers from 10^low to 10^high, in equal ratios."""

    logspace: tuple[
        Annotated[float, Meta(ge=-300, le=300)],
        Annotated[float, Meta(ge=-300, le=300)],
        Annotated[int, Meta(ge=1, le=100_000)],
    ]


_Values = Annotated[list[Any], Meta(min_length=1)] | _Logspace


class _File(msgspec.Struct, frozen=True):
    """The content of a file, except for the tables of algorithms."""

    configurations: PositiveInt | None = None
    seeds: PositiveInt = 1
    networks: dict[str, Any] = {}


def _space(environment: str, values: Mapping[str, Any], source: str) -> SearchSpace:
    algorithms: tuple[Algorithm, ...] = get_args(Algorithm)
    for name in values:
        if name not in (*_File.__struct_fields__, *algorithms):
            raise ConfigError(
                f"{source}: unknown setting or table {name!r}: expected configurations, seeds, "
                f"[networks], [{'], ['.join(algorithms)}]"
            )
    try:
        file = msgspec.convert(values, _File)
    except msgspec.ValidationError as error:
        raise ConfigError(
            f"{source}: {error}; the documentation's page on studies has an example"
        ) from error
    for name in file.networks:
        if name not in NETWORKS:
            raise ConfigError(
                f"{source}: [networks] {name}: expected one of {', '.join(NETWORKS)}, which all "
                f"algorithms have; move it to the table of an algorithm"
            )
    lists = {
        name: _expanded(values[name], f"{source}: [{name}]")
        for name in algorithms
        if name in values
    }
    if not lists:
        raise ConfigError(
            f"{source}: no table of an algorithm; expected [{'] or ['.join(algorithms)}]"
        )
    for algorithm, settings in lists.items():
        if "environment" in settings:
            raise ConfigError(
                f"{source}: [{algorithm}] environment: the environment is the argument ENV, "
                f"{environment!r}; leave it out"
            )
        for setting in _SAME_FOR_ALL:
            if setting in settings:
                raise ConfigError(
                    f"{source}: [{algorithm}] {setting}: the search sets it, so that "
                    f"configurations can be compared; leave it out"
                )
    networks = _expanded(file.networks, f"{source}: [networks]")
    return SearchSpace(source, environment, file.configurations, file.seeds, networks, lists)


def _expanded(table: Any, source: str) -> dict[str, list[Any]]:
    """Return the lists of a table, with ``logspace`` expanded."""
    if not isinstance(table, dict):
        raise ConfigError(f"{source} = {table!r}: expected a table of lists")
    lists = {}
    for name, value in table.items():
        try:
            one: list[Any] | _Logspace = msgspec.convert(value, _Values)
        except msgspec.ValidationError as error:
            raise ConfigError(
                f"{source} {name} = {value!r}: {error}; expected a list of at least one value, or "
                f"{{ logspace = [low, high, n] }}: n numbers from 10^low to 10^high"
            ) from error
        lists[name] = np.logspace(*one.logspace).tolist() if isinstance(one, _Logspace) else one
    return lists
