"""``proto/README.md`` describes every message, verb, key and error code, with types and limits."""

import ast
import json
import re
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec import inspect

from tests.proto.strategies import MESSAGES, setting_fields
from udrl.actions import Categorical, Product
from udrl.commands import Command
from udrl.config import Config, FlatSettings, Keywords
from udrl.environments import EnvironmentSpec
from udrl.spaces import Bits, Categories, Category, Image, Leaf, Record, Vector
from udrl_proto import PROTOCOL, key_expressions, verbs
from udrl_proto.codec import SMALL

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "proto" / "README.md").read_text(encoding="utf-8")
REASONS = (ROOT / "docs" / "protocol.md").read_text(encoding="utf-8")

SPACES = [Vector, Bits, Image, Category, Categories, Record, Leaf, Categorical, Product]
STRUCTS = [*MESSAGES, Command, Config, EnvironmentSpec, *SPACES]


def number(value: float) -> str:
    """Format a limit; large powers of two as powers."""
    whole = int(value)
    if whole != value:
        return str(value)
    for power, rest in ((whole, ""), (whole + 1, " - 1")):
        if whole >= 2**16 and power & (power - 1) == 0:
            return f"2^{power.bit_length() - 1}{rest}"
    return str(whole)


def described(kind: inspect.Type) -> str:
    """Return the name of a type in the tables."""
    match kind:
        case inspect.UnionType(types=types):
            return " or ".join(map(described, types))
        case inspect.NoneType():
            return "nil"
        case inspect.BoolType():
            return "true or false"
        case inspect.IntType(ge=None):
            return "integer"
        case inspect.IntType(ge=int() as least, le=int() as most):
            return f"integer {number(least)} to {number(most)}"
        case inspect.FloatType(gt=(int() | float()) as above, le=(int() | float()) as most):
            return f"number above {number(above)}, to {number(most)}"
        case inspect.FloatType(ge=(int() | float()) as least, le=(int() | float()) as most) if (
            most < 1e300
        ):
            return f"number {number(least)} to {number(most)}"
        case inspect.FloatType(ge=(int() | float())):
            return "finite number"
        case inspect.FloatType():
            return "number"
        case inspect.StrType(pattern=str(pattern)) if "f4" in pattern:
            return "`<f4`, `<i4`, `\\|u1`, or `\\|V` and a number"
        case inspect.StrType(pattern=str()):
            return "name"
        case inspect.StrType(max_length=None):
            return "text"
        case inspect.StrType(max_length=int() as longest):
            return f"text to {longest}"
        case inspect.BytesType(min_length=int() as size):
            return f"{size} bytes"
        case inspect.BytesType(max_length=int() as most):
            return f"bytes, {number(most)} at most"
        case inspect.BytesType():
            return "bytes"
        case inspect.LiteralType(values=values):
            return " or ".join(f"`{json.dumps(v)}`" for v in values).replace("|", "\\|")
        case inspect.VarTupleType(item_type=item, min_length=fewest, max_length=count):
            limit = "" if count is None else f", {number(fewest or 0)} to {number(count)} of them"
            return f"array of {described(item)}{limit}"
        case inspect.DictType() if kind == inspect.type_info(FlatSettings):
            return "[Config](#config)"
        case inspect.DictType() if kind == inspect.type_info(Keywords):
            return "map of text to true or false, number or text, or arrays and maps of these"
        case inspect.DictType(key_type=key, value_type=value):
            return f"map of {described(key)} to {described(value)}"
        case inspect.StructType(cls=cls):
            return f"[{cls.__name__}](#{cls.__name__.lower()})"
    raise NotImplementedError(kind)


def default_of(field: inspect.Field) -> str:
    if field.required:
        return ""
    default = field.default
    if field.default_factory is not msgspec.NODEFAULT:
        default = field.default_factory()
    if default is None or default == b"":
        return "nil" if default is None else "empty"
    return f"`{json.dumps(default)}`"


