"""Own poses through own cameras: written keypoints are OpenCV's projections, and people are as told."""

from __future__ import annotations

import json
import tarfile

import cv2
import numpy as np
import pytest

from gloves import Take, attach
from handsim import HandModel, HandSimError, HandSimWarning, join_qpos, sample_shape
from handsim.cli.main import main
from handsim.errors import ArgumentError, CaptureError
from handsim.hand.model import hand_keypoints
from handsim.hand.shape import HAND_DTYPE, named_shape, pack_hand
from handsim.space.transforms import quaternion_matrix, random_quaternions
from poses import sample_poses
from render import PoseFile, RenderConfig, ShutterConfig, ViewConfig, render_take
from render.config import resolve
from render.drawing import Drawing
from render.subject import subject_of

K = np.array([[300.0, 0, 161.5], [0, 302.0, 118.25], [0, 0, 1]])
D = np.array([[-0.2, 0.06, 0.001, -0.0015, 0.01]])
R, T = cv2.Rodrigues(np.array([0.02, -0.08, 0.03]))[0], np.array([[-0.06], [0.003], [0.01]])
BASE = join_qpos(np.zeros((2, 20)))


@pytest.fixture
def qpos():
    rng = np.random.default_rng(5)
    poses = sample_poses(HandModel.named("M"), 4, rng=rng)
    poses[:, :3] = rng.uniform([-0.05, -0.05, 0.5], [0.05, 0.05, 0.6], (4, 3))
    poses[:, 3:7] = random_quaternions(4, rng=rng)
    return poses


@pytest.fixture
def cameras(tmp_path):
    file = cv2.FileStorage(str(tmp_path / "stereo.yml"), cv2.FILE_STORAGE_WRITE)
    for name, value in {"M1": K, "D1": D, "M2": K, "D2": D, "R": R, "T": T}.items():
        file.write(name, value)
    file.write("image_width", 320)
    file.write("image_height", 240)
    file.release()
    return tmp_path / "stereo.yml"


def load_poses(file, seed=0):
    return subject_of(file, seed=seed)


def drawn(subject, config, frames, shard=0):
    return Drawing(subject, resolve(config)).frames(shard, enumerate(frames))


def saved(folder, **arrays):
    np.savez(folder / "poses.npz", **arrays)
    return folder / "poses.npz"


def test_written_keypoints_are_opencvs(tmp_path, qpos, cameras):
    """The command's pictures against cv2.projectPoints with the numbers of the camera's file."""
    shape = named_shape("L")
    path = saved(tmp_path, qpos=qpos, hand_size=np.array([shape.length, shape.breadth]))
    out = tmp_path / "out"
    line = f"render --poses {path} --cameras {cameras} --hands right --out {out} --format coco webdataset"
    assert main([*line.split(), "--workers", "1", "--background", "plain", "--passes", "rgb", "ids"]) == 0
    coco = json.loads((out / "coco" / "annotations.json").read_text())
    images = {image["id"]: image for image in coco["images"]}
    assert sorted({image["camera"] for image in images.values()}) == ["left", "right"]
    assert len(images) == 8 and len(coco["annotations"]) == 8
    world = hand_keypoints(HandModel(shape), qpos)
    for hand in coco["annotations"]:
        image = images[hand["image_id"]]
        rotation, shift = (np.eye(3), np.zeros(3)) if image["camera"] == "left" else (R, T)
        expected = cv2.projectPoints(world[image["frame"]], cv2.Rodrigues(rotation)[0], shift, K, D)[0][:, 0]
        keypoints = np.reshape(hand["keypoints"], (21, 3))
        inside = keypoints[:, 2] > 0
        assert inside.sum() > 10
        assert np.abs(keypoints[:, :2] - expected)[inside].max() < 0.01
    with tarfile.open(out / "webdataset" / "shard-00000.tar") as tar:
        stored = json.loads(tar.extractfile("000001.hands.json").read())
    np.testing.assert_allclose(stored["right"]["qpos"], qpos[1], atol=1e-12)
    settings = json.loads((out / "render.json").read_text())
    assert settings["view"]["cameras"][1]["name"] == "right" and settings["poses"]["sides"] == ["right"]


def test_changed_files_are_refused(tmp_path, qpos, cameras):
    path, out = saved(tmp_path, qpos=qpos), tmp_path / "out"
    config = RenderConfig(view=ViewConfig(cameras=str(cameras)), passes=("depth",), depth_sensor=None)
    assert render_take(PoseFile(path), out, ("png",), config, workers=1) == 8
    assert render_take(PoseFile(path), out, ("png",), config, workers=1) == 8
    saved(tmp_path, qpos=qpos[::-1])
    with pytest.raises(HandSimError, match=r"other settings \(poses.sha256"):
        render_take(PoseFile(path), out, ("png",), config, workers=1)
    saved(tmp_path, qpos=qpos)
    cameras.write_text(cameras.read_text().replace("image_width: 320", "image_width: 322"))
    with pytest.raises(HandSimError, match=r"other settings \(view.cameras"):
        render_take(PoseFile(path), out, ("png",), config, workers=1)


