"""`HandDetector`: finds the hands in a picture, gloved or bare, with boxes, sides and 21 keypoints.

One network, the finder, locates hands in the whole picture. A second network sees each hand twice: as it is
in the picture, then rotated so that its fingers point up. Both are trained on drawn hands and on photographs
without hands (`film.training`). OpenCV runs them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import ArrayLike
from scipy.special import expit, softmax

from handsim._checks import check_array, check_choice, check_type
from handsim._process import with_own_numerics
from handsim.errors import ArgumentError, WeightsError
from handsim.files.inputs import read_bytes
from handsim.files.models import check_model
from handsim.hand.shape import NUM_KEYPOINTS, SIDES, Side
from render.frames import Bytes, Doubles, Floats

WEIGHTS: Final = Path(__file__).parent / "weights"
FINDER, KEYPOINTS = "finder.onnx", "keypoints.onnx"  # files in a folder of weights
FINDER_SIZE: Final = 256  # side of the square picture that the finder takes [px]
CELL: Final = 8  # side of a cell of the finder's map [px]
CROP_SIZE: Final = 128  # side of the square picture that the keypoint network takes [px]
HEAT_SIZE: Final = 16  # cells of a keypoint's map, each way
NEAR: Final = 0.2  # A keypoint is the mean of the heat within this distance of its peak [share of the side].
ROOM: Final = 1.55  # side of the square that is cut out around a hand, over the hand's longer side
_WRIST, _INDEX, _MIDDLE, _LITTLE = 0, 5, 9, 17  # keypoints: the wrist, and the knuckles of three fingers
MOST_BYTES: Final = 1 << 26  # largest file of weights [bytes]
_MOST_CANDIDATES: Final = 8  # largest number of places in a picture that the keypoint network sees
_LEAST_HEAT: Final = 0.07
"""Least heat of the finder at a place that the keypoint network sees.

In 176 photographs these are 5 places a picture, and they have all hands that a threshold of 0.04 finds (7
places a picture). A threshold of 0.1 (3 places) misses 5 of 26 hands.
"""
_LEAST_FIRST_LOG_ODDS: Final = -3.0
"""Least log-odds of a hand after the first look at a place for a second look.

In the same 176 photographs half of the places have less, and the hands that are found have -1.9 or more.
"""
_LEAST_CONFIDENCE: Final = 0.5
_SAME_HAND_OVERLAP: Final = 0.6  # largest intersection over union of the boxes of two hands


@dataclass(frozen=True, slots=True, eq=False)
class FoundHand:
    """One hand in a picture."""

    side: Side
    box: Float[np.ndarray, "4"]
    """Left, top, width, height [px] of the box around its keypoints."""
    confidence: float
    """Probability that this is a hand, from 0 to 1."""
    keypoints: Float[np.ndarray, "21 2"]
    """Pixels from the picture's corner, as in `RenderedFrame` [px]."""
    scores: Float[np.ndarray, "21"]
    """Certainty of each keypoint, from 0 to 1."""


class _SquareResult(NamedTuple):
    """Output of the keypoint network for one square."""

    keypoints: Doubles  # keypoints (21, 2) in the picture [px]
    scores: Doubles  # certainty (21,) of each keypoint, from 0 to 1
    presence: float  # log-odds of a hand
    right: float  # log-odds of a right hand


class Candidate(NamedTuple):
    """A place in a picture where the finder sees a hand."""

    corners: Doubles  # upper left and lower right corner (2, 2) of the square around it [px]
    log_odds: float  # log-odds of a hand


