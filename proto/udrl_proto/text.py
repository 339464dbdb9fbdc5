"""Text from other processes, made safe for logs and terminals."""


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