def test_angles_with_wrist_transforms_are_the_same(tmp_path, qpos):
    wrists = np.tile(np.eye(4), (4, 1, 1))
    wrists[:, :3, :3], wrists[:, :3, 3] = quaternion_matrix(qpos[:, 3:7]), qpos[:, :3]
    path = saved(tmp_path, angles=qpos[:, 7:], T_world_wrist=wrists)
    read = load_poses(PoseFile(path)).take.qpos[:, 0]
    signs = np.sign((read[:, 3:7] * qpos[:, 3:7]).sum(axis=1, keepdims=True))
    read[:, 3:7] *= signs
    np.testing.assert_allclose(read, qpos, atol=1e-12)


def test_a_table_of_an_exported_take_is_drawn_as_its_poses(tmp_path, qpos):
    both = np.stack([qpos, qpos], axis=1)
    both[:, 1, 0] += 0.2
    both[1, 0] = np.nan
    fits = [attach("dense19", HandModel.named("M", side=side)) for side in ("left", "right")]
    Take.of_poses(fits, both, rate=30.0).export(tmp_path / "poses.csv")
    for source in (PoseFile(tmp_path / "poses.csv"), str(tmp_path / "poses.csv")):
        subject = load_poses(source)
        assert [fit.side for fit in subject.take.hands] == ["left", "right"] and subject.is_motion
        assert subject.take.rate == pytest.approx(30.0)
        np.testing.assert_allclose(subject.take.qpos, both, atol=1e-8)
    right = load_poses(PoseFile(tmp_path / "poses.csv", ("right",)))
    np.testing.assert_allclose(right.take.qpos[:, 0], qpos + np.eye(27)[0] * 0.2, atol=1e-8)


def test_a_table_without_poses_is_told(tmp_path):
    (tmp_path / "table.csv").write_text("frame,time_s,hand,x\n0,0,right,1\n")
    with pytest.raises(HandSimError, match=r"no column 'wrist_x_m'; of a \.csv are read frame, time_s, hand"):
        render_take(str(tmp_path / "table.csv"), tmp_path / "out", "png")


def test_two_hands_one_of_them_absent(tmp_path, qpos):
    both = np.stack([qpos, qpos], axis=1)
    both[1, 0] = np.nan
    both[:, 1, 0] += 0.2
    path = saved(tmp_path, qpos=both)
    take = load_poses(PoseFile(path, ("left", "right")))
    config = RenderConfig(passes=("ids",), depth_sensor=None, background=RenderConfig().background)
    frames = list(drawn(take, config, [0, 1]))
    assert [[hand.shape.side for hand in frame.hands] for frame in frames] == [["left", "right"], ["right"]]


def lengths(take, frames, config, shard=0):
    return [frame.hands[0].shape.length for frame in drawn(take, config, frames, shard)]


def skins(take, frames, config):
    return [frame.choices["people"][0]["skin"] for frame in drawn(take, config, frames)]


def test_people_of_frames(tmp_path, qpos):
    config = RenderConfig(passes=("ids",), depth_sensor=None)
    frames = [0, 1, 2, 3]
    shapes = [sample_shape(rng=np.random.default_rng(seed)) for seed in range(2)]
    hands = np.array([pack_hand(shape) for shape in shapes], dtype=HAND_DTYPE)
    given = load_poses(PoseFile(saved(tmp_path, qpos=qpos, hands=hands, person=[1, 0, 1, 1])))
    assert lengths(given, frames, config) == [shapes[n].length for n in (1, 0, 1, 1)]
    looks = skins(given, frames, config)
    assert looks[0] == looks[2] == looks[3] != looks[1]
    each = np.linspace(0.17, 0.2, 4)
    own = load_poses(PoseFile(saved(tmp_path, qpos=qpos, hand_size=np.c_[each, 0.45 * each])))
    np.testing.assert_allclose(lengths(own, frames, config), each)
    path = saved(tmp_path, qpos=qpos)
    shared = load_poses(PoseFile(path, people=2), seed=1)
    assert len(set(lengths(shared, frames, config))) == 2
    assert lengths(shared, frames, config) == lengths(
        load_poses(PoseFile(path, people=2), seed=1), frames, config
    )
    alone = load_poses(PoseFile(path))
    assert len(set(lengths(alone, frames, config))) == 1
    assert lengths(alone, [0], config) != lengths(alone, [0], config, shard=1)


