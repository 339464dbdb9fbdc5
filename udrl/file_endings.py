"""File name endings, which say in what format a file is written."""

from collections.abc import Sequence
from pathlib import Path

from udrl.errors import ConfigError


def check_ending(path: Path, endings: Sequence[str]) -> None:
    """Check the ending of a file's name.

    Args:
        path: the file.
        endings: the supported endings, at least one, e.g. ``.png``.

    Raises:
        ConfigError: the ending is another.
    """
    if path.suffix not in endings:
        *others, last = endings
        either = f"{', '.join(others)} or {last}" if others else last
        raise ConfigError(f"{path}: expected a name that ends with {either}")
