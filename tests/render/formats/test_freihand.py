"""A loader after FreiHAND's published fields: index -> picture, mask, K, joints."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from handsim import HandSimError, Lens
from handsim.errors import DatasetError
from render.formats.freihand import FreihandWriter
from tests.render.formats.reading import depth_of


def load(folder: Path, name: str) -> list:
    return json.loads((folder / f"training_{name}.json").read_text())


def project(xyz: np.ndarray, K: np.ndarray) -> np.ndarray:
    uv = (K @ xyz.T).T
    return uv[:, :2] / uv[:, -1:]


def test_a_freihand_loader_reads_it(make_frame, tmp_path: Path) -> None:
    frames = [make_frame(0, ("right", "left")), make_frame(1, away=True), make_frame(2, noisy=True)]
    writer = FreihandWriter(tmp_path)
    writer.write(1, frames[2:])
    writer.write(0, frames[:2])
    assert writer.done() == {0, 1}
    writer.finish()
    entries = [(frames[0], 0), (frames[0], 1), (frames[2], 0)]
    lists = {name: load(tmp_path, name) for name in ("K", "xyz", "scale", "mano", "info")}
    assert {len(values) for values in lists.values()} == {3}
    for number, (frame, place) in enumerate(entries):
        hand = frame.hands[place]
        K, xyz = np.array(lists["K"][number]), np.array(lists["xyz"][number])
        np.testing.assert_allclose(project(xyz, K), hand.keypoints - 0.5, atol=1e-4)
        bone = np.linalg.norm(hand.keypoints_world[10] - hand.keypoints_world[9])
        assert lists["scale"][number] == pytest.approx(bone)
        assert lists["info"][number]["side"] == hand.shape.side
        picture = cv2.imread(str(tmp_path / "training" / "rgb" / f"{number:08d}.jpg"))
        assert picture.shape[1::-1] == frame.camera.size
        mask = cv2.imread(str(tmp_path / "training" / "mask" / f"{number:08d}.jpg"), cv2.IMREAD_GRAYSCALE)
        np.testing.assert_array_equal(mask > 127, hand.mask)
        depth = depth_of((tmp_path / "training" / "depth" / f"{number:08d}.png").read_bytes())
        assert depth.shape == mask.shape


def test_numbers_stay_when_shards_come_later(make_frame, tmp_path: Path) -> None:
    def pictures() -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in (tmp_path / "training" / "rgb").iterdir()}

    writer = FreihandWriter(tmp_path)
    writer.write(1, [make_frame(5)])
    writer.finish()
    first, lists = pictures(), load(tmp_path, "xyz")
    writer.finish()  # again changes nothing
    assert (pictures(), load(tmp_path, "xyz")) == (first, lists)
    writer.write(0, [make_frame(1), make_frame(2)])
    assert writer.done() == {0, 1}
    writer.finish()
    assert list(pictures()) and set(pictures()) == {f"{number:08d}.jpg" for number in range(3)}
    assert pictures()["00000000.jpg"] == first["00000000.jpg"]
    assert [entry["frame"] for entry in load(tmp_path, "info")] == [5, 1, 2]
    assert not (tmp_path / "training_verts.json").exists()
    writer.write(1, [make_frame(5)])
    writer.finish()
    assert pictures()["00000000.jpg"] == first["00000000.jpg"], "written anew it has the same numbers"
    with pytest.raises(HandSimError, match="numbered already with 1 entries"):
        writer.write(1, [make_frame(5), make_frame(6)])


def test_an_interrupted_finish_goes_on(make_frame, tmp_path: Path) -> None:
    writer = FreihandWriter(tmp_path)
    writer.write(0, [make_frame(number) for number in range(3)])
    (tmp_path / "parts" / "numbers.json").write_text('{"0": [0, 3]}')
    target = tmp_path / "training" / "rgb"
    target.mkdir(parents=True)
    (tmp_path / "parts" / "shard-00000" / "rgb" / "00000000.jpg").replace(target / "00000000.jpg")
    writer.finish()
    assert sorted(path.name for path in target.iterdir()) == [f"{number:08d}.jpg" for number in range(3)]
    assert len(load(tmp_path, "K")) == 3


def test_a_bent_lens_and_missing_colors_are_told(make_frame, camera, tmp_path: Path) -> None:
    writer = FreihandWriter(tmp_path)
    fisheye = dataclasses.replace(camera, lens=Lens("fisheye", (0.1, 0.0, 0.0, 0.0)))
    with pytest.raises(HandSimError, match="'fisheye', which this format cannot hold"):
        writer.write(0, [make_frame(camera=fisheye)])
    frame = make_frame()
    gray = dataclasses.replace(frame, ideal=dataclasses.replace(frame.ideal, rgb=None))
    with pytest.raises(HandSimError, match="add rgb to the passes"):
        writer.write(0, [gray])
    assert writer.done() == frozenset()
    assert not list((tmp_path / "parts").iterdir())


@pytest.mark.parametrize("content", ["{", "[1]", '{"0": 3}'])
def test_damaged_numbers_are_told(make_frame, tmp_path: Path, content: str) -> None:
    writer = FreihandWriter(tmp_path)
    writer.write(0, [make_frame()])
    (tmp_path / "parts" / "numbers.json").write_text(content)
    with pytest.raises(DatasetError, match=r"numbers\.json: damaged"):
        writer.finish()
