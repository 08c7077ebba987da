"""The style of all reports' pictures: colors, fonts, and a picture as a `data:` URI.

matplotlib is imported when a picture is drawn, and pyplot never.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK, SOFT, LINE, BAND, CARD = "#23272f", "#5b6270", "#c3c8d0", "#e0e4e9", "#f4f5f7"
BLUE, PALE, WARM, GREEN, VIOLET = "#3f7396", "#a9c3d4", "#b8572b", "#5b8c5a", "#7a5ba0"
_STYLE: Final[dict[str, Any]] = {
    "font.size": 9.0,
    "text.color": INK,
    "axes.labelcolor": SOFT,
    "axes.labelsize": 9.0,
    "axes.titlesize": 9.5,
    "axes.edgecolor": LINE,
    "axes.facecolor": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": LINE,
    "ytick.color": LINE,
    "xtick.labelcolor": SOFT,
    "ytick.labelcolor": SOFT,
    "figure.facecolor": CARD,  # the page's card, light on dark pages too, so that no frame shows
    "savefig.facecolor": CARD,
    "svg.hashsalt": "handsim",  # ids that do not change from one run to the next
}


def picture(size: tuple[float, float], draw: Callable[[Figure], None]) -> str:
    """A figure of this size [inch] as SVG in a `data:` URI, the same bytes for the same numbers."""
    from matplotlib import style
    from matplotlib.figure import Figure

    drawn = io.BytesIO()
    with style.context(["default", _STYLE]):  # whatever the user's own settings are
        figure = Figure(figsize=size, layout="constrained")
        draw(figure)
        figure.savefig(drawn, format="svg", metadata={"Date": None, "Creator": None})
    return "data:image/svg+xml;base64," + base64.b64encode(drawn.getvalue()).decode()
