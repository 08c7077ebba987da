"""What the hand detector learns from: drawn hands and your own photographs, as JPEG files with keypoints."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handsim.hand.model import HandModel
from handsim.hand.shape import NUM_KEYPOINTS, NUM_QPOS, SIDES
from poses import sample_poses
from render.config import RenderConfig
from render.film.detector import cut, square_around
from render.frames import Bytes, Doubles
from render.stream import PictureStream, load_labeled_hands, read_photograph

VIEW_SIZE: Final = 320  # longer side of a stored picture [px]
WIDE: Final = 192  # of a stored square around a hand [px]: it can be turned and shifted
WIDE_ROOM: Final = 2.4  # side of that square over the hand's longer side
SCENES: Final = 128  # drawn together
_GLOVES: Final = ("dense19", "starter15", "sparse13", "starter30", "tips8", "dfki13", "starter10")
_CAMERAS: Final = ("vga", "vga_wide", "vga", "sr300", "kinect2", "d435")
_SITTING: Final = 16  # pictures of a person
_FEWEST_SEEN: Final = 4  # keypoints of a hand that must be seen
_EMPTY: Final = 0.35  # share of the scenes of which a square without a hand is kept
_QUALITY: Final = 88  # of JPEG files


class Scene(NamedTuple):
    """A picture of hands."""

    picture: Bytes  # (H, W, 3) sRGB
    keypoints: Doubles  # (N, 21, 2) [px]; NaN for those without a label
    sides: NDArray[np.int8]  # (N,) 0 left, 1 right, -1 unknown


class Lesson(NamedTuple):
    """A scene as it is kept."""

    file: Bytes  # JPEG
    keypoints: Doubles  # as in `Scene`
    sides: NDArray[np.int8]

    @classmethod
    def of(cls, scene: Scene) -> Lesson:
        """A scene, compressed."""
        bgr = cv2.cvtColor(scene.picture, cv2.COLOR_RGB2BGR)
        file = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
        return cls(np.asarray(file, dtype=np.uint8), scene.keypoints, scene.sides)

    def picture(self) -> Bytes:
        """The picture (H, W, 3), sRGB."""
        bgr = cv2.imdecode(self.file, cv2.IMREAD_COLOR)
        return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def lessons_of(scenes: Iterable[Scene], *, rng: np.random.Generator) -> tuple[list[Lesson], list[Lesson]]:
    """Whole pictures for the finder, and squares with and without a hand for the keypoint network."""
    views, squares = [], []
    for scene in scenes:
        height, width = scene.picture.shape[:2]
        scale = VIEW_SIZE / max(height, width)
        small = cut(scene.picture, scale * np.eye(2, 3), (round(scale * width), round(scale * height)))
        views.append(Lesson.of(Scene(small, scale * scene.keypoints, scene.sides)))
        for number, points in enumerate(scene.keypoints):
            squares.append(_square(scene, points[np.isfinite(points[:, 0])], [number]))
        empty = _empty_place(scene, rng)
        if empty is not None and rng.random() < _EMPTY:
            squares.append(_square(scene, empty, []))
    return views, squares


def _square(scene: Scene, points: Doubles, hands: list[int]) -> Lesson:
    """The square around points, with these hands."""
    matrix = square_around(points, WIDE_ROOM, WIDE)
    keypoints = scene.keypoints[hands] @ matrix[:, :2].T + matrix[:, 2]
    return Lesson.of(Scene(cut(scene.picture, matrix, (WIDE, WIDE)), keypoints, scene.sides[hands]))


def _empty_place(scene: Scene, rng: np.random.Generator) -> Doubles | None:
    """Corners (2, 2) of a square [px] whose middle is not in a hand; None where there is no room."""
    limit = np.array(scene.picture.shape[1::-1])
    for _ in range(10):
        center, side = rng.uniform(0.0, limit), limit.min() * rng.uniform(0.1, 0.6)
        low, high = np.nanmin(scene.keypoints, axis=1), np.nanmax(scene.keypoints, axis=1)
        room = np.maximum(0.25 * side, 0.25 * (high - low).max(axis=1, keepdims=True))
        if not ((center > low - room) & (center < high + room)).all(axis=1).any():
            return np.array([center - 0.5 * side, center + 0.5 * side])
    return None


def draw_scenes(number: int, *, seed: int) -> Iterator[Scene]:
    """Some drawn pictures of one or two hands, in gloves or bare, seen by one kind of camera."""
    rng = np.random.default_rng([seed, number])
    config = RenderConfig(passes=("rgb", "ids"), dress="glove" if number % 2 else "skin")
    stream = PictureStream(
        poses=_two_hands(SCENES, rng) if number % 3 == 2 else None,
        config=config,
        camera=_CAMERAS[rng.integers(len(_CAMERAS))],
        fill=(0.45, 1.0) if number % 3 == 2 else (0.12, 0.85),
        people=SCENES // _SITTING,
        sitting=_SITTING,
        glove=_GLOVES[rng.integers(len(_GLOVES))],
        seed=int(rng.integers(2**31)),
    )
    for one in itertools.islice(stream, SCENES):
        keypoints, visible = one["keypoints"].numpy(), one["visible"].numpy()
        keypoints = keypoints.astype(np.float64).reshape(-1, NUM_KEYPOINTS, 2)
        seen = visible.reshape(-1, NUM_KEYPOINTS).sum(axis=1) >= _FEWEST_SEEN
        picture = np.ascontiguousarray(one.get("noisy_rgb", one["rgb"]).numpy().transpose(1, 2, 0))
        yield Scene(picture, keypoints[seen], one["side"].numpy().astype(np.int8).reshape(-1)[seen])


def _two_hands(count: int, rng: np.random.Generator) -> Doubles:
    """Poses (T, 2, 27) of right and left hands that are turned anyhow, near one another."""
    poses = np.empty((count, 2, NUM_QPOS))
    for number, side in enumerate(SIDES[::-1]):
        poses[:, number] = sample_poses(HandModel.named("M", side=side), count, rng=rng)
        poses[:, number, 3:7] = Rotation.random(count, rng=rng).as_quat()[:, [3, 0, 1, 2]]
    away = rng.normal(size=(count, 3))
    away *= rng.uniform(0.14, 0.45, (count, 1)) / np.linalg.norm(away, axis=1, keepdims=True)
    poses[:, 0, :3], poses[:, 1, :3] = 0.0, away
    return poses


def read_scenes(file: Path) -> Iterator[Scene]:
    """Your own photographs with the hands of a file of COCO keypoints."""
    hands = sorted(load_labeled_hands(file), key=lambda hand: hand.file)
    for path, group in itertools.groupby(hands, key=lambda hand: hand.file):
        labeled = list(group)
        sides = np.array([hand.side for hand in labeled], dtype=np.int8)
        yield Scene(read_photograph(path), np.stack([hand.keypoints for hand in labeled]), sides)
