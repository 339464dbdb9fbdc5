"""Text that came from others, on its way to a log or a terminal."""


def printable(text: object) -> str:
    r"""Return what a text says, with everything that a log or a terminal would obey written out.

    Letters of all scripts stay. Line ends, which would forge lines of a log, escape sequences,
    and marks that turn the direction of writing become ``\n``, ``\x1b``, ``\u202e`` and the like.
    """
    said = str(text)
    if said.isprintable():
        return said
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in said
    )