def rows_of(kind: type[msgspec.Struct]) -> list[list[str]]:
    """Return the expected first cells of a type's table: field, type, default."""
    return [[f"`{f.encode_name}`", described(f.type), default_of(f)] for f in setting_fields(kind)]


def rows_below(page: str, heading: str) -> list[list[str]]:
    """Return the rows below a heading, without the table's header."""
    text = re.split(r"\n#+ ", page.split(f"\n{heading}\n", 1)[1], maxsplit=1)[0]
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines[1:]]


@pytest.mark.parametrize("kind", STRUCTS, ids=lambda kind: kind.__name__)
def test_every_message_is_described_field_by_field(kind: type[Any]) -> None:
    expected = rows_of(kind)
    if not expected:
        assert f"\n#### {kind.__name__}\n" in PAGE
        return
    rows = rows_below(PAGE, f"#### {kind.__name__}")
    assert [row[:3] for row in rows] == expected
    assert all(row[3] for row in rows)


def size(n: int) -> str:
    """Format a size in bytes as in the tables."""
    for unit, name in ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB")):
        if n > verbs.FEW and n % unit == 0:
            return f"{n // unit} {name}"
    return str(n)


def test_every_verb_is_described_with_its_roles_messages_and_limits() -> None:
    rows = {row[0].strip("`"): row[1:] for row in rows_below(PAGE, "### Verbs")}
    assert list(rows) == [verb.name for verb in verbs.VERBS]
    for verb in verbs.VERBS:
        senders, request, reply, limit = rows[verb.name]
        assert senders.split(", ") == list(verb.senders)
        assert request == f"[{verb.request.__name__}](#{verb.request.__name__.lower()})"
        assert reply == f"[{verb.reply.__name__}](#{verb.reply.__name__.lower()})"
        if verb is verbs.EPISODE:  # the run's own limit
            assert limit.startswith("max_episode_steps x ")
            assert limit.endswith(f" + {verbs.FEW}")
        else:
            assert limit == size(verb.limit)


def test_limits_of_replies_are_described() -> None:
    (sentence,) = re.findall(r"Replies have at most (.+?)\.", " ".join(PAGE.split()))
    described: dict[str, str] = {}
    most, *exceptions = re.split(r", except |(?<=B), and ", sentence)
    for exception in exceptions:
        replies, limit = exception.split(": ")
        described |= dict.fromkeys(re.split(r", | and ", replies), limit)
    assert most == size(SMALL)
    assert described == {
        v.reply.__name__: size(v.reply_limit) for v in verbs.VERBS if v.reply_limit > SMALL
    }


def test_every_key_expression_is_described() -> None:
    for verb in (
        key_expressions.NEW_WEIGHTS,
        key_expressions.PROGRESS,
        key_expressions.alive("<run id>", "<role>", "<id>"),
    ):
        assert verb.replace(f"udrl/{PROTOCOL}/", "udrl/<protocol>/") in PAGE
    assert key_expressions.every_hello() in PAGE
    assert key_expressions.RUN_ID.pattern in PAGE


def codes_in_source() -> set[str]:
    """Return the codes of all refusals and problems in the source."""
    found = set()
    for path in [*ROOT.glob("services/*/*/*.py"), *ROOT.glob("proto/*/*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                given: list[ast.expr] = []
                if node.func.id == "Refused":
                    given = node.args[:1]
                if node.func.id == "Problem":
                    given = [k.value for k in node.keywords if k.arg == "code"]
                found |= {g.value for g in given if isinstance(g, ast.Constant)}
    return {str(code) for code in found}


@pytest.mark.parametrize(("page", "heading"), [(PAGE, "## Errors"), (REASONS, "## Error codes")])
def test_every_error_code_is_described(page: str, heading: str) -> None:
    rows = rows_below(page, heading)
    assert {row[0].strip("`") for row in rows} == codes_in_source()
    assert all(len(row) >= 3 and all(row) for row in rows)


def test_documented_protocol_version_is_current() -> None:
    assert f"This is protocol {PROTOCOL}." in PAGE
