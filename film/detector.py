"""`HandDetector`: the hands in a picture, gloved or bare, with boxes, sides and 21 keypoints.

A finder looks at the whole picture and tells centers and sizes of hands; a second network looks at each hand
twice: upright, then turned so that its fingers point up. Both learned from drawn hands, and from photographs
without hands what is none (`film.training`). OpenCV runs them.
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
from scipy.special import expit

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
_WRIST, _INDEX, _KNUCKLE, _LITTLE = 0, 5, 9, 17  # keypoints: the wrist, and where three fingers begin
MOST_BYTES: Final = 1 << 26  # of a file of weights
_MOST_FOUND: Final = 8  # places in a picture at which hands are looked for
_LEAST_HEAT: Final = 0.07
"""Least heat at a place where the keypoint network looks for a hand.

In 176 photographs these are 5 places a picture, with all hands that are found from 0.04 on (7 places); from
0.1 on (3 places) 5 of 26 are missed.
"""
_HOPELESS: Final = -3.0
"""Least log-odds of a hand, after the first look at a place, for a second look.

In the same 176 photographs half of the places have less, and the hands that are found have -1.9 or more.
"""
_LEAST_CONFIDENCE: Final = 0.5
_SAME: Final = 0.6  # Boxes whose intersection is a larger share of their union are of one hand.


@dataclass(frozen=True, slots=True, eq=False)
class FoundHand:
    """One hand in a picture."""

    side: Side
    box: Float[np.ndarray, "4"]
    """Left, top, width, height [px] of the box around its keypoints."""
    confidence: float
    """How sure it is that this is a hand, from 0 to 1."""
    keypoints: Float[np.ndarray, "21 2"]
    """[px] from the picture's corner, as in `RenderedFrame`."""
    scores: Float[np.ndarray, "21"]
    """How sure each keypoint is, from 0 to 1."""


class _SquareResult(NamedTuple):
    """What the keypoint network tells of one square."""

    keypoints: Doubles  # (21, 2) [px] of the picture
    scores: Doubles  # (21,)
    presence: float  # log-odds of a hand
    right: float  # log-odds of a right hand


class Place(NamedTuple):
    """A place in a picture that looks like a hand from afar."""

    corners: Doubles  # (2, 2) [px]
    log_odds: float  # of a hand


