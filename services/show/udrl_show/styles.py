"""How lines of pictures look, so that they can be told apart in grey and by the colour-blind.

Colours are those of Okabe and Ito; every line has a dash pattern and a marker of its own as well.
"""

from typing import Any

#: The palette without its yellow, which is too light for a line on white.
_COLOURS = ("#009E73", "#0072B2", "#D55E00", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
# Their numbers have no common divisor: 36 lines pass before a pair comes again.
_DASHES = ("-", "--", "-.", ":")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "h")


def line_style(rank: int) -> dict[str, Any]:
    """Return matplotlib's keyword arguments for the line of a rank, from 0 on."""
    return {
        "color": _COLOURS[rank % len(_COLOURS)],
        "linestyle": _DASHES[rank % len(_DASHES)],
        "marker": _MARKERS[rank % len(_MARKERS)],
        "markersize": 5,
        "linewidth": 1.5,
    }
