"""Line styles that can be distinguished in grey and by the colour-blind.

Colours are those of Okabe and Ito. Lines also differ in dash patterns and markers.
"""

from typing import Any

#: The palette without its yellow, which is too light for a line on white.
_COLOURS = ("#009E73", "#0072B2", "#D55E00", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
# The numbers of dashes and markers are coprime, so 36 lines have different pairs.
_DASHES = ("-", "--", "-.", ":")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "h")


def line_style(rank: int) -> dict[str, Any]:
    """Return matplotlib's keyword arguments for a line; ``rank`` counts from 0."""
    return {
        "color": _COLOURS[rank % len(_COLOURS)],
        "linestyle": _DASHES[rank % len(_DASHES)],
        "marker": _MARKERS[rank % len(_MARKERS)],
        "markersize": 5,
        "linewidth": 1.5,
    }
