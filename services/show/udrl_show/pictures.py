"""Creating and saving matplotlib figures."""

from pathlib import Path
from typing import TYPE_CHECKING

from udrl.atomic_files import replacing
from udrl.errors import ConfigError
from udrl.file_remedies import file_remedy

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Endings of the names of figures.
ENDINGS = (".png", ".svg", ".pdf")
#: Maximum number of panels in a row.
_MOST_COLUMNS = 3


def empty(panels: int = 1) -> "tuple[Figure, list[Axes]]":
    """Return a figure without lines, and the axes of its panels, row by row.

    Raises:
        ConfigError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise ConfigError(
            'figures need matplotlib; install it with: pip install "udrl[plot]"'
        ) from error
    columns = min(panels, _MOST_COLUMNS)
    rows = -(-panels // columns)
    size = (7 if columns == 1 else 5.2 * columns, 4.3 * rows)
    figure = Figure(figsize=size, layout="constrained")
    axes = [figure.add_subplot(rows, columns, k + 1) for k in range(panels)]
    for one in axes:
        one.grid(alpha=0.3)
    return figure, axes


def save(figure: "Figure", picture: Path) -> None:
    """Write a figure atomically. Dollar signs in its texts are not formulas, but parts of names.

    Raises:
        ConfigError: the file cannot be written.
    """
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        text.set_parse_math(False)
    try:
        picture.parent.mkdir(parents=True, exist_ok=True)
        with replacing(picture) as unfinished:
            figure.savefig(unfinished, format=picture.suffix[1:], dpi=130)
    except OSError as error:
        what_to_do = file_remedy(error, "choose a writable file")
        raise ConfigError(f"{picture}: {error.strerror}; {what_to_do}") from error
