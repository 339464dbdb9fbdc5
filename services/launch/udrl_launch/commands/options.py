"""Options that several commands have."""

import math
import os
import re
from decimal import Decimal
from pathlib import Path
from typing import Any, Literal

import click

from udrl.errors import ConfigError
from udrl_inspect.address import Address
from udrl_proto.credentials import load
from udrl_proto.session import check_endpoint

#: No return is beyond this.
_MOST = 1e9


class _AbsolutePath(click.Path):
    """A path that means the same wherever an environment goes to."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        if not str(value):
            self.fail("'' is no path; name one, e.g. runs/mine", param, ctx)
        return Path(os.fsdecode(super().convert(value, param, ctx))).absolute()


FILE = _AbsolutePath(path_type=Path, dir_okay=False)
FOLDER = _AbsolutePath(path_type=Path, file_okay=False)
RUN_DIR = FOLDER
PARENT = click.option("--parent", type=int, hidden=True)
PATIENCE = click.option("--patience", type=click.FloatRange(0), default=3.0, show_default=True,
                         help="Seconds to look for the run.")  # fmt: skip
KEYS = click.option(
    "--keys", type=FOLDER, metavar="DIR",
    help="Authenticate and encrypt with these keys (`udrl keys create DIR`); endpoints are then "
    "tls/HOST:PORT.",
)  # fmt: skip
AUDIT = click.option(
    "--audit", type=click.FloatRange(0, 1), default=0.0, metavar="RATE",
    help="Share of the episodes that a second actor makes again, to find out who lies.",
)  # fmt: skip
RUN = click.option(
    "--run", "run_id", metavar="RUN_ID", help="Which run, where a router carries several."
)
METRICS_HOST = click.option(
    "--metrics-host", default="127.0.0.1", show_default=True, metavar="ADDRESS",
    help="Where Prometheus may ask; everybody who reaches it may read.",
)  # fmt: skip


def place(
    run_dir: Path | None, connect: str | None, run_id: str | None, keys: Path | None
) -> Path | Address:
    """Return where a run is that a command looks at: its directory, or an address.

    Raises:
        ConfigError: neither or both are given, or the endpoint or the keys cannot be used.
    """
    if keys is not None:
        load(keys, "observer")
    if run_dir is not None and connect is None:
        return run_dir
    if connect is not None and run_dir is None:
        return Address(check_endpoint(connect, secure=keys is not None), run_id, keys=keys)
    raise ConfigError("give either RUN_DIR or --connect ENDPOINT")


CONNECT = click.option(
    "--connect", metavar="ENDPOINT", help="Endpoint of the run, e.g. tcp/127.0.0.1:7447."
)
WEIGHTS = click.option(
    "--weights", default="latest", show_default=True, metavar="latest|best|VERSION",
    help="Which of the versions that the run keeps.",
)  # fmt: skip


TEMPERATURE = click.option(
    "--temperature", type=click.FloatRange(0, 1000),
    help="Of the action distribution; 0: take its mode. Default: as the run's evaluations.",
)  # fmt: skip
GREEDY = click.option(
    "--greedy", is_flag=True,
    help="The same as --temperature 0. Agents that learned with sampled actions may do far worse.",
)  # fmt: skip


class _Return(click.ParamType):  # type: ignore[type-arg]
    """A return that can be asked for."""

    name = "float"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not abs(number) <= _MOST:
            self.fail(f"{value!r} is not a number from -{_MOST:g} to {_MOST:g}", param, ctx)
        return number


RETURN = _Return()


class _Returns(click.ParamType):  # type: ignore[type-arg]
    """A range of returns that can be asked for: ``-100:250``."""

    name = "range"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float]:
        if isinstance(value, tuple):  # converted already
            return value
        low, _, high = str(value).partition(":")
        ends = RETURN.convert(low, param, ctx), RETURN.convert(high, param, ctx)
        if not ends[0] < ends[1]:
            self.fail(f"{value!r} is not LOW:HIGH with LOW below HIGH, e.g. -100:250", param, ctx)
        return ends


RETURNS = _Returns()


class _Steps(click.ParamType):  # type: ignore[type-arg]
    """A number of env steps: ``250000``, ``500K`` or ``1.5M``."""

    name = "steps"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        digits = re.sub(r"(?<=[0-9])[,_](?=[0-9]{3}(?![0-9]))", "", str(value))
        found = re.fullmatch(r"([0-9]{1,16}(?:\.[0-9]{1,16})?)([kKmM]?)", digits)
        steps = 0
        if found is not None:
            factor = {"": 1, "k": 1_000, "m": 1_000_000}[found[2].lower()]
            steps = round(Decimal(found[1]) * factor)
        if not 1 <= steps <= 2**53:
            self.fail(f"{value!r} is not a number of steps, e.g. 500K, 10M or 250000", param, ctx)
        return steps


STEPS = _Steps()


def version(text: str) -> int | Literal["latest", "best"]:
    """Return what ``--weights`` says.

    Raises:
        ConfigError: neither a word that it knows, nor a number.
    """
    if text == "latest" or text == "best":
        return text  # type: ignore[return-value]
    if text.isdecimal():
        return int(text)
    raise ConfigError(f"--weights {text}: expected latest, best or a version number")


def chosen_temperature(temperature: float | None, *, greedy: bool) -> float | None:
    """Return what ``--temperature`` and ``--greedy`` say.

    Raises:
        ConfigError: both are given.
    """
    if greedy and temperature is not None:
        raise ConfigError(f"--greedy and --temperature {temperature:g}: give one of them")
    return 0.0 if greedy else temperature