def test_blur_keeps_to_one_person(tmp_path, qpos):
    qpos[:, 3:7] = qpos[0, 3:7]
    times = np.arange(4) / 60.0
    config = RenderConfig(shutter=ShutterConfig(), passes=("rgb",), depth_sensor=None)
    path = saved(tmp_path, qpos=qpos, times=times, person=[0, 0, 1, 1])
    frame = next(drawn(load_poses(PoseFile(path)), config, [1]))
    assert frame.noisy.rgb is not None and frame.time == times[1]
    with pytest.raises(HandSimError, match="poses without times have no motion to blur"):
        render_take(PoseFile(saved(tmp_path, qpos=qpos)), tmp_path / "out", ("png",), config)


def changed(index, value):
    qpos = BASE.copy()
    qpos[index] = value
    return {"qpos": qpos}


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"qpos": BASE[:, :26]}, r"qpos has shape \(2, 26\), expected \(T, 1, 27\) for a hand"),
        ({"qpos": np.stack([BASE] * 2, axis=1)}, r"has shape \(2, 2, 27\)"),
        ({"qpos": BASE.astype(str)}, "expected an array of numbers"),
        ({"poses": BASE}, "unknown array 'poses' .*valid names: qpos"),
        ({}, "expected qpos, or angles and T_world_wrist"),
        ({"qpos": BASE, "angles": BASE[:, 7:]}, "expected qpos, or angles and T_world_wrist"),
        ({"angles": BASE[:, 7:], "T_world_wrist": np.ones((2, 4, 4))}, "not a rigid transform in frame 0"),
        (changed((1, 3), 0.5), "quaternion .* of length 0.5 in frame 1"),
        (changed((1, 8), 30.0), "30 rad, expected at most 6.283; are these degrees"),
        (changed((0, 0), 600.0), "600 m from the origin .* are these millimeters"),
        (changed((0, 0), np.inf), "infinite"),
        ({"qpos": np.full((2, 27), np.nan)}, "there is no hand in any frame"),
        ({"qpos": BASE, "times": [0.0, 0.0]}, "not finite and increasing"),
        ({"qpos": BASE, "times": [0.0]}, "times has shape"),
        ({"qpos": BASE, "person": [0, -1]}, "person is -1 to 0, expected 0 to"),
        ({"qpos": BASE, "person": [0.5, 1.0]}, "person is float64"),
        ({"qpos": BASE, "hand_size": [[0.19, 0.08]] * 3}, "holds 3 hands and 2 frames"),
        ({"qpos": BASE, "hand_size": [[190.0, 85.0]]}, "hand_size is not within"),
        ({"qpos": BASE, "hand_size": [[0.19, 0.08]], "person": [0, 1]}, "person is 0 to 1, expected 0 to 0"),
        ({"qpos": BASE, "hands": np.zeros(2)}, "hands are not records"),
    ],
)
def test_mistakes_are_told(tmp_path, arrays, message):
    with pytest.raises(CaptureError, match=message):
        load_poses(PoseFile(saved(tmp_path, **arrays)))


def test_pickles_are_not_read(tmp_path):
    with pytest.raises(CaptureError, match=r"not an \.npz of plain arrays"):
        load_poses(PoseFile(saved(tmp_path, qpos=np.array([{}], dtype=object))))
    (tmp_path / "text.npz").write_bytes(b"no archive")
    with pytest.raises(CaptureError, match=r"not an \.npz of plain arrays"):
        load_poses(PoseFile(tmp_path / "text.npz"))


def test_suspicious_angles_are_told(tmp_path):
    with pytest.warns(HandSimWarning, match=r"in 1 of 2 frames \(the first: 1\) a joint is"):
        load_poses(PoseFile(saved(tmp_path, **changed((1, 12), -1.5))))


def test_arguments(tmp_path):
    with pytest.raises(ArgumentError, match="unknown hand 'both'"):
        PoseFile(tmp_path, ("both",))
    with pytest.raises(ArgumentError, match="hands are right right"):
        PoseFile(tmp_path, ("right", "right"))
    path = saved(tmp_path, qpos=BASE, person=[0, 1])
    with pytest.raises(CaptureError, match="leave out --people"):
        load_poses(PoseFile(path, people=3))


def test_poses_that_are_given_as_a_take_are_told(tmp_path, qpos):
    np.savez(tmp_path / "poses.npz", qpos=qpos)
    with pytest.raises(CaptureError, match="no take, but poses of your own; give them to --poses"):
        subject_of(tmp_path / "poses.npz", seed=0)


def test_frames_without_a_hand_are_counted(tmp_path, qpos):
    lost = qpos[:3].copy()
    lost[1] = np.nan
    with pytest.warns(HandSimWarning, match=r"frames without a hand are not drawn: 1 of 3 \(the first: 1\)"):
        assert render_take(lost, tmp_path / "pictures", "png", passes=("ids",), workers=1) == 2


def test_poses_in_the_place_of_the_folder_are_told():
    with pytest.raises(ArgumentError, match=r"the address is an array \(3, 27\), expected a folder"):
        render_take("pictures", np.zeros((3, 27)))