class HandDetector:
    """Finds hands in pictures, on one core.

    Args:
        finder: ONNX model, written by `film.training`, that locates hands in a picture.
        keypoints: ONNX model, written by `film.training`, that locates 21 keypoints in a hand's square.
    """

    def __init__(self, finder: bytes, keypoints: bytes) -> None:
        networks = []
        for content in (finder, keypoints):
            check_model(content)  # because OpenCV may crash on damaged files
            networks.append(cv2.dnn.readNetFromONNX(np.frombuffer(content, dtype=np.uint8)))
        self._finder, self._keypoints = networks
        cells = FINDER_SIZE // CELL
        found = _run(self._finder, np.zeros((3, FINDER_SIZE, FINDER_SIZE), np.float32), ("cells",))
        found += _run(self._keypoints, np.zeros((3, CROP_SIZE, CROP_SIZE), np.float32), ("heat", "logits"))
        shapes = [array.shape for array in found]
        if shapes != [(1, 4, cells, cells), (1, NUM_KEYPOINTS, HEAT_SIZE, HEAT_SIZE), (1, 2)]:
            raise ValueError(f"outputs have the shapes {shapes}")

    @classmethod
    def load(cls, path: str | Path | None = None) -> HandDetector:
        """The detector of a folder that `train_detector` wrote; the shipped one when not given.

        Raises:
            WeightsError: A file is missing, larger than 64 MiB, or not one of a detector.
        """
        folder = WEIGHTS if path is None else Path(path)
        files = (folder / FINDER, folder / KEYPOINTS)
        contents = [read_bytes(file, error=WeightsError, max_bytes=MOST_BYTES) for file in files]
        try:
            return cls(*contents)
        except Exception as error:  # OpenCV's errors of damaged files have no class of their own
            raise WeightsError(
                f"{folder}: {FINDER} and {KEYPOINTS} are damaged or not a hand detector's, expected what "
                "film.train_detector wrote"
            ) from error

    @with_own_numerics
    def detect(self, image: UInt8[np.ndarray, "H W 3"]) -> list[FoundHand]:
        """Find all hands in an sRGB picture, the most certain first.

        Raises:
            ArgumentError: The picture is no array of bytes with three channels.
        """
        _check_picture(image)
        hands = []
        for candidate in self._candidates(image):
            first = self._look(image, square_around(candidate.corners))
            if candidate.log_odds + first.presence > _LEAST_FIRST_LOG_ODDS:
                hands.append(self._second_look(image, first, candidate.log_odds))
        boxes, confidences = [hand.box.tolist() for hand in hands], [hand.confidence for hand in hands]
        kept = cv2.dnn.NMSBoxes(boxes, confidences, _LEAST_CONFIDENCE, _SAME_HAND_OVERLAP)
        return [hands[number] for number in kept]

    @with_own_numerics
    def refine(
        self, image: UInt8[np.ndarray, "H W 3"], boxes: ArrayLike, sides: Sequence[Side]
    ) -> list[FoundHand]:
        """Find one hand in each of some known boxes, without a search of the picture.

        Args:
            image: sRGB picture.
            boxes: Left, top, width, height (N, 4) of the box around each hand's keypoints [px].
            sides: Side of each hand, which is not checked.

        Returns:
            A hand for each box; its `confidence` is the probability that the box has one.

        Raises:
            ArgumentError: An argument has another shape, or a box no size.
        """
        _check_picture(image)
        rows = check_array("boxes", boxes, (4,)).reshape(-1, 4) if np.size(boxes) else np.empty((0, 4))
        if len(rows) != len(sides):
            raise ArgumentError(f"there are {len(rows)} boxes and {len(sides)} sides, expected one for each")
        if not (rows[:, 2:] > 0.0).all():
            raise ArgumentError("a box has no size, expected left, top, width, height [px]")
        hands = []
        for box, side in zip(rows, sides, strict=True):
            check_choice(side, SIDES, noun="side")
            first = self._look(image, square_around(np.array([box[:2], box[:2] + box[2:]])))
            hands.append(self._second_look(image, first, 0.0, side))
        return hands

    def _candidates(self, picture: Bytes) -> list[Candidate]:
        """Places where the finder sees hands in an sRGB picture, the most probable first."""
        scale = FINDER_SIZE / max(picture.shape[:2])
        height, width = (round(scale * side) for side in picture.shape[:2])
        square = np.zeros((3, FINDER_SIZE, FINDER_SIZE), np.float32)
        square[:, :height, :width] = normalized(cut(picture, scale * np.eye(2, 3), (width, height)))
        (cells,) = _run(self._finder, square, ("cells",))
        heat = expit(cells[0, 0])
        peaks = (heat >= cv2.dilate(heat, np.ones((3, 3), np.uint8))) & (heat > _LEAST_HEAT)
        rows, columns = np.nonzero(peaks)
        order = np.argsort(-heat[rows, columns])[:_MOST_CANDIDATES]
        candidates = []
        for row, column in zip(rows[order], columns[order], strict=True):
            *offset, size = cells[0, 1:, row, column].astype(np.float64)
            center = CELL * (np.array([column, row]) + 0.5 + offset) / scale
            half = 0.5 * CELL * float(np.exp(size)) / scale
            log_odds = float(cells[0, 0, row, column])
            candidates.append(Candidate(np.array([center - half, center + half]), log_odds))
        return candidates

    def _look(self, picture: Bytes, matrix: Doubles) -> _SquareResult:
        """Run the keypoint network on the square that a matrix (2, 3) cuts out of a picture."""
        square = cut(picture, matrix, (CROP_SIZE, CROP_SIZE))
        heat, logits = _run(self._keypoints, normalized(square), ("heat", "logits"))
        keypoints, scores = peaks_of(heat[0])
        to_picture = np.linalg.inv(matrix[:, :2])
        presence, palm = (float(value) for value in logits[0])
        right = palm * float(np.sign(palm_spread(keypoints)))
        return _SquareResult((CROP_SIZE * keypoints - matrix[:, 2]) @ to_picture.T, scores, presence, right)

    def _second_look(
        self, picture: Bytes, first: _SquareResult, prior: float, side: Side | None = None
    ) -> FoundHand:
        """Locate the hand again in an upright square around the keypoints of the first look.

        The finder's log-odds are the prior. The mean log-odds of both looks is added: half of the training
        squares had hands, so these carry no prior, and both looks see the same pixels, so they are not
        summed.
        """
        second = self._look(picture, square_around(first.keypoints, rotation=upright(first.keypoints)))
        if side is None:
            side = "right" if first.right + second.right > 0.0 else "left"
        box = np.concatenate([second.keypoints.min(axis=0), np.ptp(second.keypoints, axis=0)])
        confidence = float(expit(prior + 0.5 * (first.presence + second.presence)))
        return FoundHand(side, box, confidence, second.keypoints, expit(second.presence) * second.scores)


