"""Hypothesis strategies for messages, derived from their types, so that new fields are covered."""

from collections.abc import Iterable, Iterator
from typing import Any

import msgspec
from hypothesis import strategies as st
from msgspec import inspect

import udrl_proto.reports  # noqa: F401 - its messages are found too
from udrl.config import Config, FlatSettings, Keywords, build, flat
from udrl.setting_groups import SettingsGroup
from udrl.spaces import Leaf
from udrl_proto.messages import Message

MESSAGES = sorted(Message.__subclasses__(), key=lambda kind: kind.__name__)

#: Keyword arguments of environments: nested numbers and texts. Derived from their recursive type,
#: the strategy would take minutes to draw.
_PLAIN: st.SearchStrategy[Any] = st.one_of(
    st.booleans(),
    st.integers(-(2**63), 2**63 - 1),
    st.floats(allow_nan=False, allow_infinity=False),
    st.text(max_size=20),
)


def _one_or_several(inner: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    tables = st.dictionaries(st.text(max_size=20), inner, max_size=3)
    return _PLAIN | st.lists(inner, max_size=3) | tables


KEYWORD_VALUES = _one_or_several(_one_or_several(_PLAIN))


def messages(kind: type[msgspec.Struct]) -> st.SearchStrategy[Any]:
    """Return a strategy for all messages of a kind, with finite numbers."""
    return _any(inspect.type_info(kind))


def setting_fields(kind: type[msgspec.Struct]) -> Iterator[inspect.Field]:
    """Yield the fields of all settings of a kind, including those in groups."""
    info = inspect.type_info(kind)
    assert isinstance(info, inspect.StructType)
    for field in info.fields:
        match field.type:
            case inspect.StructType(cls=cls, fields=fields) if issubclass(cls, SettingsGroup):
                yield from fields
            case _:
                yield field


def configs() -> st.SearchStrategy[Config]:
    """Return a strategy for valid configurations."""
    return _fields(setting_fields(Config)).map(lambda given: build(Config, _consistent(given)))


def _fields(fields: Iterable[inspect.Field]) -> st.SearchStrategy[dict[str, Any]]:
    fields = list(fields)
    return st.fixed_dictionaries(
        {f.name: _any(f.type) for f in fields if f.required},
        optional={f.name: _any(f.type) for f in fields if not f.required},
    )


def _any(node: inspect.Type) -> st.SearchStrategy[Any]:
    match node:
        case inspect.StructType(cls=cls, fields=fields):
            return _fields(fields).map(lambda given: cls(**given))
        case inspect.DictType() if node == inspect.type_info(FlatSettings):
            return configs().map(flat)
        case inspect.UnionType(types=types):
            return st.one_of(*map(_any, types))
        case inspect.LiteralType(values=literals):
            return st.sampled_from(literals)
        case inspect.VarTupleType(item_type=inspect.StructType(cls=cls) as item) if cls is Leaf:
            leaves = st.lists(_any(item), min_size=1, max_size=4, unique_by=lambda one: one.name)
            return leaves.map(tuple)
        case inspect.VarTupleType(item_type=item, min_length=least, max_length=most):
            return st.lists(_any(item), min_size=least or 0, max_size=min(most or 4, 4)).map(tuple)
        case inspect.DictType() if node == inspect.type_info(Keywords):
            return st.dictionaries(_any(node.key_type), KEYWORD_VALUES, max_size=3)
        case inspect.DictType(key_type=key, value_type=value):
            return st.dictionaries(_any(key), _any(value), max_size=3)
        case inspect.StrType(pattern=str(pattern)) if "f4" in pattern:
            return st.from_regex(pattern.replace("$", r"\Z"))
        case inspect.StrType(pattern=str()):
            return st.from_regex(r"[A-Za-z0-9._-]{1,100}", fullmatch=True)
        case inspect.StrType(min_length=least, max_length=most):
            return st.text(min_size=least or 0, max_size=min(most or 20, 20))
        case inspect.BytesType(min_length=least, max_length=most):
            return st.binary(min_size=least or 0, max_size=min(most or 20, 20))
        case inspect.IntType(ge=ge, le=le):
            return st.integers(-(2**63) if ge is None else ge, 2**63 - 1 if le is None else le)
        case inspect.FloatType(gt=gt, ge=ge, le=le):
            return st.floats(
                gt if ge is None else ge,
                le,
                exclude_min=gt is not None,
                allow_nan=False,
                allow_infinity=False,
            )
        case inspect.BoolType():
            return st.booleans()
        case inspect.NoneType():
            return st.none()
        case inspect.ListType(item_type=item):
            return st.lists(_any(item), max_size=3)
    raise NotImplementedError(node)


def _consistent(values: dict[str, Any]) -> dict[str, Any]:
    """Make a combination of settings consistent."""
    last_few = min(values.get("last_few", 75), 1_000_000)
    values |= {"last_few": last_few, "replay_size": max(values.get("replay_size", 500), last_few)}
    if values.get("segments") == "all":
        values |= {"baseline": "none", "memory": "none"}
    if values.get("behavior") is not None:
        values["memory"] = "none"
    return values
