"""A user's own photographs of hands with labeled keypoints, cut out as a stream's pictures are."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int64, UInt8
from numpy.typing import NDArray

from handsim.errors import DatasetError
from handsim.files.json_files import load_json
from handsim.files.outputs import plain_path
from handsim.hand.shape import NUM_KEYPOINTS, SIDES

_CENTER: Final = 0.5  # COCO counts pixels from the first one's center, we count from its corner
_FEWEST: Final = 3  # labeled keypoints of a hand that can be cut out
_FREE: Final = 0.8  # of the room around a hand in a picture, which it is shifted within


class LabeledHand(NamedTuple):
    """One labeled hand."""

    file: Path
    keypoints: Float[np.ndarray, "21 2"]
    """[px] from the photograph's corner; NaN for those without a label."""
    visible: Bool[np.ndarray, "21"]
    side: int
    """0 left, 1 right, -1 unknown."""


class CutOut(NamedTuple):
    """A square of a photograph with a hand."""

    rgb: UInt8[np.ndarray, "S S 3"]
    keypoints: Float[np.ndarray, "21 2"]
    """[px] from the square's corner; NaN for those without a label."""
    visible: Bool[np.ndarray, "21"]
    box: Float[np.ndarray, "4"]
    """Left, top, width, height around the labeled keypoints [px]."""
    side: Int64[np.ndarray, ""]


def load_labeled_hands(file: str | Path) -> list[LabeledHand]:
    """The hands of a file of COCO keypoints, 21 each in our order; pictures are beside it or in `images`."""
    path = Path(file)
    content = load_json(path)
    try:
        names = {image["id"]: image["file_name"] for image in content["images"]}
        labels = [(names[one["image_id"]], one) for one in content["annotations"] if "keypoints" in one]
    except (KeyError, TypeError) as error:
        raise DatasetError(
            f"{path}: not COCO keypoints ({error}), expected images with `file_name` and annotations with "
            "`image_id` and `keypoints`"
        ) from error
    hands = [_hand(path, name, label) for name, label in labels]
    kept = [hand for hand in hands if np.isfinite(hand.keypoints[:, 0]).sum() >= _FEWEST]
    if not kept:
        raise DatasetError(f"{path}: no hand with {_FEWEST} labeled keypoints or more")
    return kept


def _hand(path: Path, name: str, label: dict[str, Any]) -> LabeledHand:
    rows = np.asarray(label["keypoints"], dtype=np.float64)
    if rows.shape != (3 * NUM_KEYPOINTS,):
        raise DatasetError(
            f"{path}: {rows.size} numbers of keypoints of a hand, expected {3 * NUM_KEYPOINTS}: x, y and "
            f"visibility of {NUM_KEYPOINTS}"
        )
    places = (path.parent / name, path.parent / "images" / name)
    photograph = next((one for one in places if one.is_file()), None)
    if photograph is None:
        raise DatasetError(f"{path}: no photograph {name} beside it or in its folder images")
    pixels, flags = rows.reshape(-1, 3)[:, :2] + _CENTER, rows[2::3]
    side = label.get("side")
    return LabeledHand(
        photograph,
        np.where(flags[:, None] > 0.0, pixels, np.nan),
        flags > 1.0,
        SIDES.index(side) if side in SIDES else -1,
    )


def cut_out(hand: LabeledHand, size: int, share: float, *, rng: np.random.Generator) -> CutOut:
    """A square of `size` pixels around a hand, whose labeled keypoints span a share of it, somewhere in it.

    What is outside of the photograph has the color of its border.
    """
    with plain_path(hand.file) as plain:
        photograph = cv2.imread(str(plain), cv2.IMREAD_COLOR)
    if photograph is None:
        raise DatasetError(f"{hand.file}: not a readable photograph")
    low, high = np.nanmin(hand.keypoints, axis=0), np.nanmax(hand.keypoints, axis=0)
    side = max(float((high - low).max()), 1.0) / share
    corner = 0.5 * (low + high - side) + _FREE * rng.uniform(-0.5, 0.5, 2) * (side - (high - low))
    scale = size / side
    # Of pixels counted from their centers, as OpenCV does.
    shift = -scale * corner + 0.5 * (scale - 1.0)
    matrix = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
    if scale < 0.5:  # or fine detail would become noise
        photograph = cv2.GaussianBlur(photograph, (0, 0), 0.4 / scale)
    square = cv2.warpAffine(photograph, matrix, (size, size), borderMode=cv2.BORDER_REPLICATE)
    keypoints: NDArray[np.float64] = (hand.keypoints - corner) * scale
    box = np.array([*(low - corner), *(high - low)]) * scale
    return CutOut(
        np.asarray(cv2.cvtColor(square, cv2.COLOR_BGR2RGB)),
        keypoints,
        hand.visible,
        box,
        np.array(hand.side, dtype=np.int64),
    )
