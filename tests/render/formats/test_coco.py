from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from handsim import HandShape, HandSimError, look_at
from handsim.errors import DatasetError
from handsim.hand.model import KEYPOINT_NAMES
from render import RenderedFrame, SkinLook
from render.formats.coco import skeleton_lines
from render.formats.records import to_order
from render.formats.writer import open_writer


@pytest.fixture
def frames(make_frame) -> list[RenderedFrame]:
    return [make_frame(0, ("right", "left")), make_frame(1, ("left",), away=True), make_frame(2, noisy=True)]


def written(format: str, frames: list[RenderedFrame], folder: Path) -> Path:
    writer = open_writer(format, folder)
    writer.write(0, frames[:2])
    writer.write(1, frames[2:])
    writer.finish()
    return folder


@pytest.fixture
def folder(frames: list[RenderedFrame], tmp_path: Path) -> Path:
    return written("coco", frames, tmp_path)


def test_the_file_holds_what_was_in_the_pictures(folder: Path, frames: list[RenderedFrame]) -> None:
    content = json.loads((folder / "annotations.json").read_text())
    assert [image["id"] for image in content["images"]] == [1, 2, 3]
    assert [hand["image_id"] for hand in content["annotations"]] == [1, 1, 3]  # nobody is in the second
    assert [hand["id"] for hand in content["annotations"]] == [1, 2, 3]
    assert [hand["side"] for hand in content["annotations"]] == ["right", "left", "right"]
    (category,) = content["categories"]
    assert category["keypoints"] == list(KEYPOINT_NAMES) and [1, 2] in category["skeleton"]
    assert "openxr_joints" not in category
    assert list(content) == ["info", "licenses", "images", "annotations", "categories"]
    assert "handsim" in content["info"]["description"] and content["licenses"] == []
    for image, frame in zip(content["images"], frames, strict=True):
        picture = cv2.imread(str(folder / "images" / image["file_name"]))
        assert picture.shape == (image["height"], image["width"], 3)
        wanted = frame.ideal.rgb if frame.noisy.rgb is None else frame.noisy.rgb
        assert np.abs(picture[..., ::-1].astype(int) - wanted).mean() < 25


def test_projections_agree(folder: Path, frames: list[RenderedFrame]) -> None:
    content = json.loads((folder / "annotations.json").read_text())
    images = {image["id"]: image for image in content["images"]}
    hands = [frames[0].hands[0], frames[0].hands[1], frames[2].hands[0]]
    for record, hand in zip(content["annotations"], hands, strict=True):
        u, v, flags = np.reshape(record["keypoints"], (21, 3)).T
        xyz = np.array(record["xyz"])
        uvw = xyz @ np.array(images[record["image_id"]]["K"]).T
        known = flags > 0
        assert known.sum() == record["num_keypoints"] > 10
        np.testing.assert_allclose((uvw[:, :2] / uvw[:, 2:])[known], np.stack([u, v], 1)[known], atol=1e-4)
        np.testing.assert_array_equal(flags == 2, hand.visible)
        np.testing.assert_array_equal(np.stack([u, v], 1)[~known], 0.0)
        np.testing.assert_allclose(np.stack([u, v], 1)[known] + 0.5, hand.keypoints[known], atol=1e-4)


def test_records_name_who_is_in_the_picture(frames: list[RenderedFrame], tmp_path: Path) -> None:
    looks = [{"skin": dataclasses.asdict(SkinLook(lightness=40.0 + number))} for number in range(2)]
    chosen = {"person": 3, "people": looks, "seed": 7}
    writer = open_writer("coco", tmp_path)
    writer.write(0, [dataclasses.replace(frames[0], choices=chosen)])
    writer.finish()
    content = json.loads((tmp_path / "annotations.json").read_text())
    (image,) = content["images"]
    assert image["person"] == 3
    (body,) = image["bodies"]
    assert body["name"] == "pen"
    np.testing.assert_array_equal(body["T_world_body"], frames[0].bodies[0].T_world_body)
    assert image["choices"] == json.loads(json.dumps(chosen))
    for number, (record, hand) in enumerate(zip(content["annotations"], frames[0].hands, strict=True)):
        assert record["look"] == json.loads(json.dumps(looks[number]))
        angle = np.rad2deg(np.arctan2(-10.0 + number, 17.0))
        tone = "brown" if angle > -30.0 else "dark"
        assert record["skin_tone"] == {"class": tone, "typology_angle": round(angle, 3)}
        np.testing.assert_array_equal(record["qpos"], hand.qpos)
        shape = record["shape"].items()
        again = {name: np.array(value) if isinstance(value, list) else value for name, value in shape}
        assert HandShape(**again).side == hand.shape.side


def test_pycocotools_loads_it(folder: Path, frames: list[RenderedFrame]) -> None:
    coco = COCO(str(folder / "annotations.json"))
    assert coco.getCatIds(catNms=["hand"]) == [1]
    hands = coco.loadAnns(coco.getAnnIds(imgIds=[1]))
    for number, hand in enumerate(hands):
        mask = coco.annToMask(hand).astype(bool)
        np.testing.assert_array_equal(mask, frames[0].hands[number].mask)
        assert hand["area"] == mask.sum()
        left, top, width, height = hand["bbox"]
        rows, columns = np.nonzero(mask)
        assert left <= columns.min() < columns.max() < left + width
        assert top <= rows.min() < rows.max() < top + height


