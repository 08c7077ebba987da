"""A reading of YOLO's pose labels after ultralytics' own checks of them."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from render.formats.writer import open_writer
from render.frames import RenderedFrame


@pytest.fixture
def frames(make_frame) -> list[RenderedFrame]:
    return [make_frame(0, ("right", "left")), make_frame(1, ("left",), away=True), make_frame(2, noisy=True)]


@pytest.fixture
def folder(frames: list[RenderedFrame], tmp_path: Path) -> Path:
    writer = open_writer("yolo", tmp_path)
    writer.write(0, frames[:2])
    writer.write(1, frames[2:])
    writer.finish()
    return tmp_path


def settings(folder: Path) -> dict:
    yaml = pytest.importorskip("yaml")
    return yaml.safe_load((folder / "data.yaml").read_text())


def pictures_and_labels(folder: Path) -> list[tuple[Path, np.ndarray]]:
    """All pictures that ultralytics finds in the folder, and the rows of the texts that it looks for."""
    data, found = settings(folder), []
    for picture in sorted((folder / data["train"]).rglob("*.*")):
        if picture.suffix in (".jpg", ".png"):
            text = Path("/labels/".join(str(picture).rsplit("/images/", 1))).with_suffix(".txt").read_text()
            rows = [line.split() for line in text.splitlines()]
            found.append((picture, np.array(rows, dtype=np.float32).reshape(len(rows), 5 + 3 * 21)))
    return found


def test_the_settings_are_those_of_pose_training(folder: Path) -> None:
    data = settings(folder)
    assert (folder / data["train"]).is_dir() and (folder / data["val"]).is_dir()
    assert data["kpt_shape"] == [21, 3]
    assert data["names"] == {0: "hand"}
    assert data["flip_idx"] == list(range(21))  # a mirrored hand's thumb is a thumb
    assert data["kpt_names"][0][:5] == ["wrist", "thumb_CMC", "thumb_MCP", "thumb_IP", "thumb_tip"]


def test_lines_are_what_the_loader_accepts(folder: Path) -> None:
    found = pictures_and_labels(folder)
    assert [len(rows) for _, rows in found] == [2, 0, 1]  # nobody is in the second
    for _, rows in found:
        if len(rows):
            points = rows[:, 5:].reshape(-1, 21, 3)[..., :2]
            assert points.max() <= 1.0 and rows.min() >= -0.01
            assert rows[:, 0].max() == 0  # of one class
            assert len(np.unique(rows, axis=0)) == len(rows)


def test_boxes_and_keypoints_are_where_the_truth_has_them(folder: Path, frames: list[RenderedFrame]) -> None:
    for (picture, rows), frame in zip(pictures_and_labels(folder), frames, strict=True):
        height, width, _ = cv2.imread(str(picture)).shape
        for row, hand in zip(rows, frame.hands, strict=False):
            center, extent = row[1:3] * (width, height), row[3:5] * (width, height)
            np.testing.assert_allclose([*(center - extent / 2), *extent], hand.box, atol=1e-3)
            x, y, flags = row[5:].reshape(21, 3).T
            pixels, known = np.stack([x * width, y * height], axis=1), flags > 0
            inside = ((hand.keypoints >= 0) & (hand.keypoints < (width, height))).all(axis=1)
            np.testing.assert_array_equal(known, inside)
            np.testing.assert_array_equal(flags == 2, hand.visible)
            np.testing.assert_allclose(pixels[known], hand.keypoints[known], atol=1e-3)


def test_the_records_of_coco_are_beside_the_labels(folder: Path) -> None:
    content = json.loads((folder / "annotations.json").read_text())
    for image, (picture, rows) in zip(content["images"], pictures_and_labels(folder), strict=True):
        hands = [hand for hand in content["annotations"] if hand["image_id"] == image["id"]]
        assert picture == folder / "images" / image["file_name"] and len(hands) == len(rows)
