"""Ground truth of a hand in a picture: its keypoints, their visibility, and its box."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray

from handsim.hand.model import KEYPOINT_DIGITS, KEYPOINT_NAMES, hand_keypoints
from handsim.hand.shape import DIGITS, PALM, bones_of
from handsim.space.camera import Camera
from render.frames import PARTS_A_HAND, HandTruth, Pictures
from render.painting.figures import HandFigure
from render.skin.forearm import FOREARM

_PALM_SIDE: Final = [name == "wrist" or name.endswith(("CMC", "MCP")) for name in KEYPOINT_NAMES]
"""Which keypoints lie in the palm, too."""


def hand_truth(
    figure: HandFigure,
    qpos: Float[np.ndarray, "27"],
    number: int,
    camera: Camera,
    pictures: Pictures,
    *,
    recorded: bool = True,
) -> HandTruth:
    """Ground truth of a hand, by its number among those in the picture, from the camera's depth and parts.

    Vertices are computed where it is recorded.
    """
    model = figure.fit.model
    keypoints = hand_keypoints(model, qpos[None])[0]
    pixels = camera.project(keypoints)
    assert pictures.parts is not None
    worn = figure.look.glove is not None
    return HandTruth(
        shape=model.shape,
        qpos=qpos,
        keypoints=pixels,
        keypoints_world=keypoints,
        visible=_visible(keypoints, pixels, figure.thickness, number, camera, pictures),
        box=_box(pictures.parts, number),
        vertices=model.skin(qpos[None])[0].astype(np.float32) if recorded else np.empty((0, 3), np.float32),
        marker_names=figure.fit.layout.names if worn else (),
        markers=figure.markers(qpos) if worn else np.empty((0, 3)),
    )


def _visible(
    keypoints: NDArray[np.float64],
    pixels: NDArray[np.float64],
    thickness: NDArray[np.float64],
    number: int,
    camera: Camera,
    pictures: Pictures,
) -> Bool[np.ndarray, "21"]:
    """Keypoints whose pixel shows the finger that they are in.

    The pixel is one of this hand, of the keypoint's digit (or of the palm, where it is at its edge), and the
    keypoint is no deeper under the surface there than the finger is thick.
    """
    assert pictures.parts is not None and pictures.instances is not None and pictures.depth is not None
    width, height = camera.size
    inside = (pixels >= 0.0).all(axis=1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
    columns, rows = np.where(inside[:, None], pixels, 0.0).astype(np.int64).T
    bones = pictures.parts[rows, columns].astype(np.int64) - 1 - PARTS_A_HAND * number
    own = inside & (pictures.instances[rows, columns] == 1 + number) & (bones >= 0) & (bones < PARTS_A_HAND)
    own &= _ALLOWED[np.arange(len(keypoints)), np.where(own, bones, 0)]
    local = camera.local(keypoints)
    ahead = local[:, 2] > 0.0
    slant = np.linalg.norm(local, axis=1) / np.where(ahead, local[:, 2], np.inf)
    under = slant * (local[:, 2] - pictures.depth[rows, columns])
    # Fisheyes see sideways and back, where there is no depth: the hand's own surface must do.
    visible: NDArray[np.bool_] = own & np.where(ahead, under <= thickness, True)
    return visible


def _allowed_parts() -> Bool[np.ndarray, "21 32"]:
    """Parts of the hand that may show each keypoint: those of its digit; the wrist's the palm and forearm."""
    allowed = np.zeros((len(KEYPOINT_NAMES), PARTS_A_HAND), dtype=bool)
    for keypoint, digit in enumerate(KEYPOINT_DIGITS):
        allowed[keypoint, list(bones_of(DIGITS[digit])) if digit >= 0 else [FOREARM]] = True
        allowed[keypoint, PALM] = _PALM_SIDE[keypoint]
    return allowed


_ALLOWED: Final = _allowed_parts()


def _box(parts: UInt8[np.ndarray, "H W"], number: int) -> Float[np.ndarray, "4"]:
    """Left, top, width, height [px] of the visible hand without its forearm; NaN where none is visible."""
    first = 1 + PARTS_A_HAND * number
    mine = (parts >= first) & (parts < first + FOREARM)
    columns, rows = np.flatnonzero(mine.any(axis=0)), np.flatnonzero(mine.any(axis=1))
    if not len(columns):
        return np.full(4, np.nan)
    left, top = float(columns[0]), float(rows[0])
    return np.array([left, top, columns[-1] + 1.0 - left, rows[-1] + 1.0 - top])
