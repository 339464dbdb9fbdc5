"""The reference in the documentation is complete and matches the code."""

import ast
import importlib.util
import json
import re
import sqlite3
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec import inspect

from tests.markdown import (
    ROOT,
    SOURCES,
    Page,
    codes,
    make_targets,
    names,
    records,
    section,
    text_of,
)
from tests.proto.strategies import setting_fields
from udrl import errors
from udrl.config import AUTOMATIC, Budget, Config, preset, preset_names, read_toml
from udrl.errors import UdrlError
from udrl_launch.settings import Fleet, gather
from udrl_launch.supervisor import FINAL_CODES
from udrl_proto.reports import Status
from udrl_replay.database import STORE_FILE
from udrl_replay.progress import RunProgress
from udrl_replay.store import COLUMNS, Store

# Studies.


def test_studies_list_the_dependencies_of_other_algorithms() -> None:
    text = " ".join(section("docs/studies.md", "## Algorithms").split())
    needs = text[text.index("DQN, A2C and PPO are") :]
    for words in ("the extra `studies`", "discrete actions and one vector or image"):
        assert words in needs


# Settings.


def number(value: float) -> str:
    """Format a bound as in the tables: powers of two from 2^16 as such."""
    whole = int(value)
    if whole != value:
        return str(value)
    for power, rest in ((whole, ""), (whole + 1, " - 1")):
        if whole >= 2**16 and power & (power - 1) == 0:
            return f"2^{power.bit_length() - 1}{rest}"
    return f"{whole:,}"


def bounds(kind: Any) -> str:
    if kind.gt is not None:
        return f"above {number(kind.gt)}, up to {number(kind.le)}"
    return "" if kind.ge is None else f"{number(kind.ge)} to {number(kind.le)}"


def described(kind: inspect.Type) -> tuple[str, str]:
    """Return the name of a type in the tables, and the allowed values."""
    match kind:
        case inspect.UnionType():
            (held,) = (t for t in kind.types if not isinstance(t, inspect.NoneType))
            name, allowed = described(held)
            return f"{name} or unset", allowed
        case inspect.IntType():
            return "integer", bounds(kind)
        case inspect.FloatType():
            return "number", bounds(kind)
        case inspect.BoolType():
            return "true or false", ""
        case inspect.DictType():
            return "table", ""
        case inspect.StrType():
            return "string", f"{kind.min_length} to {kind.max_length} characters"
        case inspect.LiteralType():
            return "string", " or ".join(f"`{json.dumps(value)}`" for value in kind.values)
        case inspect.VarTupleType():
            name, allowed = described(kind.item_type)
            count = f"{kind.min_length} to {kind.max_length}"
            return f"list of {name}s", f"{count} of them, each {allowed}"
    raise AssertionError(f"this test cannot describe {kind}")


def default_of(field: inspect.Field) -> str:
    if field.required:
        return "`ENV`"
    default = field.default
    if field.default_factory is not msgspec.NODEFAULT:
        default = field.default_factory()
    return "unset" if default is None else f"`{json.dumps(default)}`"


@pytest.mark.parametrize(
    ("kind", "heading"),
    [
        (Config, "## Run settings: `Config`"),
        (Budget, "## Limits: `Budget`"),
        (Fleet, "## Parallelism: `Fleet`"),
    ],
)
def test_every_setting_is_documented_with_its_type_default_and_range(
    kind: Any, heading: str
) -> None:
    expected = {}
    for field in setting_fields(kind):
        name, allowed = described(field.type)
        if field.name in AUTOMATIC:
            allowed += ", or `auto`" if allowed else "or `auto`"
        expected[f"`{field.name}`"] = [name, default_of(field), allowed]
    rows = records(section("docs/configuration.md", heading), "setting")
    assert {row[0]: row[1:4] for row in rows} == expected
    assert all(row[4] for row in rows)


def test_every_preset_is_documented_with_its_differences_from_the_defaults() -> None:
    defaults = {
        field.name: list(field.default) if isinstance(field.default, tuple) else field.default
        for kind in (Config, Budget, Fleet)
        for field in setting_fields(kind)
    }
    expected = {
        name: {n: v for n, v in preset(name).items() if n != "environment" and v != defaults[n]}
        for name in preset_names()
    }
    blocks = re.findall(
        r"^### Preset `([^`]+)`\n\n```toml\n(.*?)^```$",
        text_of("docs/configuration.md"),
        flags=re.DOTALL | re.MULTILINE,
    )
    assert {name: tomllib.loads(settings) for name, settings in blocks} == expected


def test_every_preset_is_documented_with_its_purpose() -> None:
    rows = records(section("docs/configuration.md", "## Presets"), "preset")
    assert sorted(name for row in rows for name in codes(row[0])) == preset_names()
    assert all(row[1] for row in rows)


def test_example_of_a_configuration_file_is_accepted(tmp_path: Path) -> None:
    toml = [code for language, code in Page("docs/configuration.md").code if language == "toml"]
    (example,) = (code for code in toml if "environment" in tomllib.loads(code))
    file = tmp_path / "example.toml"
    file.write_text(example, encoding="utf-8")
    gather(read_toml(file)["environment"], file=file, options={})


# Metrics.