def square_around(
    points: Doubles, room: float = ROOM, size: int = CROP_SIZE, rotation: Doubles | None = None
) -> Doubles:
    """Matrix (2, 3) from a rotated picture to a square of `size` pixels around the box of points.

    Points (N, 2) and pixels of the square are counted from corners.
    """
    rotation = np.eye(2) if rotation is None else rotation
    rotated = points @ rotation.T
    low, high = rotated.min(axis=0), rotated.max(axis=0)
    scale = size / (room * max(float((high - low).max()), 1.0))
    return np.column_stack([scale * rotation, 0.5 * size - scale * 0.5 * (low + high)])


def upright(keypoints: Doubles) -> Doubles:
    """Rotation (2, 2) of a picture that puts the knuckle of the middle finger above the wrist."""
    x, y = keypoints[_MIDDLE] - keypoints[_WRIST]
    length = float(np.hypot(x, y))
    return np.array([[-y, x], [-x, -y]]) / length if length > 0.0 else np.eye(2)


def palm_spread(keypoints: Doubles | Floats) -> float:
    """Signed area between wrist, index knuckle and little knuckle, times two [px^2].

    It is positive where the camera sees the palm of a right hand or the back of a left hand, else negative.
    """
    index, little = keypoints[[_INDEX, _LITTLE]] - keypoints[_WRIST]
    return float(index[1] * little[0] - index[0] * little[1])


def cut(picture: Bytes, matrix: Doubles, size: tuple[int, int]) -> Bytes:
    """Warp a picture by a matrix (2, 3) into one of a width and height; its border is repeated outside."""
    linear, shift = matrix[:, :2], matrix[:, 2].copy()
    corners = (np.array([[0, 0], [size[0], 0], [0, size[1]], size]) - shift) @ np.linalg.inv(linear).T
    limit = np.array(picture.shape[1::-1])
    low = np.clip(np.floor(corners.min(axis=0)) - 2, 0, limit - 1).astype(int)
    high = np.clip(np.ceil(corners.max(axis=0)) + 2, low + 1, limit).astype(int)
    part, shift = np.ascontiguousarray(picture[low[1] : high[1], low[0] : high[0]]), shift + linear @ low
    if (scale := float(np.sqrt(abs(np.linalg.det(linear))))) < 0.5:  # because fine detail would alias
        small = np.maximum(np.round((high - low) * scale * 1.5), 1).astype(int)
        linear = linear * ((high - low) / small)
        part = cv2.resize(part, small.tolist(), interpolation=cv2.INTER_AREA)
    moved = np.column_stack([linear, shift + linear @ [0.5, 0.5] - 0.5])  # OpenCV counts from pixels' centers
    return np.asarray(cv2.warpAffine(part, moved, size, borderMode=cv2.BORDER_REPLICATE))


def normalized(picture: Bytes) -> Floats:
    """Input (3, H, W) of the networks for a picture (H, W, 3): mean 0 and standard deviation 1."""
    values = np.ascontiguousarray(picture.transpose(2, 0, 1), dtype=np.float32)
    return np.asarray((values - values.mean()) / (values.std() + 1.0))


def peaks_of(heat: Floats) -> tuple[Doubles, Doubles]:
    """Locate the peak (..., 2) of maps (..., S, S) as shares of their side, and the shares of heat near it.

    Only heat near the highest peak counts: the mean of a map with peaks at two fingers lies between them.
    """
    centers = (np.arange(HEAT_SIZE) + 0.5) / HEAT_SIZE
    cells = np.stack(np.meshgrid(centers, centers, indexing="xy"), axis=-1).reshape(-1, 2)
    share = softmax(heat.reshape(*heat.shape[:-2], -1).astype(np.float64), axis=-1)
    distances = np.linalg.norm(cells - cells[share.argmax(axis=-1)][..., None, :], axis=-1)
    near = np.where(distances > NEAR, 0.0, share)
    scores = near.sum(axis=-1)
    return near @ cells / scores[..., None], scores


def _check_picture(image: Bytes) -> None:
    check_type("image", image, np.ndarray, "a picture (H, W, 3) of bytes")
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise ArgumentError(f"image is {image.dtype} {image.shape}, expected sRGB as uint8 (H, W, 3)")


def _run(network: Any, picture: Floats, outputs: Sequence[str]) -> list[Floats]:
    """Run a network on one picture (3, H, W)."""
    network.setInput(picture[None])
    return [np.asarray(array) for array in network.forward(outputs)]
