"""Ground truth of a hand in a picture: its keypoints, their visibility, and its box."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray

from handsim.hand.keypoints import hand_keypoints
from handsim.space.camera import Camera
from render.frames import PARTS_A_HAND, HandTruth, Pictures
from render.painting.figures import HandFigure
from render.skin.forearm import FOREARM

_SLANTING: Final = (
    2.0  # lines of sight may pass this many times a joint's flesh: they meet skin at 30 degrees
)


def hand_truth(
    figure: HandFigure, qpos: Float[np.ndarray, "27"], number: int, camera: Camera, pictures: Pictures
) -> HandTruth:
    """Ground truth of one hand.

    Args:
        figure: The hand.
        qpos: Pose of the hand.
        number: Index of the hand among those in the picture.
        camera: The camera.
        pictures: Depth and parts of that camera.
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
        visible=_visible(keypoints, pixels, figure.flesh, number, camera, pictures),
        box=_box(pictures.parts, number),
        vertices=model.skin(qpos[None])[0].astype(np.float32),
        marker_names=figure.fit.layout.names if worn else (),
        markers=figure.markers(qpos) if worn else np.empty((0, 3)),
    )


def _visible(
    keypoints: NDArray[np.float64],
    pixels: NDArray[np.float64],
    flesh: NDArray[np.float64],
    number: int,
    camera: Camera,
    pictures: Pictures,
) -> Bool[np.ndarray, "21"]:
    """Keypoints in the picture with nothing in front of them but the flesh around them.

    Other hands and objects hide whatever is behind them; the hand itself hides what lies deeper under the
    surface that the pixel shows than the joint's own flesh reaches.
    """
    assert pictures.instances is not None and pictures.depth is not None
    width, height = camera.size
    inside = (pixels >= 0.0).all(axis=1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
    columns, rows = np.where(inside[:, None], pixels, 0.0).astype(np.int64).T
    instances, local = pictures.instances[rows, columns], camera.local(keypoints)
    mine, ahead = instances == 1 + number, local[:, 2] > 0.0
    slant = np.linalg.norm(local, axis=1) / np.where(ahead, local[:, 2], np.inf)
    under = slant * (local[:, 2] - pictures.depth[rows, columns])
    hidden = (instances > 0) & (under > np.where(mine, _SLANTING * flesh, 0.0))
    # Fisheyes see sideways and back, where there is no depth: the hand's own surface must do.
    visible: NDArray[np.bool_] = inside & np.where(ahead, ~hidden, mine)
    return visible


def _box(parts: UInt8[np.ndarray, "H W"], number: int) -> Float[np.ndarray, "4"]:
    """Left, top, width, height [px] of the visible hand without its forearm; NaN where none is visible."""
    first = 1 + PARTS_A_HAND * number
    mine = (parts >= first) & (parts < first + FOREARM)
    columns, rows = np.flatnonzero(mine.any(axis=0)), np.flatnonzero(mine.any(axis=1))
    if not len(columns):
        return np.full(4, np.nan)
    left, top = float(columns[0]), float(rows[0])
    return np.array([left, top, columns[-1] + 1.0 - left, rows[-1] + 1.0 - top])
