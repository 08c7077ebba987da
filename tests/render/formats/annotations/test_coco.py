from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from handsim.hand.model import KEYPOINT_NAMES
from handsim.hand.shape import HandShape
from render.formats.annotations.common import hand_mask
from render.formats.writer import open_writer
from render.frames import RenderedFrame
from render.skin.look import SkinLook


@pytest.fixture
def frames(make_frame) -> list[RenderedFrame]:
    return [make_frame(0, ("right", "left")), make_frame(1, ("left",), away=True), make_frame(2, noisy=True)]


@pytest.fixture
def folder(frames: list[RenderedFrame], tmp_path: Path) -> Path:
    writer = open_writer("coco", tmp_path)
    writer.write(0, frames[:2])
    writer.write(1, frames[2:])
    writer.finish()
    return tmp_path


def test_the_file_holds_what_was_in_the_pictures(folder: Path, frames: list[RenderedFrame]) -> None:
    content = json.loads((folder / "annotations.json").read_text())
    assert [image["id"] for image in content["images"]] == [1, 2, 3]
    assert [hand["image_id"] for hand in content["annotations"]] == [1, 1, 3]  # nobody is in the second
    assert [hand["id"] for hand in content["annotations"]] == [1, 2, 3]
    assert [hand["side"] for hand in content["annotations"]] == ["right", "left", "right"]
    assert content["categories"][0]["keypoints"] == list(KEYPOINT_NAMES)
    assert [1, 2] in content["categories"][0]["skeleton"]
    assert list(content) == ["info", "licenses", "categories", "images", "annotations"]
    assert "handsim" in content["info"]["description"]
    assert content["licenses"] == []
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
    assert image["choices"] == json.loads(json.dumps(chosen))
    for number, (record, hand) in enumerate(zip(content["annotations"], frames[0].hands, strict=True)):
        assert record["look"] == json.loads(json.dumps(looks[number]))
        angle = np.rad2deg(np.arctan2(-10.0 + number, 17.0))
        assert record["skin_tone"] == {
            "class": "brown" if angle > -30.0 else "dark",
            "typology_angle": round(angle, 3),
        }
        np.testing.assert_array_equal(record["qpos"], hand.qpos)
        assert (
            HandShape(**_arrays(record["shape"])) is not None and record["shape"]["side"] == hand.shape.side
        )


def _arrays(shape: dict) -> dict:
    return {name: np.array(value) if isinstance(value, list) else value for name, value in shape.items()}


def test_pycocotools_loads_it(folder: Path, frames: list[RenderedFrame]) -> None:
    coco_module = pytest.importorskip("pycocotools.coco")
    coco = coco_module.COCO(str(folder / "annotations.json"))
    assert coco.getCatIds(catNms=["hand"]) == [1]
    hands = coco.loadAnns(coco.getAnnIds(imgIds=[1]))
    for number, hand in enumerate(hands):
        mask = coco.annToMask(hand).astype(bool)
        np.testing.assert_array_equal(mask, hand_mask(frames[0], number))
        assert hand["area"] == mask.sum()
        left, top, width, height = hand["bbox"]
        rows, columns = np.nonzero(mask)
        assert left <= columns.min() < columns.max() < left + width
        assert top <= rows.min() < rows.max() < top + height


def test_pycocotools_scores_it(folder: Path, tmp_path: Path) -> None:
    """The truth as a result has an average precision of one."""
    coco_module = pytest.importorskip("pycocotools.coco")
    evaluation = pytest.importorskip("pycocotools.cocoeval")
    coco = coco_module.COCO(str(folder / "annotations.json"))
    results = [
        {name: hand[name] for name in ("image_id", "category_id", "keypoints")} | {"score": 1.0}
        for hand in coco.dataset["annotations"]
    ]
    scores = evaluation.COCOeval(coco, coco.loadRes(results), "keypoints")
    scores.params.kpt_oks_sigmas = np.full(21, 0.05)
    scores.params.areaRng[0] = [0, 1e10]
    scores.evaluate()
    scores.accumulate()
    assert scores.eval["precision"][:, :, :, 0].max() == 1.0
    assert scores.eval["recall"][:, :, 0].min() == 1.0
