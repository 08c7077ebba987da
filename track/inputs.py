"""What users give: a capture, a glove or a labeler as objects, or by their names and paths."""

from __future__ import annotations

from pathlib import Path

from gloves.captures.capture import Capture
from gloves.captures.formats import READABLE, read_capture
from gloves.layout import MarkerLayout, list_layouts, load_layout
from gloves.takes.take import Take, load_take
from handsim._checks import check_type
from train.labelers.protocol import Labeler
from train.labelers.storage import load_labeler

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
    kinds = (Capture, Take, str, Path)
    check_type("capture", capture, kinds, "a Capture, a Take, or the path of a file", (*READABLE, ".npz"))
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


def labeler_of(worn: MarkerLayout, labeler: AnyLabeler) -> Labeler:
    """A labeler that knows the markers of a glove; see `load_labeler` for errors."""
    return load_labeler(worn if hasattr(labeler, "label_frames") else designed_glove(worn), labeler)


def designed_glove(worn: MarkerLayout) -> MarkerLayout:
    """The shipped layout of a glove as it is worn, whose markers may have slipped: labelers know that one."""
    if worn.name not in list_layouts():
        return worn
    designed = load_layout(worn.name)
    places, own = ([(one.name, one.bone) for one in glove.markers] for glove in (designed, worn))
    return designed if places == own else worn