def fields(kind: inspect.Type, prefix: str = "") -> Iterator[str]:
    """Yield the paths of a message's fields, those of nested messages included."""
    match kind:
        case inspect.StructType():
            for field in kind.fields:
                yield from fields(field.type, f"{prefix}.{field.encode_name}".lstrip("."))
        case inspect.VarTupleType():
            yield from fields(kind.item_type, f"{prefix}[]")
        case inspect.UnionType(types=types) if any(
            isinstance(t, inspect.StructType) for t in types
        ):
            for one in types:
                if isinstance(one, inspect.StructType):
                    yield from fields(one, prefix)
        case _:
            yield prefix


def test_every_metrics_column_is_documented_in_file_order() -> None:
    rows = records(section("docs/metrics.md", "## metrics.csv"), "column")
    assert [codes(row[0])[0] for row in rows] == list(COLUMNS)
    assert all(row[2] for row in rows)


def test_every_status_field_is_documented() -> None:
    rows = records(section("docs/metrics.md", "## Status"), "field")
    documented = [codes(row[0])[0] for row in rows]
    assert sorted(documented) == sorted(fields(inspect.type_info(Status)))
    assert all(row[2] for row in rows)


# Operations.

ERRORS: list[type[UdrlError]] = [
    member
    for member in vars(errors).values()
    if isinstance(member, type) and issubclass(member, UdrlError)
]


def test_every_error_is_documented_with_its_exit_code() -> None:
    rows = records(section("docs/operations-reference.md", "## Exit codes"), "code")
    found = {name: int(row[0]) for row in rows for name in codes(row[1])}
    assert found == {error.__name__: error.exit_code for error in ERRORS}


def test_documented_exit_codes_state_which_children_are_restarted() -> None:
    rows = records(section("docs/operations-reference.md", "## Exit codes"), "code")
    assert {int(row[0]) for row in rows if row[4] == "no"} == FINAL_CODES
    assert {int(row[0]) for row in rows if row[4] == "yes"} == {
        error.exit_code for error in ERRORS if error.exit_code < 128
    } - FINAL_CODES


def test_every_table_and_column_of_the_store_is_documented(tmp_path: Path) -> None:
    Store.create(tmp_path).close()
    with sqlite3.connect(tmp_path / STORE_FILE) as db:
        tables_there = db.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
        expected = {
            name: [column for _, column, *_ in db.execute(f"PRAGMA table_info({name})")]
            for (name,) in tables_there
        }
    db.close()
    parts = re.split(
        r"^\*\*(\w+)\*\*:", section("docs/operations-reference.md", "## The store"), flags=re.M
    )
    found = {
        name: names(text, "column") for name, text in zip(parts[1::2], parts[2::2], strict=True)
    }
    assert found == expected


def test_every_counter_of_the_store_is_in_the_status_or_in_operations() -> None:
    shown = {path.rpartition(".")[2] for path in fields(inspect.type_info(Status))}
    shown |= {"latest_version"}  # the status' weights_version
    text = section("docs/operations-reference.md", "## The store")
    assert set(RunProgress.__struct_fields__) - shown <= set(codes(text))


def log_formats() -> Iterator[tuple[Path, str]]:
    """Yield the format of every log line at warning and above."""
    for path in SOURCES:
        for node in ast.walk(ast.parse(text_of(path))):
            if (
                isinstance(node, ast.Call)
                and isinstance(node.func, ast.Attribute)
                and node.func.attr in ("warning", "error", "exception", "critical")
                and ast.unparse(node.func.value) == "log"
            ):
                yield path, ast.literal_eval(node.args[0])


def test_every_warning_and_error_of_the_log_is_documented() -> None:
    documented = names(section("docs/operations-reference.md", "## Log lines"), "line")
    for path, line in log_formats():
        shown = re.sub(r"%(\.\d+)?[srdf]", "…", line)
        assert shown == "…" or shown in documented, f"{path}: {shown}"


LITERALS = re.sub(r'"\s*\n?\s*f?"', "", " ".join(text_of(path) for path in SOURCES))


def is_in_source(message: str) -> bool:
    """Return whether the code has a message, in which … stands for variable parts."""
    pattern = r"[^\n]{1,80}?".join(re.escape(part) for part in message.split("…"))
    return re.search(pattern, LITERALS) is not None


def test_documented_log_lines_exist() -> None:
    for line in names(section("docs/operations-reference.md", "## Log lines"), "line"):
        assert is_in_source(line), line


def test_messages_in_troubleshooting_exist() -> None:
    text = Page("docs/troubleshooting.md").prose
    messages = {*names(text, "message"), *re.findall(r"\*\*`([^`]+)`\*\*", text)}
    assert len(messages) > 12
    for message in messages:
        assert is_in_source(message), message


def test_every_extra_is_documented() -> None:
    project = tomllib.loads(text_of("pyproject.toml"))["project"]
    documented = names(section("docs/operations.md", "## Installing"), "extra")
    extras = project["optional-dependencies"].keys() - {"dev", "docs", "fuzz"}
    assert sorted(documented) == sorted(extras)


def test_every_make_target_is_documented() -> None:
    documented = names(section("CONTRIBUTING.md", "## Set-up"), "target")
    assert sorted(documented) == sorted(f"make {target}" for target in make_targets())


def test_reference_of_the_command_line_is_current() -> None:
    path = ROOT / "docs" / "make_cli.py"
    loaded = importlib.util.spec_from_file_location("make_cli", path)
    assert loaded is not None
    assert loaded.loader is not None
    make_cli: Any = importlib.util.module_from_spec(loaded)
    loaded.loader.exec_module(make_cli)
    assert text_of("docs/cli.md") == make_cli.page(), "run: .venv/bin/python docs/make_cli.py"
