"""Pictures by matplotlib: an empty one, and writing one whole."""

import os
from pathlib import Path
from typing import TYPE_CHECKING

from udrl.errors import ConfigError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: What matplotlib can write.
_KINDS = (".png", ".svg", ".pdf")


def check_name(picture: Path) -> None:
    """Check that a file's name says a kind that can be written.

    Raises:
        ConfigError: it does not.
    """
    if picture.suffix not in _KINDS:
        raise ConfigError(f"{picture}: expected a name that ends with {', '.join(_KINDS)}")


def empty(columns: int = 1) -> "tuple[Figure, list[Axes]]":
    """Return a figure without lines, and its axes from left to right.

    Raises:
        ConfigError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise ConfigError(
            'pictures of curves need matplotlib; install it with: pip install "udrl[plot]"'
        ) from error
    figure = Figure(figsize=(7 if columns == 1 else 5.2 * columns, 4.3), layout="constrained")
    axes = [figure.add_subplot(1, columns, k + 1) for k in range(columns)]
    for one in axes:
        one.grid(alpha=0.3)
    return figure, axes


def save(figure: "Figure", picture: Path) -> None:
    """Write a picture; it is there as a whole or not at all.

    Raises:
        ConfigError: it cannot be written.
    """
    aside = picture.with_name(f"{picture.name}.part")
    try:
        picture.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(aside, format=picture.suffix[1:], dpi=130)
        os.replace(aside, picture)
    except OSError as error:
        raise ConfigError(f"{picture}: {error.strerror}; name a file you may write") from error
