"""The page on a learned glove: its markers and how well they fit, the hands, and columns left out."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gloves.layout import MarkerPlace
from handsim.pages import NOTHING, Section, html_list, write_sections
from track.gloves.learned_glove import LearnedGlove
from train.reports.hand_plot import HAND_CAPTION, residual_picture

_MARKERS_TEXT = (
    "Along: 0 at the bone's near end, 1 at its far end. Around: 0 on the back, 90 on the thumb's side. "
    "Across: hand breadths from the palm's middle towards the thumb. Residual: root mean square distance of "
    "the marker from its place on the fitted hands. Between hands: root mean square distance of the hands' "
    "own places from the layout's."
)
_HANDS_TEXT = (
    "Lengths and breadths are those of the fitted hands. Markers on a bone show its direction well and its "
    "length poorly, so that these are rough until <code>handsim calibrate</code>."
)


def write_learned_page(path: Path, learned: LearnedGlove, captures: Sequence[str] = ()) -> None:
    """Write the page on a learned glove; the captures have numbers unless their names are given."""
    layout = learned.layout
    caption = f"{HAND_CAPTION}Colors: distance of a marker's points from its place on the fitted hands."
    drawn = residual_picture(layout, np.nan_to_num(marker_residuals(learned)))
    left = html_list(learned.left_out, "ul") if learned.left_out else "Every column belongs to a hand."
    sections = [
        Section("Markers", _MARKERS_TEXT, pictures=[(drawn, caption)], table=marker_rows(learned)),
        Section("Hands", _HANDS_TEXT, table=hand_rows(learned, captures)),
        Section("Columns left out", left),
    ]
    lead = f"{origin(learned)}. The markers have a radius of {1e3 * layout.radius:.1f} mm."
    write_sections(path, sections, title=f"Layout {layout.name}", lead=lead)


def origin(learned: LearnedGlove) -> str:
    """Number of markers, and of the hands from which they were learned, in words."""
    count = len(learned.hands)
    hands = "one hand" if count == 1 else f"{count} hands"
    return f"{learned.layout.num_markers} markers, learned from {hands} in labeled captures"


def marker_rows(learned: LearnedGlove) -> list[list[str]]:
    """Table of the markers, header first: their places, residuals, and how much they differ between hands."""
    rows = [
        ["marker", "bone", "along", "around [deg]", "across", "residual [mm]", "between hands [mm]"]
    ]  # fmt: skip
    worn = [name for one in learned.hands for name in one.columns]
    figures = zip(learned.layout.markers, marker_residuals(learned), learned.spreads, strict=True)
    for marker, residual, spread in figures:
        # The places of a single hand differ from the layout by rounding alone.
        differs = _millimeters(spread if worn.count(marker.name) > 1 else np.nan)
        rows.append([marker.name, marker.bone, *_place_cells(marker), _millimeters(residual), differs])
    return rows


def hand_rows(learned: LearnedGlove, captures: Sequence[str] = ()) -> list[list[str]]:
    """Table of the hands of each capture, header first; a capture has its name or number."""
    rows = [["capture", "hand", "markers", "length [mm]", "breadth [mm]"]]
    for one in learned.hands:
        capture, shape = captures[one.capture] if captures else str(one.capture + 1), one.hand.shape
        size = [f"{1e3 * measure:.0f}" for measure in (shape.length, shape.breadth)]
        rows.append([capture, one.hand.side, str(len(one.columns)), *size])
    return rows


def marker_residuals(learned: LearnedGlove) -> Float[np.ndarray, "M"]:
    """Root mean square residual of each marker over the hands that have it [m]; NaN if none has."""
    residuals = np.array([one.residuals for one in learned.hands])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a marker without a column
        return np.asarray(np.sqrt(np.nanmean(residuals**2, axis=0)))


def _place_cells(marker: MarkerPlace) -> list[str]:
    """The numbers of a place, as in a layout's file."""
    across = f"{marker.across:.2f}" if marker.bone == "palm" else ""
    around = np.rad2deg(marker.around).round() + 0.0  # never -0
    return [f"{marker.along:.2f}", f"{around:.0f}", across]


def _millimeters(distance: float) -> str:
    return f"{1e3 * distance:.1f}" if np.isfinite(distance) else NOTHING
