"""What users give: a capture, a glove or a labeler as objects, or by their names and paths."""

from __future__ import annotations

from pathlib import Path

from gloves.captures.capture import Capture
from gloves.captures.formats import read_capture
from gloves.layout import MarkerLayout, load_layout
from gloves.takes.take import Take, load_take
from handsim._checks import shown_value
from handsim.errors import ArgumentError, WeightsError
from train.glove_labeler import load_labeler
from train.labelers.protocol import Labeler

AnyCapture = Capture | Take | str | Path
"""A capture, or a take, of which only the points are used; or the path of one."""
AnyGlove = MarkerLayout | str | Path
AnyLabeler = Labeler | str | Path | None
"""A labeler, what `load_labeler` reads, or None for the one of the glove."""


def capture_of(capture: AnyCapture) -> Capture:
    """The points of a capture or a take, without labels.

    Raises:
        CaptureError: The file is missing, damaged or of another kind.
    """
    if isinstance(capture, str | Path):
        capture = read_points(capture)
    return capture if isinstance(capture, Capture) else capture.capture()


def read_points(path: str | Path) -> Capture | Take:
    """The capture or take of a file.

    Raises:
        CaptureError: The file is missing, damaged or of another kind.
    """
    if str(path).lower().endswith((".npz", ".npz.part")):
        return load_take(path)
    return read_capture(path)


def glove_of(glove: AnyGlove) -> MarkerLayout:
    """A marker layout.

    Raises:
        LayoutError: There is no such layout, or its file is wrong.
    """
    return glove if isinstance(glove, MarkerLayout) else load_layout(glove)


def labeler_of(glove: MarkerLayout, labeler: AnyLabeler) -> Labeler:
    """A labeler of a glove's markers.

    Raises:
        ArgumentError: It is something else.
        WeightsError: The labeler is unknown, damaged, or knows other markers.
    """
    if labeler is None or isinstance(labeler, str | Path):
        return load_labeler(glove, labeler)
    if not callable(getattr(labeler, "label_frames", None)):
        raise ArgumentError(
            f"labeler is {shown_value(labeler)}, expected a Labeler, or the name or path of one"
        )
    if labeler.marker_names != glove.names:
        raise WeightsError(
            f"the labeler knows markers {', '.join(labeler.marker_names)}, but glove '{glove.name}' has "
            f"{', '.join(glove.names)}"
        )
    return labeler
