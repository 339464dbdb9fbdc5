"""Text from other processes and file names, made safe for logs, terminals and JSON."""

import json

import msgspec


def printable(text: object) -> str:
    r"""Return a text with all characters escaped that are not printable.

    Letters of all scripts are kept. Line ends, which would forge log lines, escape sequences and
    marks that change the writing direction become ``\n``, ``\x1b``, ``\u202e`` and so on.
    """
    raw = str(text)
    if raw.isprintable():
        return raw
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in raw
    )


def as_json(value: object) -> bytes:
    r"""Return a value as JSON.

    Bytes of file names that are not UTF-8 become escapes such as ``\udcff``, from which Python gets
    the same file name.
    """
    try:
        return msgspec.json.encode(value)
    except UnicodeEncodeError:
        return json.dumps(msgspec.to_builtins(value)).encode()