class HandDetector:
    """Finds hands in pictures, on one core.

    Args:
        finder: ONNX model that `film.training` writes: where hands are in a picture.
        keypoints: The other one: where 21 keypoints are in a hand's square.
    """

    def __init__(self, finder: bytes, keypoints: bytes) -> None:
        networks = []
        for content in (finder, keypoints):
            check_model(content)  # OpenCV may crash on damaged files
            networks.append(cv2.dnn.readNetFromONNX(np.frombuffer(content, dtype=np.uint8)))
        self._finder, self._keypoints = networks
        cells = FINDER_SIZE // CELL
        found = _run(self._finder, np.zeros((3, FINDER_SIZE, FINDER_SIZE), np.float32), ("cells",))
        told = _run(self._keypoints, np.zeros((3, CROP_SIZE, CROP_SIZE), np.float32), ("heat", "logits"))
        shapes = [array.shape for array in (*found, *told)]
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
        """All hands in an sRGB picture, the surest first.

        Raises:
            ArgumentError: The picture is no array of bytes with three channels.
        """
        _check_picture(image)
        first = [(place, self._look(image, square_around(place.corners))) for place in self._places(image)]
        hands = [
            self._second_look(image, look, place.log_odds)
            for place, look in first
            if place.log_odds + look.presence > _HOPELESS
        ]
        boxes, sure = [hand.box.tolist() for hand in hands], [hand.confidence for hand in hands]
        return [hands[number] for number in cv2.dnn.NMSBoxes(boxes, sure, _LEAST_CONFIDENCE, _SAME)]

    @with_own_numerics
    def refine(
        self, image: UInt8[np.ndarray, "H W 3"], boxes: ArrayLike, sides: Sequence[Side]
    ) -> list[FoundHand]:
        """The hands in known boxes, one each in their order, without a search of the picture.

        Args:
            image: sRGB picture.
            boxes: Left, top, width, height (N, 4) of the box around each hand's keypoints [px].
            sides: Side of each hand, which is believed.

        Returns:
            A hand for each box; its `confidence` tells whether there is one.

        Raises:
            ArgumentError: An argument has another shape, or a box no size.
        """
        _check_picture(image)
        places = check_array("boxes", boxes, (4,)).reshape(-1, 4) if np.size(boxes) else np.empty((0, 4))
        if len(places) != len(sides):
            raise ArgumentError(
                f"there are {len(places)} boxes and {len(sides)} sides, expected one for each"
            )
        if not (places[:, 2:] > 0.0).all():
            raise ArgumentError("a box has no size, expected left, top, width, height [px]")
        found = []
        for box, side in zip(places, sides, strict=True):
            check_choice(side, SIDES, noun="side")
            first = self._look(image, square_around(np.array([box[:2], box[:2] + box[2:]])))
            found.append(self._second_look(image, first, 0.0, side))
        return found

    def _places(self, picture: Bytes) -> list[Place]:
        """Where it may be worth to look for hands, the likeliest first."""
        scale = FINDER_SIZE / max(picture.shape[:2])
        matrix = np.array([[scale, 0.0, 0.0], [0.0, scale, 0.0]])
        seen = np.round(scale * np.array(picture.shape[:2])).astype(int)
        square = np.zeros((3, FINDER_SIZE, FINDER_SIZE), np.float32)
        square[:, : seen[0], : seen[1]] = normalized(cut(picture, matrix, (int(seen[1]), int(seen[0]))))
        (cells,) = _run(self._finder, square, ("cells",))
        heat = expit(cells[0, 0])
        peaks = (heat >= cv2.dilate(heat, np.ones((3, 3), np.uint8))) & (heat > _LEAST_HEAT)
        rows, columns = np.nonzero(peaks)
        order = np.argsort(-heat[rows, columns])[:_MOST_FOUND]
        places = []
        for row, column in zip(rows[order], columns[order], strict=True):
            *aside, size = cells[0, 1:, row, column].astype(np.float64)
            center = CELL * (np.array([column, row]) + 0.5 + aside) / scale
            half = 0.5 * CELL * float(np.exp(size)) / scale
            log_odds = float(cells[0, 0, row, column])
            places.append(Place(np.array([center - half, center + half]), log_odds))
        return places

    def _look(self, picture: Bytes, matrix: Doubles) -> _SquareResult:
        """What the keypoint network tells of the square that a matrix (2, 3) cuts out of a picture."""
        square = cut(picture, matrix, (CROP_SIZE, CROP_SIZE))
        heat, logits = _run(self._keypoints, normalized(square), ("heat", "logits"))
        keypoints, scores = peaks_of(heat[0])
        turn = np.linalg.inv(matrix[:, :2])
        presence, palm = (float(value) for value in logits[0])
        right = palm * float(np.sign(palm_spread(keypoints)))
        return _SquareResult((CROP_SIZE * keypoints - matrix[:, 2]) @ turn.T, scores, presence, right)

    def _second_look(
        self, picture: Bytes, first: _SquareResult, prior: float, side: Side | None = None
    ) -> FoundHand:
        """The hand, after a look at where the first look saw it, with its fingers up.

        The finder's log-odds are the prior. The mean log-odds of both looks is added: half of the training
        squares had hands, so these carry no prior, and both looks see the same pixels, so they are not
        summed.
        """
        look = self._look(picture, square_around(first.keypoints, turn=upright(first.keypoints)))
        if side is None:
            side = "right" if first.right + look.right > 0.0 else "left"
        low, high = look.keypoints.min(axis=0), look.keypoints.max(axis=0)
        box = np.concatenate([low, high - low])
        confidence = float(expit(prior + 0.5 * (first.presence + look.presence)))
        return FoundHand(side, box, confidence, look.keypoints, expit(look.presence) * look.scores)


def square_around(
    points: Doubles, room: float = ROOM, size: int = CROP_SIZE, turn: Doubles | None = None
) -> Doubles:
    """Matrix (2, 3) from a picture, turned, to a square of `size` pixels around the box of points.

    Points (N, 2) and pixels of the square are counted from corners.
    """
    turn = np.eye(2) if turn is None else turn
    moved = points @ turn.T
    low, high = moved.min(axis=0), moved.max(axis=0)
    scale = size / (room * max(float((high - low).max()), 1.0))
    return np.column_stack([scale * turn, 0.5 * size - scale * 0.5 * (low + high)])


