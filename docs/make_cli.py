"""Writes ``docs/cli.md``, the reference of the command line, from the command line itself.

::

    .venv/bin/python docs/make_cli.py
"""

from collections.abc import Iterator
from pathlib import Path

import click
from click.types import Choice, FloatRange, IntRange

from udrl.config import Budget, Config, setting_names
from udrl_launch.cli import cli
from udrl_launch.settings import Fleet

PAGE = Path(__file__).with_name("cli.md")

_HEAD = """\
# Command line

<!-- Written by docs/make_cli.py; edit the help in services/launch/udrl_launch/subcommands/. -->

{about} `python -m udrl_launch` is the same command.

| command | description |
|---|---|
{index}

- `ENV` is a Gymnasium id, registered (`LunarLander-v3`) or importable (`package.module:Env-v0`).
- `RUN_DIR` is the [directory of a run](operations-reference.md#the-run-directory).
- An endpoint is `tcp/HOST:PORT`, e.g. `tcp/127.0.0.1:7447`; with [`--keys`](operations.md#keys)
  it is `tls/HOST:PORT`.

Every command has `--help`. `udrl --version` prints the version. Results are written to standard
output; progress, logs and errors to standard error. An error is one line that names the value, what
was expected and the remedy. The [exit code](operations-reference.md#exit-codes) identifies the kind
of error.

`--set NAME=VALUE` and a file named by `--config` set any setting, including those without an option
of their own: see [configuration](configuration.md).
"""

_SETTINGS = {name for kind in (Config, Budget, Fleet) for name in setting_names(kind)}
_TYPES = {"float": "NUMBER", "float range": "NUMBER", "integer range": "INTEGER"}

#: In a command's help, before its example.
_EXAMPLE = "\b\nExample:\n"


def page() -> str:
    """Return the text of ``docs/cli.md``."""
    commands = list(_commands("", cli))
    index = "\n".join(
        f"| [`udrl {name}`](#udrl-{name.replace(' ', '-')}) | {_prose(command)[0][0]} |"
        for name, command in commands
    )
    sections = [_HEAD.format(about=str(cli.help).strip(), index=index)]
    sections += ["\n".join(_section(name, command)) for name, command in commands]
    return "\n".join(sections)


def _commands(prefix: str, group: click.Group) -> Iterator[tuple[str, click.Command]]:
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        if isinstance(command, click.Group):
            yield from _commands(f"{prefix}{name} ", command)
        else:
            yield prefix + name, command


def _section(name: str, command: click.Command) -> Iterator[str]:
    about, example = _prose(command)
    options = [p for p in command.params if isinstance(p, click.Option) and not p.hidden]
    usage = ["udrl", name]
    for param in command.params:
        if isinstance(param, click.Argument):
            metavar = param.metavar or str(param.name).upper()
            usage.append(metavar if param.required else f"[{metavar}]")
    usage += [_signature(option) for option in options if option.required]
    yield f"## udrl {name}\n"
    yield f"    {' '.join(usage)}{' [OPTIONS]' if options else ''}\n"
    for paragraph in about:
        yield f"{paragraph}\n"
    if example:
        yield f"```sh\n{example}\n```\n"
    if options:
        yield "| option | meaning |\n|---|---|"
    for option in options:
        yield f"| `{_signature(option)}` | {' '.join(_meaning(option, command))} |"
    yield ""


def _prose(command: click.Command) -> tuple[list[str], str]:
    """Return the paragraphs of a command's description, and its example."""
    about, _, example = str(command.help).partition(_EXAMPLE)
    paragraphs = [" ".join(paragraph.split()) for paragraph in about.strip().split("\n\n")]
    return paragraphs, example.strip()


def _signature(option: click.Option) -> str:
    if option.is_flag:
        return option.opts[0]
    kind = option.metavar or _TYPES.get(option.type.name, option.type.name.upper())
    if isinstance(option.type, Choice):
        kind = "|".join(option.type.choices)
    return f"{option.opts[0]} {kind}".replace("|", "\\|")


def _meaning(option: click.Option, command: click.Command) -> Iterator[str]:
    if option.help:
        yield " ".join(option.help.split())
    if isinstance(option.type, IntRange | FloatRange):
        low, high = option.type.min, option.type.max
        yield f"At least {low:,}." if high is None else f"{low:,} to {round(high):,}."
    default = option.to_info_dict()["default"]
    if option.required:
        yield "Required."
    elif default not in (None, ()) and not option.is_flag:
        values = default if isinstance(default, tuple | list) else [default]
        yield f"Default: {', '.join(f'`{value}`' for value in values)}."
    # Commands that look at a run have options of the same names with other meanings.
    takes_settings = any(param.name == "assignments" for param in command.params)
    if takes_settings and option.name in _SETTINGS:
        yield f"Sets [`{option.name}`](configuration.md)."


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
