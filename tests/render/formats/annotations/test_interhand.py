"""A loader after InterHand2.6M's published fields."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from handsim.errors import DatasetError, HandSimError
from handsim.space.camera import look_at
from render.formats.annotations.interhand import skeleton_lines
from render.formats.annotations.joint_orders import to_order
from render.formats.writer import open_writer

NAME = "InterHand2.6M_train"


def load(folder: Path, name: str) -> dict:
    return json.loads((folder / "annotations" / "train" / f"{NAME}_{name}.json").read_text())


@pytest.fixture
def moving(make_frame, camera) -> list:
    """Two pictures of the first time, from two cameras, and one of the second, when the first has moved."""
    other = dataclasses.replace(camera, name="other").at(look_at(np.array([0.1, -0.5, -0.3]), np.zeros(3)))
    moved = camera.at(look_at(np.array([-0.1, -0.5, 0.4]), np.zeros(3)))
    return [
        make_frame(0, ("right", "left")),
        make_frame(0, ("right", "left"), camera=other),
        make_frame(1, ("left",), camera=moved),
    ]


def test_an_interhand_loader_reads_it(moving, tmp_path: Path) -> None:
    writer = open_writer("interhand", tmp_path)
    writer.write(0, moving)
    writer.finish()
    data, cameras, joints = (load(tmp_path, name) for name in ("data", "camera", "joint_3d"))
    images = {image["id"]: image for image in data["images"]}
    assert [image["camera"] for image in data["images"]] == ["0", "1", "2"]
    assert [image["camera_name"] for image in data["images"]] == ["small", "other", "small"]
    assert [record["hand_type"] for record in data["annotations"]] == ["interacting", "interacting", "left"]
    for record, frame in zip(data["annotations"], moving, strict=True):
        image = images[record["image_id"]]
        camera = {name: np.array(table[image["camera"]]) for name, table in cameras["0"].items()}
        world = np.array(joints["0"][str(image["frame_idx"])]["world_coord"])
        local = (world - camera["campos"]) @ camera["camrot"].T
        uv = local[:, :2] / local[:, 2:] * camera["focal"] + camera["princpt"]
        valid = np.array(record["joint_valid"]).reshape(42) > 0
        sides = [hand.shape.side for hand in frame.hands]
        np.testing.assert_array_equal(valid, np.repeat(["right" in sides, "left" in sides], 21))
        for hand in frame.hands:
            rows = slice(0, 21) if hand.shape.side == "right" else slice(21, 42)
            np.testing.assert_allclose(uv[rows], to_order(hand.keypoints, "interhand") - 0.5, atol=1e-4)
            expected = 1e3 * to_order(hand.keypoints_world, "interhand")
            np.testing.assert_allclose(world[rows], expected, atol=1e-5)
        picture = cv2.imread(str(tmp_path / "images" / "train" / image["file_name"]))
        assert picture.shape[:2] == (image["height"], image["width"])


def test_pycocotools_loads_it(moving, tmp_path: Path) -> None:
    coco_module = pytest.importorskip("pycocotools.coco")
    writer = open_writer("interhand", tmp_path)
    writer.write(0, moving)
    writer.finish()
    coco = coco_module.COCO(str(tmp_path / "annotations" / "train" / f"{NAME}_data.json"))
    assert len(coco.anns) == len(coco.imgs) == 3


def test_the_skeleton_is_a_tree_of_the_same_joints() -> None:
    rows = [line.split(" ") for line in skeleton_lines().splitlines() if not line.startswith("#")]
    assert [int(row[1]) for row in rows] == list(range(42))
    assert rows[0] == ["r_thumb4", "0", "1"]
    assert rows[3] == ["r_thumb1", "3", "20"]
    assert rows[20] == ["r_wrist", "20", "-1"]
    assert rows[41] == ["l_wrist", "41", "-1"]
    assert rows[37] == ["l_pinky4", "37", "38"]


def test_what_it_cannot_hold_is_told(make_frame, tmp_path: Path) -> None:
    writer = open_writer("interhand", tmp_path)
    with pytest.raises(HandSimError, match="hands right and right; this format holds at most one"):
        writer.write(0, [make_frame(0, ("right", "right"))])
    first = make_frame(0)
    writer.write(0, [first])
    writer.write(1, [dataclasses.replace(make_frame(1), number=0)])
    with pytest.raises(DatasetError, match="two pictures of frame 0 have different hands"):
        writer.finish()