def upright(keypoints: Doubles) -> Doubles:
    """The turn (2, 2) of a picture after which a hand's middle finger begins above its wrist."""
    x, y = keypoints[_KNUCKLE] - keypoints[_WRIST]
    length = float(np.hypot(x, y))
    return np.array([[-y, x], [-x, -y]]) / length if length > 0.0 else np.eye(2)


def palm_spread(keypoints: Doubles | Floats) -> float:
    """Signed area between wrist, index knuckle and little knuckle, times two [px^2].

    It is positive where the camera sees the palm of a right hand or the back of a left hand, else negative.
    """
    index, little = keypoints[[_INDEX, _LITTLE]] - keypoints[_WRIST]
    return float(index[1] * little[0] - index[0] * little[1])


def cut(picture: Bytes, matrix: Doubles, size: tuple[int, int]) -> Bytes:
    """What a matrix (2, 3) moves into a picture of a width and height; the border is repeated outside."""
    turn, shift = matrix[:, :2], matrix[:, 2].copy()
    corners = (np.array([[0, 0], [size[0], 0], [0, size[1]], size]) - shift) @ np.linalg.inv(turn).T
    limit = np.array(picture.shape[1::-1])
    low = np.clip(np.floor(corners.min(axis=0)) - 2, 0, limit - 1).astype(int)
    high = np.clip(np.ceil(corners.max(axis=0)) + 2, low + 1, limit).astype(int)
    part, shift = np.ascontiguousarray(picture[low[1] : high[1], low[0] : high[0]]), shift + turn @ low
    shrink = np.array([1.0, 1.0])
    if (scale := float(np.sqrt(abs(np.linalg.det(turn))))) < 0.5:  # fine detail would become noise
        small = np.maximum(np.round((high - low) * scale * 1.5), 1).astype(int)
        shrink = (high - low) / small
        part = cv2.resize(part, (int(small[0]), int(small[1])), interpolation=cv2.INTER_AREA)
    turn = turn * shrink
    moved = np.column_stack([turn, shift + turn @ [0.5, 0.5] - 0.5])  # OpenCV counts from pixels' centers
    return np.asarray(cv2.warpAffine(part, moved, size, borderMode=cv2.BORDER_REPLICATE))


def normalized(picture: Bytes) -> Floats:
    """A picture (H, W, 3) as the networks see it: (3, H, W), of mean 0 and deviation 1."""
    values = np.ascontiguousarray(picture.transpose(2, 0, 1), dtype=np.float32)
    return np.asarray((values - values.mean()) / (values.std() + 1.0))


def peaks_of(heat: Floats) -> tuple[Doubles, Doubles]:
    """Keypoints (..., 2) as shares of the side, and shares of the heat near them, of maps (..., S, S).

    A map that is torn between two fingers has its mean between them; the higher peak is one of them.
    """
    at = (np.arange(HEAT_SIZE) + 0.5) / HEAT_SIZE
    places = np.stack(np.meshgrid(at, at, indexing="xy"), axis=-1).reshape(-1, 2)
    flat = heat.reshape(*heat.shape[:-2], -1).astype(np.float64)
    share = np.exp(flat - flat.max(axis=-1, keepdims=True))
    share /= share.sum(axis=-1, keepdims=True)
    away = np.linalg.norm(places - places[flat.argmax(axis=-1)][..., None, :], axis=-1)
    near = np.where(away > NEAR, 0.0, share)
    scores = near.sum(axis=-1)
    return near @ places / scores[..., None], scores


def _check_picture(image: Bytes) -> None:
    check_type("image", image, np.ndarray, "a picture (H, W, 3) of bytes")
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise ArgumentError(
            f"image is {image.dtype} of shape {image.shape}, expected uint8 of shape (H, W, 3), sRGB"
        )


def _run(network: Any, picture: Floats, outputs: Sequence[str]) -> list[Floats]:
    """Outputs of a network for one picture (3, H, W)."""
    network.setInput(picture[None])
    return [np.asarray(array) for array in network.forward(outputs)]