def test_pycocotools_scores_it(folder: Path, tmp_path: Path) -> None:
    """The truth as a result has an average precision of one."""
    coco = COCO(str(folder / "annotations.json"))
    results = [
        {name: hand[name] for name in ("image_id", "category_id", "keypoints")} | {"score": 1.0}
        for hand in coco.dataset["annotations"]
    ]
    scores = COCOeval(coco, coco.loadRes(results), "keypoints")
    scores.params.kpt_oks_sigmas = np.full(21, 0.05)
    scores.params.areaRng[0] = [0, 1e10]
    scores.evaluate()
    scores.accumulate()
    assert scores.eval["precision"][:, :, :, 0].max() == 1.0
    assert scores.eval["recall"][:, :, 0].min() == 1.0


@pytest.fixture
def yolo_folder(frames: list[RenderedFrame], tmp_path: Path) -> Path:
    return written("yolo", frames, tmp_path)


def settings(yolo_folder: Path) -> dict:
    yaml = pytest.importorskip("yaml")
    return yaml.safe_load((yolo_folder / "data.yaml").read_text())


def pictures_and_labels(yolo_folder: Path) -> list[tuple[Path, np.ndarray]]:
    """All pictures that ultralytics finds in the folder, and the rows of the texts that it looks for."""
    data, found = settings(yolo_folder), []
    for picture in sorted((yolo_folder / data["train"]).rglob("*.*")):
        if picture.suffix in (".jpg", ".png"):
            text = Path("/labels/".join(str(picture).rsplit("/images/", 1))).with_suffix(".txt").read_text()
            rows = [line.split() for line in text.splitlines()]
            found.append((picture, np.array(rows, dtype=np.float32).reshape(len(rows), 5 + 3 * 21)))
    return found


def test_the_settings_are_those_of_pose_training(yolo_folder: Path) -> None:
    data = settings(yolo_folder)
    assert (yolo_folder / data["train"]).is_dir() and (yolo_folder / data["val"]).is_dir()
    assert data["kpt_shape"] == [21, 3]
    assert data["names"] == {0: "hand"}
    assert data["flip_idx"] == list(range(21))  # a mirrored hand's thumb is a thumb
    assert data["kpt_names"][0][:5] == ["wrist", "thumb_CMC", "thumb_MCP", "thumb_IP", "thumb_tip"]


def test_lines_are_what_the_loader_accepts(yolo_folder: Path) -> None:
    found = pictures_and_labels(yolo_folder)
    assert [len(rows) for _, rows in found] == [2, 0, 1]  # nobody is in the second
    for _, rows in found:
        if len(rows):
            points = rows[:, 5:].reshape(-1, 21, 3)[..., :2]
            assert points.max() <= 1.0 and rows.min() >= -0.01
            assert rows[:, 0].max() == 0  # of one class
            assert len(np.unique(rows, axis=0)) == len(rows)


def test_boxes_and_keypoints_are_where_the_truth_has_them(yolo_folder, frames):
    for (picture, rows), frame in zip(pictures_and_labels(yolo_folder), frames, strict=True):
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


def test_the_records_of_coco_are_beside_the_labels(yolo_folder: Path) -> None:
    content = json.loads((yolo_folder / "annotations.json").read_text())
    for image, (picture, rows) in zip(content["images"], pictures_and_labels(yolo_folder), strict=True):
        hands = [hand for hand in content["annotations"] if hand["image_id"] == image["id"]]
        assert picture == yolo_folder / "images" / image["file_name"] and len(hands) == len(rows)


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


def test_interhand_and_coco_loaders_read_it(moving, tmp_path):
    writer = open_writer("interhand", tmp_path)
    writer.write(0, moving)
    writer.finish()
    coco = COCO(str(tmp_path / "annotations" / "train" / f"{NAME}_data.json"))
    assert len(coco.anns) == len(coco.imgs) == 3
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


def test_the_skeleton_is_a_tree_of_the_same_joints() -> None:
    rows = [line.split(" ") for line in skeleton_lines().splitlines() if not line.startswith("#")]
    assert [int(row[1]) for row in rows] == list(range(42))
    for row in ("r_thumb4 0 1", "r_thumb1 3 20", "r_wrist 20 -1", "l_wrist 41 -1", "l_pinky4 37 38"):
        assert row.split() in rows


def test_what_it_cannot_hold_is_told(make_frame, tmp_path: Path) -> None:
    writer = open_writer("interhand", tmp_path)
    with pytest.raises(HandSimError, match="hands right and right; this format holds at most one"):
        writer.write(0, [make_frame(0, ("right", "right"))])
    first = make_frame(0)
    writer.write(0, [first])
    writer.write(1, [dataclasses.replace(make_frame(1), number=0)])
    with pytest.raises(DatasetError, match="two pictures of frame 0 have different hands"):
        writer.finish()
