"""Options that several commands share."""

import math
import os
from functools import partial
from pathlib import Path
from typing import Any, Literal

import click

from udrl.errors import ConfigError
from udrl.strategies import MAX_DESIRED
from udrl_inspect.address import Address
from udrl_launch import completions
from udrl_launch.settings import read_steps
from udrl_proto.credentials import load_credentials
from udrl_proto.messages import MAX_NUMBER
from udrl_proto.session import check_endpoint


class _AbsolutePath(click.Path):
    """An absolute path, because an environment may change the working directory."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        if not str(value):
            self.fail("'' is not a path; expected e.g. runs/mine", param, ctx)
        return Path(os.fsdecode(super().convert(value, param, ctx))).absolute()


class FiniteRange(click.FloatRange):
    """A range of numbers, without the ``nan`` and ``inf`` that click accepts."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return the number."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value!r}: expected a finite number", param, ctx)
        return number


FILE = _AbsolutePath(path_type=Path, dir_okay=False)
FOLDER = _AbsolutePath(path_type=Path, file_okay=False)
RUN_DIR = FOLDER
RUN_DIR_OPTION = click.option(
    "--run-dir", type=RUN_DIR, metavar="DIR",
    help="Directory of the run. Default: a new one in ./runs.",
)  # fmt: skip
RESUME = click.option(
    "--resume", is_flag=True, help="Resume the run in --run-dir, if there is one."
)
INSECURE = click.option(
    "--insecure", is_flag=True, help="Allow listening beyond loopback without authentication."
)
ALLOW_INEXACT = click.option(
    "--allow-inexact", is_flag=True,
    help="Accept machines that round differently, and give up exact reproducibility.",
)  # fmt: skip
PARENT = click.option("--parent", type=int, hidden=True)
PATIENCE = click.option("--patience", type=FiniteRange(0), default=3.0, show_default=True,
                         metavar="SECONDS", help="How long to look for the run.")  # fmt: skip
KEYS = click.option(
    "--keys", type=FOLDER, metavar="DIR",
    help="Use TLS with the keys in this directory (see `udrl keys create`). Endpoints are then "
    "tls/HOST:PORT.",
)  # fmt: skip
AUDIT = click.option(
    "--audit", type=FiniteRange(0, 1), default=0.0, metavar="RATE",
    help="Share of episodes that a second actor repeats, to detect actors that deliver false ones.",
)  # fmt: skip
RUN = click.option(
    "--run", "run_id", metavar="RUN_ID", help="Id of the run, if a router carries several."
)
METRICS_HOST = click.option(
    "--metrics-host", default="127.0.0.1", show_default=True, metavar="ADDRESS",
    help="Address to serve metrics on, without authentication.",
)  # fmt: skip


def place(
    run_dir: Path | None, connect: str | None, run_id: str | None, keys: Path | None
) -> Path | Address:
    """Return the directory or the address of the run that a command inspects.

    Raises:
        ConfigError: neither or both are given, or the endpoint or the keys cannot be used.
    """
    if keys is not None:
        load_credentials(keys, "observer")
    if run_dir is not None and connect is None:
        return run_dir
    if connect is not None and run_dir is None:
        return Address(check_endpoint(connect, secure=keys is not None), run_id, keys=keys)
    raise ConfigError("give either RUN_DIR or --connect ENDPOINT")


_endpoint_option = partial(
    click.option, "--connect", metavar="ENDPOINT",
    help="Endpoint of the run, e.g. tcp/127.0.0.1:7447.",
)  # fmt: skip
CONNECT = _endpoint_option()
CONNECT_REQUIRED = _endpoint_option(required=True)
WEIGHTS = click.option(
    "--weights", default="latest", show_default=True, metavar="latest|best|VERSION",
    shell_complete=completions.weights,
    help="Weights version, among those that the run keeps.",
)  # fmt: skip


TEMPERATURE = click.option(
    "--temperature", type=FiniteRange(0, 1000), metavar="NUMBER",
    help="Sampling temperature; 0 = most likely action. Default: as in the run's evaluations.",
)  # fmt: skip
GREEDY = click.option(
    "--greedy", is_flag=True,
    help="Same as --temperature 0. Agents trained with sampled actions may do much worse.",
)  # fmt: skip


class _Return(click.ParamType):  # type: ignore[type-arg]
    """A desired return."""

    name = "float"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not abs(number) <= MAX_DESIRED:
            largest = f"{MAX_DESIRED:g}"
            self.fail(f"{value!r} is not a number from -{largest} to {largest}", param, ctx)
        return number


RETURN = _Return()
DESIRED_RETURN = click.option(
    "--desired-return", type=RETURN, metavar="R",
    help="Desired return. Default: as in the run's evaluations.",
)  # fmt: skip
DESIRED_HORIZON = click.option(
    "--desired-horizon", type=click.IntRange(1, 2**31 - 1), metavar="H",
    help="Desired horizon in steps. Default: as in the run's evaluations.",
)  # fmt: skip


class _Returns(click.ParamType):  # type: ignore[type-arg]
    """A range of desired returns: ``-100:250``."""

    name = "range"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float]:
        if isinstance(value, tuple):  # converted already
            return value
        low, colon, high = str(value).partition(":")
        ends = (math.nan, math.nan)
        if colon:
            ends = RETURN.convert(low, param, ctx), RETURN.convert(high, param, ctx)
        if not ends[0] < ends[1]:
            self.fail(f"{value!r} is not LOW:HIGH with LOW below HIGH, e.g. -100:250", param, ctx)
        return ends


RETURNS = _Returns()


class _Steps(click.ParamType):  # type: ignore[type-arg]
    """A number of env steps: ``250000``, ``500K``, ``1.5M`` or ``1e6``."""

    name = "steps"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        try:
            return read_steps(str(value))
        except ConfigError as error:
            self.fail(str(error), param, ctx)


STEPS = _Steps()


def version(text: str) -> int | Literal["latest", "best"]:
    """Return the value of ``--weights``.

    Raises:
        ConfigError: it is neither ``latest`` nor ``best`` nor a number.
    """
    if text == "latest" or text == "best":
        return text  # type: ignore[return-value]
    # Python refuses to convert thousands of digits.
    if text.isdecimal() and len(text) <= len(str(MAX_NUMBER)) and int(text) <= MAX_NUMBER:
        return int(text)
    raise ConfigError(f"--weights {text}: expected latest, best or a version number")


def chosen_temperature(temperature: float | None, *, greedy: bool) -> float | None:
    """Return the temperature that ``--temperature`` or ``--greedy`` gives; None: neither is given.

    Raises:
        ConfigError: both are given.
    """
    if greedy and temperature is not None:
        raise ConfigError(f"--greedy and --temperature {temperature:g}: give one of them")
    return 0.0 if greedy else temperature
