"""A video of hands and points in one view, drawn without OpenGL and without a display."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from handsim.errors import ArgumentError, FileError
from handsim.files.outputs import atomic_write, plain_path, unwritten
from handsim.hand.model import HandModel
from render.illustrations.scene import Balls, HandScene, PosedHand, View, render_rgb, view_along

SUFFIX: Final = ".mp4"
_SIZE: Final = (800, 600)  # [px]
_CODEC: Final = "mp4v"  # part of every build of OpenCV
_AHEAD: Final = (-0.62, 0.62, -0.48)  # direction of view, as the viewer's first look
_TEXT: Final = (60, 60, 60)


class ClipFrame(NamedTuple):
    """One picture of a video."""

    hands: Sequence[tuple[HandModel, Float[np.ndarray, "27"]]]
    """Hands with their poses in the world [m, rad]."""
    points: Float[np.ndarray, "N 3"]
    """World [m]."""
    colors: Float[np.ndarray, "N 3"]
    """Of the points, sRGB in [0, 1]."""
    caption: str
    """One line of text at the bottom."""


def write_clip(
    path: Path,
    frames: Iterable[tuple[object, ...]],
    *,
    rate: float,
    shown: Float[np.ndarray, "N 3"],
    radius: float,
) -> None:
    """Write a video (.mp4) of frames with the fields of `ClipFrame`, whole or not at all.

    The view shows some points in the world [m]; points of frames have this radius [m].
    """
    if path.suffix.lower() != SUFFIX:
        raise ArgumentError(f"cannot write a video as '{path}', expected a name that ends in {SUFFIX}")
    view = view_along(np.array(_AHEAD), np.array([0.0, 0.0, 1.0]), shown, _SIZE)
    try:
        with atomic_write(path) as temporary, plain_path(temporary) as plain:
            writer = cv2.VideoWriter(str(plain), cv2.VideoWriter.fourcc(*_CODEC), rate, _SIZE)
            try:
                if not writer.isOpened():
                    raise FileError(f"{path}: OpenCV cannot write a video of the codec {_CODEC} here")
                for frame in frames:
                    picture = draw_frame(ClipFrame(*frame), view, radius)  # type: ignore[arg-type]
                    writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
            finally:
                writer.release()
            _check_written(plain)
    except OSError as error:
        raise FileError(f"{path}: cannot be written: {error.strerror or error}") from error


def _check_written(path: Path) -> None:
    """Check that a video can be read: OpenCV does not notice failed writes, such as on a full disk."""
    reader = cv2.VideoCapture(str(path))
    try:
        if not reader.isOpened():
            raise unwritten(path)
    finally:
        reader.release()


def draw_frame(frame: ClipFrame, view: View, radius: float) -> np.ndarray:
    """A picture (H, W, 3) of a frame, sRGB; hands without a pose are left out.

    Args:
        radius: Radius of the points [m].
    """
    hands = tuple(PosedHand(model, qpos) for model, qpos in frame.hands if np.isfinite(qpos).all())
    balls = (Balls(frame.points, radius, frame.colors),) if len(frame.points) else ()
    picture = render_rgb(HandScene(view, hands, balls), _SIZE)
    place = (16, _SIZE[1] - 18)
    cv2.putText(picture, frame.caption, place, cv2.FONT_HERSHEY_SIMPLEX, 0.55, _TEXT, 1, cv2.LINE_AA)
    return picture
