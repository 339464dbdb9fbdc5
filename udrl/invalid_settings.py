"""What is wrong with the value of a setting, in the words of the documentation."""

import json
import re
from typing import Any

import msgspec

#: The types in messages of msgspec, as TOML has them.
_TYPES = {
    "array": "a list", "bool": "true or false", "float": "a number", "int": "an integer",
    "null": "unset", "object": "a table", "str": "a string",
}  # fmt: skip


def in_words(
    error: msgspec.ValidationError, kind: type[msgspec.Struct], name: str, value: Any
) -> str:
    """Return msgspec's message about the value of a setting in the words of the documentation."""
    text = re.sub(r" - at `\$\.\w+`$", "", str(error))  # the setting is named already
    if text.startswith("Invalid enum value") and (choices := _choices(kind, name)):
        return f"expected {' or '.join(map(repr, choices))}"
    example = ""
    if text.startswith("Expected `array`"):
        example = f"; e.g. [{json.dumps(value, default=str)}]"
    elif text.startswith("Expected `object`"):
        example = '; e.g. {name="value"}'
    words = re.sub(
        r"`([a-z |]+)`", lambda m: " or ".join(_TYPES.get(t, t) for t in m[1].split(" | ")), text
    )
    return words[0].lower() + words[1:] + example


def _choices(kind: type[msgspec.Struct], name: str) -> tuple[Any, ...]:
    """Return the values of a setting that has a fixed set of them."""
    info = msgspec.inspect.type_info(kind)
    assert isinstance(info, msgspec.inspect.StructType)
    (found,) = (field.type for field in info.fields if field.name == name)
    types = found.types if isinstance(found, msgspec.inspect.UnionType) else (found,)
    literals = [t for t in types if isinstance(t, msgspec.inspect.LiteralType)]
    return tuple(value for t in literals for value in t.values)
