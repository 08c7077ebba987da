"""The picture of a hand whose joints are colored by how uncertain the markers leave them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Float

from handsim.hand.topology import JOINTS
from train.reports.flat_hand import FlatHand
from train.reports.plot_style import BAND, BLUE, CARD, INK, LINE, PALE, SOFT, WARM

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIZE: Final = (8.4, 6.4)
"""Of the picture [inch]."""
_MOST: Final = 15.0  # [deg], the end of the colors' scale
_DOT: Final = 15.0  # [points]
_MARKER: Final = 5.0


def draw_joints(figure: Figure, hand: FlatHand, joints: Float[np.ndarray, "20"]) -> None:
    """Draw a disk at each bone's near end: the worst joint there, in degrees.

    Args:
        figure: Where to draw, of `SIZE`.
        hand: Hand and markers.
        joints: Standard deviation of each joint [rad].
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    panel = figure.subplots()
    panel.set_axis_off()
    panel.set_aspect("equal")
    outline = Path.make_compound_path(*(Path(loop, closed=True) for loop in hand.outlines))
    panel.add_patch(PathPatch(outline, facecolor=BAND, edgecolor=LINE, linewidth=1.0))
    for bone in hand.bones:
        panel.plot(*bone.T, color=LINE, linewidth=2.5, solid_capstyle="round", zorder=1)
    panel.plot(*hand.markers.T, "o", color=SOFT, markersize=_MARKER, markerfacecolor=CARD, zorder=2)
    colors, norm = (
        LinearSegmentedColormap.from_list("spread", [BLUE, PALE, "#d9a441", WARM]),
        Normalize(0, _MOST),
    )
    degrees = np.rad2deg(joints)
    for bone in sorted({joint.bone for joint in JOINTS}):
        worst = max(degrees[number] for number, joint in enumerate(JOINTS) if joint.bone == bone)
        x, y = hand.bones[bone - 1][0]
        panel.plot(x, y, "o", markersize=_DOT, color=colors(norm(worst)), markeredgecolor=INK, zorder=3)
        panel.annotate(
            f"{worst:.0f}", (x, y), fontsize=7.5, ha="center", va="center_baseline", color=INK, zorder=4
        )
    bar = figure.colorbar(ScalarMappable(norm, colors), ax=panel, shrink=0.6, extend="max")
    bar.set_label("standard deviation of the worst joint [deg]")
    bar.outline.set_visible(False)
