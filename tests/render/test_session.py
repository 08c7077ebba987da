from __future__ import annotations

import dataclasses
import itertools
import json
import re
import tarfile
from typing import get_args

import cv2
import numpy as np
import pytest
import trimesh
from pycocotools.coco import COCO

from gloves import Take, attach, load_layout, load_take
from gloves.fit import settle_glove
from gloves.takes.bodies import RigidBody
from gloves.takes.worn import FormerHands
from handsim import Camera, HandModel, HandSimError, Lens, join_qpos, look_at
from handsim.cli.main import main
from handsim.errors import ArgumentError
from handsim.hand.model import hand_keypoints
from handsim.motion_files.motion import OPENXR_JOINTS, joint_poses
from handsim.space.camera import pinhole, preset
from handsim.space.objects import load_object
from handsim.space.rig import CameraRig
from handsim.space.transforms import quaternion_matrix, rigid, rotated_poses
from poses import sample_poses
from render import Backgrounds, DepthSensor, PictureStream, RenderConfig, ViewConfig, draw, render_take
from render.config import resolve
from render.drawing import Drawing
from render.frames import FOREARM, PARTS_A_HAND, PASSES
from render.scenery.backgrounds import photo_files
from render.session import SHEET, cut_off_pictures, left_out_frames, visible_hands
from render.skin.look import TONES
from render.studio import Moment, Studio
from render.subject import subject_of_take
from render.user_body import UserBody
from render.viewpoints import Framing, Placement, Viewpoints
from tests.programs import run_python
from tests.render.formats.reading import depth_of, exr_content
from train import simulate_take

K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
ABOVE = Camera(
    "above", (320, 240), K, np.array([[1.0, 0, 0, 0.08], [0, -1, 0, 0], [0, 0, -1, 0.5], [0, 0, 0, 1]])
)
BARE = RenderConfig(passes=("depth", "ids"), depth_sensor=None)
MODEL = HandModel.named("S", side="left")
_OF_PASSES = {
    "depth_file", "depth_ideal_file", "ids_file", "normals_file", "depth_sensor", "depth_noise", "seed",
}  # fmt: skip
MAIN = "import sys; from handsim.cli.main import main; sys.exit(main())"
PLAIN = RenderConfig(
    view=ViewConfig(camera="vga", views=2), depth_sensor=None, color_sensor=None, every=12, frames_per_shard=2
)


@pytest.fixture(scope="module")
def qpos():
    return sample_poses(MODEL, 3, rng=np.random.default_rng(4))


def test_own_poses_are_where_their_camera_has_them(qpos):
    frames = list(draw(qpos, model=MODEL, camera=ABOVE, config=BARE, seed=0))
    assert [frame.number for frame in frames] == [0, 1, 2] and frames[0].rgb is None
    for frame in frames:
        hand, world = frame.hands[0], hand_keypoints(MODEL, qpos[frame.number][None])[0]
        np.testing.assert_array_equal(frame.camera.T_world_camera, ABOVE.T_world_camera)
        np.testing.assert_allclose(hand.keypoints, ABOVE.project(world), atol=1e-9)
        assert frame.depth.shape == (240, 320) and hand.shape.side == "left"
        columns, rows = hand.keypoints[hand.visible].astype(int).T
        ahead = ABOVE.local(world[hand.visible])[:, 2] - frame.depth[rows, columns]
        assert np.median(np.abs(ahead)) < 0.02, "joints lie under the skin that is seen there"


def test_a_frame_does_not_depend_on_the_others(qpos):
    config = dataclasses.replace(BARE, passes=("rgb",), background=RenderConfig().background, vary="frame")
    every = list(draw(qpos, model="M", config=config, seed=7))
    alone = next(draw(qpos, model="M", config=config, seed=7, frames=[2]))
    np.testing.assert_array_equal(alone.noisy.rgb, every[2].noisy.rgb)
    other = next(draw(qpos, model="M", config=config, seed=8, frames=[2]))
    assert (other.noisy.rgb != alone.noisy.rgb).any()


def test_frames_are_spread_over_the_poses():
    qpos = np.tile(np.eye(27)[3], (10, 1))
    qpos[0, 3] = np.nan  # no hand is there
    numbers = [frame.number for frame in draw(qpos, model=MODEL, camera=ABOVE, config=BARE, num_frames=3)]
    assert numbers == [1, 4, 7]
    config = dataclasses.replace(BARE, frames=(0, 8, 2, 4), every=2)
    assert [frame.number for frame in draw(qpos, model=MODEL, camera=ABOVE, config=config)] == [2]


def _annotations(folder):
    """All JSON that a rendering's readers look at, without the files and the noise of its pictures."""
    texts = {path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*.json")}
    for path in folder.rglob("*.tar"):
        with tarfile.open(path) as clip:
            names = [name for name in clip.getnames() if name.endswith(".json")]
            texts |= {name: clip.extractfile(name).read().decode() for name in names}
    own = re.compile(r"checksums|render\.|index\.")
    return {name: json.loads(text, object_hook=_kept) for name, text in texts.items() if not own.search(name)}


def _kept(table):
    return {key: value for key, value in table.items() if key not in _OF_PASSES}


def test_annotations_are_the_same_whatever_passes_are_written(tmp_path):
    take = simulate_take(kind="hand-hand", num_frames=25)
    found, formats = [], ("coco", "yolo", "webdataset", "png")
    for number, passes in enumerate((PASSES, ("rgb",), ("rgb", "normals"))):
        out = tmp_path / str(number)
        render_take(take, out, formats, RenderConfig(vary="frame", every=25), passes=passes, workers=1)
        found.append(_annotations(out))
        for format in ("coco", "yolo"):
            coco = COCO(str(out / format / "annotations.json"))
            for hand in coco.loadAnns(coco.getAnnIds()):
                assert 0 < hand["area"] == coco.annToMask(hand).sum() < hand["bbox"][2] * hand["bbox"][3]
    assert len(found[0]) > 5 and found[1] == found[0] == found[2]


def test_a_hand_is_masked_with_its_markers_without_its_forearm():
    config = dataclasses.replace(BARE, dress="glove")
    for frame in draw(simulate_take(kind="hand-hand", num_frames=25), config=config, frames=(0, 24), seed=2):
        for number, hand in enumerate(frame.hands):
            parts, own = frame.ideal.parts[hand.mask], frame.ideal.instances == 1 + number
            markers = own & (frame.ideal.markers > 0)
            assert markers.any() and hand.mask[markers].all() and not hand.mask[~own].any()
            assert (parts > 0).any() and not (parts == 1 + PARTS_A_HAND * number + FOREARM).any()
            bones = own & (frame.ideal.parts > 0) & ~hand.mask
            assert (frame.ideal.parts[bones] == 1 + PARTS_A_HAND * number + FOREARM).all()


def test_a_picture_is_drawn_again_from_its_record(tmp_path):
    """In the middle of a shard, of one of two cameras, with a light and a background of its own."""
    simulate_take(kind="hand-pen", num_frames=12).save(tmp_path / "take.npz")
    config = RenderConfig(view=ViewConfig(views=2), tones="tan", vary="frame", frames_per_shard=2, seed=3)
    out = tmp_path / "pictures"
    assert render_take(tmp_path / "take.npz", out, "png", config, frames=(0, 3, 6, 9), workers=1) == 8
    record = json.loads(next(out.rglob("view1_000009.json")).read_text())
    saved = RenderConfig.from_json(json.loads((out / "render.json").read_text()))
    _, again = draw(tmp_path / "take.npz", config=saved, record=record)
    kept = cv2.imread(str(next((out / "images").rglob("view1_000009.png"))))
    np.testing.assert_array_equal(again.noisy.rgb, kept[..., ::-1])
    with pytest.raises(ArgumentError, match="expected frames or a picture's record"):
        draw(tmp_path / "take.npz", record={"number": 9})


def test_own_cameras_come_back_from_the_settings_of_pictures():
    bent = dataclasses.replace(ABOVE, lens=Lens("brown", (0.08, -0.05, 0.001, -0.0005, 0.0)))
    settings = json.loads(json.dumps({"view": {"cameras": [ABOVE.record(), bent.record()]}}))
    assert RenderConfig.from_json(settings).view.cameras == (ABOVE, bent)


def test_settings_are_given_by_name_and_mixtures_whole(qpos):
    assert RenderConfig(background={"plain": 1.0}).background.shares["room"] == 0.0
    assert RenderConfig(background=("room", "plain")).background == Backgrounds({"room": 1, "plain": 1})
    assert RenderConfig(depth_sensor="realsense_d435").depth_sensor == DepthSensor(("d435",))
    above = {"model": MODEL, "camera": ABOVE, "passes": "depth"}
    sensors = [DepthSensor("d435", noise=noise) for noise in (5.0, 1.0)]
    loud, usual = (next(draw(qpos, depth_sensor=sensor, **above)) for sensor in sensors)
    off = [np.abs(frame.noisy.depth - frame.ideal.depth)[frame.noisy.depth > 0] for frame in (loud, usual)]
    assert np.median(off[0]) > 2.0 * np.median(off[1])
    with pytest.raises(ArgumentError, match="unknown setting of a rendering 'seeds'"):
        draw(qpos, model=MODEL, seeds=3)
    with pytest.raises(ArgumentError, match="unknown depth sensor 'lidar'"):
        RenderConfig(depth_sensor="lidar")


def test_angles_two_hands_several_cameras_and_missing_hands(qpos):
    angles = next(draw(qpos[:, 7:], model=MODEL, camera=ABOVE, config=BARE, frames=[1]))
    np.testing.assert_array_equal(angles.hands[0].qpos, join_qpos(qpos[1:2, 7:])[0])
    both = np.stack([qpos, qpos], axis=1)
    both[:, 1, 1] += 0.2
    both[0, 0] = np.nan
    pair = (MODEL, HandModel.named("S"))
    frames = list(draw(both, model=pair, camera=[ABOVE, ABOVE.at(ABOVE.T_world_camera)], config=BARE))
    assert [len(frame.hands) for frame in frames] == [1, 1, 2, 2, 2, 2]
    assert [hand.shape.side for hand in frames[-1].hands] == ["left", "right"]


def test_takes_are_drawn_from_memory_and_from_files_alike(tmp_path):
    take = simulate_take(kind="hand-pen", num_frames=12)
    take.save(tmp_path / "take.npz")
    config = dataclasses.replace(BARE, view=ViewConfig(camera="sr300"))
    pairs = zip(
        draw(take, config=config, frames=range(0, 12, 6)),
        draw(tmp_path / "take.npz", config=config, frames=(0, 6)),
        strict=True,
    )
    for one, other in pairs:
        np.testing.assert_array_equal(one.depth, other.depth)
        assert one.bodies[0].name == "pen" and one.ids.max() == len(one.hands) + 1


def test_frames_show_the_hands_that_made_them(tmp_path):
    """A recording of two users: a small hand in the first frames, a large one in the last."""
    small, large = (settle_glove(load_layout("dense19"), HandModel.named(size)) for size in "SL")
    qpos = join_qpos(np.full((6, 20), 0.2))
    last = Take.of_poses([large], qpos[:, None], rate=60.0)
    take = dataclasses.replace(last, former=[FormerHands(3, (small,), "S")])
    for one in draw(take, camera=ABOVE, frames=(5, 2, 0, 3), config=BARE):
        model = (small if one.number < 3 else large).model
        expected = hand_keypoints(model, qpos[one.number][None])[0]
        np.testing.assert_allclose(one.hands[0].keypoints_world, expected, atol=1e-9)
        assert one.hands[0].shape == model.shape
    alone = next(
        draw(Take.of_poses([small], qpos[:, None], rate=60.0), camera=ABOVE, frames=(0,), config=BARE)
    )
    one = next(draw(take, camera=ABOVE, frames=(0,), config=BARE))
    np.testing.assert_array_equal(one.hands[0].vertices, alone.hands[0].vertices)
    assert (one.ids != alone.ids).mean() < 0.01, "the arms are those of one person"
    first = Framing(take).points[0, 0]
    np.testing.assert_array_equal(
        first, Framing(Take.of_poses([small], qpos[:, None], rate=60.0)).points[0, 0]
    )
    stream = PictureStream(takes=take, crop=32, people=1, sitting=4, config=BARE)
    shown = {float(one["shape"][0]) for one in itertools.islice(stream, 24)}
    assert shown == {float(np.float32(one.model.shape.length)) for one in (small, large)}


@pytest.mark.parametrize("camera", [None, ABOVE])
def test_a_take_with_y_up_is_drawn_as_the_same_one_with_z_up(camera, tmp_path):
    take = simulate_take(kind="hand-pen", num_frames=12)
    to_y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    lying = dataclasses.replace(
        take,
        qpos=rotated_poses(take.qpos, to_y),
        body_poses=rotated_poses(take.body_poses, to_y),
        point_list=dataclasses.replace(take.point_list, points=take.point_list.points @ to_y.T),
    )
    own = None
    if camera is not None:
        camera = camera.at(
            camera.T_world_camera + np.pad(np.nanmean(take.qpos[..., :3], (0, 1))[:, None], ((0, 1), (3, 0)))
        )
        own = camera.at(rigid(to_y, np.zeros(3)) @ camera.T_world_camera)
    config = dataclasses.replace(BARE, dress="glove")
    pairs = zip(
        draw(take, config=config, camera=camera, frames=(0, 6)),
        draw(lying, config=config, camera=own, frames=(0, 6), up="y"),
        strict=True,
    )
    for one, other in pairs:
        assert (one.ids != other.ids).mean() < 1e-3 and one.ids.any()
        np.testing.assert_allclose(one.hands[0].keypoints_world, other.hands[0].keypoints_world, atol=1e-6)
    config = config if own is None else dataclasses.replace(config, view=ViewConfig(cameras=(own,)))
    render_take(lying, tmp_path / "y", "png", config, frames_per_shard=6, num_frames=1, up="y", workers=1)
    saved = RenderConfig.from_json(json.loads((tmp_path / "y" / "render.json").read_text()))
    frames = (next(draw(lying, config=one, up="y", frames=(0,))) for one in (config, saved))
    np.testing.assert_array_equal(*(frame.ids for frame in frames))
    with pytest.raises(HandSimError, match=r"begun with other settings .*up"):
        render_take(lying, tmp_path / "y", "png", config, frames_per_shard=6, num_frames=1, workers=1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"up": "x"}, "unknown up 'x'"),
        ({"model": 3}, "model is 3, expected a HandModel"),
        ({"model": "XXL"}, "unknown size 'XXL'"),
        ({"model": ("M", "L")}, "the models are of 2 hands .right and right. and the poses of 1"),
        ({"camera": 7}, "camera is 7, expected a Camera"),
        ({"camera": ABOVE, "view": {"share": 0.9}}, "given view and camera, expected one of them"),
        ({"camera": "webcam"}, "unknown camera 'webcam'; .*, or cameras of your own: --cameras FILE"),
        ({"frames": 2.5}, "frames is 2.5, expected numbers of frames"),
        ({"frames": ["a"]}, "a frame is 'a', expected a whole number"),
        ({"seed": "a"}, "seed is 'a', expected a whole number"),
        ({"frames": [3]}, "frame 3 was asked for, expected 0 to 2"),
    ],
)
def test_what_cannot_be_drawn_is_told(qpos, arguments, message):
    with pytest.raises(HandSimError, match=message):
        list(draw(qpos, config=BARE, **arguments))


def test_a_hand_that_never_comes_leaves_the_other_one():
    take = simulate_take(kind="hand-hand", num_frames=12, seed=2)
    qpos, status = take.qpos.copy(), take.status.copy()
    qpos[:, 0], status[:, 0] = np.nan, 0
    (frame,) = draw(dataclasses.replace(take, qpos=qpos, status=status), config=BARE, frames=(5,))
    assert [hand.shape.side for hand in frame.hands] == [take.sides[1]]


def test_a_take_has_its_own_hands():
    with pytest.raises(ArgumentError, match="model belongs to poses of your own"):
        draw(simulate_take(num_frames=2), model="M")


@pytest.mark.parametrize("kind", ["single-hand", "hand-hand"])
def test_no_arm_ends_in_a_picture(kind):
    take = simulate_take(kind=kind, num_frames=120, seed=2)
    studio = Studio(take.hands, resolve(), rng=np.random.default_rng(0))
    pictures = 0
    for placement, user in itertools.product(get_args(Placement), (None, UserBody(take))):
        rng = np.random.default_rng(1)
        viewpoints = Viewpoints(ViewConfig(placement, "vga_wide"), take, rng=rng, user=user)
        for frame in range(0, 120, 20):
            cameras = viewpoints.cameras(frame)
            moment = studio.with_arms(Moment(take, frame), cameras, user)
            ends = np.array([one.triangles.vertices[-1] for one in studio.surfaces(moment)])
            for camera in cameras:
                pixels, ahead = camera.project(ends), camera.local(ends)[:, 2] > 0.0
                inside = ((pixels >= 0.0) & (pixels <= camera.size)).all(axis=1) & ahead
                assert not inside.any(), f"{placement}, frame {frame}, {camera.name}"
                pictures += 1
    assert pictures >= 100


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    file = tmp_path_factory.mktemp("take") / "take.truth.npz"
    simulate_take(kind="hand-controller", num_frames=48).save(file)
    return file


def drawn(path, config):
    return list(draw(path, config=config, frames=[0, 24]))


@pytest.mark.parametrize("dress", ["skin", "glove"])
def test_truth_agrees_with_the_pictures(path, dress):
    own = []
    for frame in drawn(path, dataclasses.replace(PLAIN, dress=dress)):
        pictures = frame.ideal
        assert pictures.rgb.shape == (480, 640, 3) and frame.noisy.rgb is None and frame.noisy.depth is None
        shown = pictures.instances > 0
        assert (pictures.depth > 0.0).all(), "several cameras see the room behind, too"
        assert pictures.depth[shown].max() < pictures.depth[~shown].max()
        np.testing.assert_allclose(np.linalg.norm(pictures.normals, axis=-1), 1.0, atol=1e-5)
        assert set(np.unique(pictures.instances)) <= {0, 1, 2, 3}
        for number, hand in enumerate(frame.hands):
            columns, rows = hand.keypoints[hand.visible].astype(int).T
            shown = pictures.instances[rows, columns]
            own.extend(shown == number + 1)
            ahead = (
                pictures.depth[rows, columns] - frame.camera.local(hand.keypoints_world[hand.visible])[:, 2]
            )
            assert (ahead[(shown > 0) & (shown != number + 1)] > 0.0).all(), "nothing of another in front"
            assert len(hand.markers) == (19 if dress == "glove" else 0)
        if dress == "glove":
            check_markers(frame)
        json.dumps(frame.choices)
    assert np.mean(own) > 0.9, "but for those at the border of the hand"
    assert np.ptp(pictures.rgb.reshape(-1, 3).astype(int), axis=0).min() > 30, "a picture shows something"


def check_markers(frame):
    """What is drawn as a marker lies where the marker is."""
    markers = np.concatenate([hand.markers for hand in frame.hands])
    for number in np.unique(frame.ideal.markers[frame.ideal.markers > 0]):
        rows, columns = np.nonzero(frame.ideal.markers == number)
        middle = frame.camera.project(markers[number - 1])
        assert np.linalg.norm(np.array([columns.mean(), rows.mean()]) + 0.5 - middle) < 8.0


@pytest.mark.parametrize("kind", ["plain", "gradient", "room"])
def test_one_camera_has_one_place_behind_the_hands(path, kind):
    config = dataclasses.replace(PLAIN, view=ViewConfig(), background=kind)
    first, second = drawn(path, config)
    for frame in (first, second):
        shown = frame.ideal.instances > 0
        assert (frame.ideal.depth > 0.0).all() and "enclosure" not in frame.choices
        np.testing.assert_allclose(np.linalg.norm(frame.ideal.normals, axis=-1), 1.0, atol=1e-5)
        if kind != "room":
            rays, normal = frame.camera.rays(), frame.ideal.normals[~shown][0]
            along = (rays / rays[..., 2:] * frame.ideal.depth[..., None]) @ normal
            flat = np.abs(along - np.median(along[~shown])) < 1e-4
            assert flat[~shown].mean() > 0.5 and not flat[shown].any()
            assert (along[~flat] > along[flat].mean()).mean() > 0.999, "it is behind hands and the person"
    bare = (first.ids == 0) & (second.ids == 0)
    np.testing.assert_array_equal(first.depth[bare], second.depth[bare], err_msg="it stays where it is")
    for frame in drawn(path, dataclasses.replace(config, room_depth=False)):
        np.testing.assert_array_equal(frame.ideal.instances > 0, frame.ideal.depth > 0.0)


@pytest.mark.parametrize("views", [1, 2])
def test_exr_files_have_the_light_that_ends_at_white_in_png_files(path, tmp_path, views):
    view = ViewConfig(camera="sr300", views=views)
    config = dataclasses.replace(PLAIN, view=view, every=24, dress="glove", painter="compiled", seed=1)
    render_take(path, tmp_path, ("exr", "png"), config, workers=1)
    highest = 0.0
    for file in sorted((tmp_path / "exr").rglob("*.exr")):
        _, channels = exr_content(file)
        light = np.stack([channels[name] for name in "RGB"], axis=-1).astype(np.float64)
        png = cv2.imread(str(next((tmp_path / "png" / "images").rglob(f"{file.stem}.png"))))[..., ::-1]
        ended = np.minimum(light, 1.0)
        levels = 255.0 * np.where(ended <= 0.0031308, 12.92 * ended, 1.055 * ended ** (1 / 2.4) - 0.055)
        assert np.abs(np.rint(levels) - png).max() <= 1.0
        assert (png[light > 1.01] == 255).all() and len(np.unique(light)) > 5000, "not of 256 levels"
        highest = max(highest, light.max())
    assert highest > 1.2, "markers shine"


def test_annotations_have_openxr_joints_and_the_doubt_of_tracked_poses(tmp_path):
    take = simulate_take(kind="hand-hand", num_frames=2, seed=1)
    spreads = [np.random.default_rng(0).uniform(0.0, 0.1, (2, 2, count)) for count in (20, 21)]
    config = dataclasses.replace(PLAIN, view=ViewConfig(), every=1, openxr=True)
    tracked = dataclasses.replace(
        take, rms=np.full((2, 2), 4e-4), angle_spread=spreads[0], keypoint_spread=spreads[1]
    )
    render_take(tracked, tmp_path / "tracked", "coco", config, workers=1)
    content = json.loads((tmp_path / "tracked" / "annotations.json").read_text())
    images = {image["id"]: image for image in content["images"]}
    assert tuple(content["categories"][0]["openxr_joints"]) == OPENXR_JOINTS
    same = [n for n, name in enumerate(OPENXR_JOINTS) if name != "PALM" and "METACARPAL" not in name[5:]]
    same.insert(1, OPENXR_JOINTS.index("THUMB_METACARPAL"))
    assert len(same) == 21 and len(content["annotations"]) == 4
    for record in content["annotations"]:
        image = images[record["image_id"]]
        number = take.sides.index(record["side"])
        T_world_camera = np.array(image["T_world_camera"])
        world = joint_poses(take.hands[number].model, take.qpos[image["frame"], number][None])[0]
        local, found = np.linalg.inv(T_world_camera) @ world, np.array(record["openxr_poses"])
        np.testing.assert_allclose(found[:, :3], local[:, :3, 3], atol=1e-8)
        turned = quaternion_matrix(np.roll(found[:, 3:], 1, axis=1))
        np.testing.assert_allclose(turned, local[:, :3, :3], atol=1e-6)
        joints, keypoints = (np.reshape(record[name], (-1, 3)) for name in ("openxr_keypoints", "keypoints"))
        np.testing.assert_allclose(joints[same], keypoints, atol=1e-4)
        uvw = found[:, :3] @ np.array(image["K"]).T
        inside = joints[:, 2] > 0
        np.testing.assert_allclose((uvw[:, :2] / uvw[:, 2:])[inside], joints[inside, :2], atol=1e-3)
        doubt = record["tracking"]
        assert doubt["status"] == "tracked" and doubt["rms"] == 4e-4
        for name, spread in zip(("angle_spread", "keypoint_spread"), spreads, strict=True):
            assert doubt[name] == np.round(spread[image["frame"], number], 6).tolist()
    render_take(take, tmp_path / "true", "coco", dataclasses.replace(config, openxr=False), workers=1)
    for record in json.loads((tmp_path / "true" / "annotations.json").read_text())["annotations"]:
        assert not {"tracking", "openxr_poses", "openxr_keypoints"} & set(record)


def test_sensors_and_lenses(path):
    config = RenderConfig(
        view=ViewConfig(camera="headset_fisheye", placement="head"), every=24, passes=("rgb", "depth", "ids")
    )
    for frame in drawn(path, config):
        assert frame.noisy.rgb.shape == frame.ideal.rgb.shape and (frame.noisy.rgb != frame.ideal.rgb).any()
        assert frame.noisy.depth.shape == frame.ideal.depth.shape
        assert frame.ideal.normals is None
        assert all(hand.visible.any() for hand in frame.hands)


def test_the_default_sensor_measures_hands_from_the_users_eyes(path):
    config = RenderConfig(view=ViewConfig(placement="head"), passes=("depth",))
    for frame in drawn(path, config):
        hands = frame.ideal.instances if frame.ideal.instances is not None else frame.ideal.depth > 0.0
        shown = (hands > 0) & (frame.ideal.depth < 0.7)
        assert shown.sum() > 10_000
        assert (frame.noisy.depth[shown] > 0.0).mean() > 0.7


def reaching_cameras(path, folder):
    """A copy of the take whose left hand is at two cameras in frames 24 and 25, and the cameras."""
    take = load_take(path)
    middle = take.hands[1].model.skin(take.qpos[24:25, 1])[0].mean(axis=0)
    head = RenderConfig(view=ViewConfig("head", views=2))
    eyes = Drawing(subject_of_take(take), head).viewpoints.cameras(24)
    take.qpos[24:26, 1, :3] += eyes[0].T_world_camera[:3, 3] - middle
    take.save(folder / "reaching.truth.npz")
    return folder / "reaching.truth.npz", eyes


def test_frames_with_a_camera_in_a_hand_are_left_out_and_told(path, tmp_path, capsys):
    (take, eyes), out = reaching_cameras(path, tmp_path), tmp_path / "out"
    for _ in range(2):  # also by a rendering that has nothing left to do
        assert render_take(take, out, ["coco", "webdataset"], PLAIN, camera=eyes, workers=1) == 6
        assert left_out_frames(out) == [24]
    pictures = sorted(file.stem for file in (out / "coco" / "images").rglob("*.jpg"))
    assert pictures == [f"{eye.name}_{frame:06d}" for eye in eyes for frame in (0, 12, 36)]
    assert (out / SHEET).is_file()
    CameraRig("eyes", tuple(eyes)).save(tmp_path / "eyes.toml")
    words = f"render {take} --out {tmp_path / 'command'} --format png --every 12 --passes depth"
    assert main([*words.split(), "--cameras", str(tmp_path / "eyes.toml"), "--workers", "1"]) == 0
    said = capsys.readouterr().out
    assert f"{tmp_path / 'command'}: 6 images in" in said
    assert "frames left out: 1 (the first: 24), where a camera would be inside a hand or an object" in said
    only = dataclasses.replace(PLAIN, every=24, frames_per_shard=1)
    monkey = tmp_path / "only"
    count = render_take(take, monkey, ["png"], only, camera=eyes, workers=1)
    assert count == 2, "an empty shard is finished, too"
    with pytest.raises(HandSimError, match=r"in frame 24"):
        list(draw(take, config=PLAIN, camera=eyes, frames=[24]))


def test_a_rendering_without_any_frame_is_told(path, tmp_path):
    config, (file, eyes) = dataclasses.replace(PLAIN, every=1), reaching_cameras(path, tmp_path)
    take = load_take(file)
    models = tuple(hand.model for hand in take.hands)
    with pytest.raises(HandSimError, match="no pictures: in all 2 frames a camera would be inside a hand"):
        render_take(
            take.qpos[24:26], tmp_path / "out", ["png"], config, model=models, camera=eyes[0], workers=1
        )


def test_files_have_the_pictures_that_are_drawn_in_memory(path, tmp_path):
    config = dataclasses.replace(PLAIN, view=ViewConfig("orbit"), every=1, frames_per_shard=64, vary="frame")
    short = tmp_path / "short.truth.npz"
    load_take(path).cut(0, 10).save(short)
    render_take(short, tmp_path / "out", ["png"], config, workers=1)
    for frame in draw(short, config=config, frames=[0, 7, 9]):
        (file,) = (tmp_path / "out").glob(f"images/shard-*/{frame.key}.png")
        written = cv2.imread(str(file))
        np.testing.assert_array_equal(written[..., ::-1], frame.rgb)
        (file,) = (tmp_path / "out").glob(f"depth/shard-*/{frame.key}.png")
        held = np.where(frame.depth < 6.55355, frame.depth, 0.0)
        np.testing.assert_allclose(depth_of(file.read_bytes()), held, atol=1e-4)


def test_pictures_that_lack_a_hand_are_told(path, tmp_path):
    take = load_take(path)
    hand = take.qpos[0, 0, :3]
    eye = pinhole("eye", (64, 48), 120.0).at(look_at(hand - [0.0, 0.3, 0.0], hand))
    models = tuple(fit.model for fit in take.hands)
    qpos = take.qpos[[0, 0]].copy()
    qpos[1, 1, 0] += 3.0
    config = dataclasses.replace(PLAIN, view=ViewConfig(), every=1)
    render_take(qpos, tmp_path / "out", ["png"], config, model=models, camera=eye, workers=1)
    assert "eye_000001" in cut_off_pictures(tmp_path / "out")


def test_pictures_that_show_no_hand_are_left_out_and_counted(tmp_path, capsys):
    """In the first of two frames, a box is around the hand."""
    trimesh.creation.box((0.3, 0.2, 0.2)).export(tmp_path / "box.obj")
    poses = np.tile([0.1, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (2, 1, 1))
    poses[1, 0, 2] = -20.0
    fit, bodies = attach(load_layout("dense19"), MODEL), [RigidBody.of(load_object(tmp_path / "box.obj"))]
    qpos = join_qpos(np.zeros((2, 20)))[:, None]
    Take.of_poses([fit], qpos, rate=60.0, bodies=bodies, body_poses=poses).save(tmp_path / "take.npz")
    words = f"render {tmp_path / 'take.npz'} --out {tmp_path / 'out'} --format png --passes depth --workers 1"
    for done in ("1 images in", "complete already, with all of its 1 images"):
        assert main(words.split()) == 0
        said = capsys.readouterr().out
        assert done in said and "images show 1 hand in 1\n" in said
        assert "images left out: 1 (the first: view0_000000), which would show no hand" in said
    assert [file.stem for file in (tmp_path / "out" / "depth").rglob("*.png")] == ["view0_000001"]
    with pytest.raises(HandSimError, match="no pictures: none would show a hand"):
        render_take(tmp_path / "take.npz", tmp_path / "none", "png", BARE, frames=(0,), workers=1)
    eye = Drawing(subject_of_take(load_take(tmp_path / "take.npz")), resolve()).viewpoints.cameras(0)[0]
    own = dataclasses.replace(BARE, view=ViewConfig(cameras=(eye,)))
    assert render_take(tmp_path / "take.npz", tmp_path / "own", "png", own, workers=1) == 2
    assert visible_hands(tmp_path / "own") == [0, 1]


def test_depth_sensors_see_hands_of_all_tones_alike(path):
    seen = []
    for tone in ("very light", "dark"):
        sensor, view = DepthSensor(("azure_kinect",)), ViewConfig(distance=(0.6, 0.8))
        config = dataclasses.replace(PLAIN, tones=TONES[tone], depth_sensor=sensor, view=view)
        frame = drawn(path, config)[0]
        hands = (frame.ideal.instances == 1) | (frame.ideal.instances == 2)
        seen.append((frame.noisy.depth[hands] > 0.0).mean())
    assert min(seen) > 0.7 and abs(seen[0] - seen[1]) < 0.02


def test_a_rendering_goes_on_where_it_stopped_and_comes_out_the_same(path, tmp_path):
    whole, parted = tmp_path / "whole", tmp_path / "parted"
    assert render_take(path, whole, ["coco", "png"], PLAIN, workers=1) == 8
    assert (whole / SHEET).is_file()
    told = []
    render_take(path, parted, ["coco", "png"], PLAIN, workers=1)
    victim = next((parted / "png" / "images").glob("shard-00001"))
    for file in victim.iterdir():
        file.unlink()
    victim.rmdir()
    render_take(path, parted, ["coco", "png"], PLAIN, workers=1, progress=lambda *counts: told.append(counts))
    assert told[0] == (4, 8) and told[-1] == (8, 8) and told == sorted(told)
    sheet = (parted / SHEET).stat().st_mtime_ns
    again = []
    done = render_take(path, parted, ["coco", "png"], PLAIN, workers=1, progress=lambda *n: again.append(n))
    assert done == 8 and again == [(8, 8)] and (parted / SHEET).stat().st_mtime_ns == sheet, (
        "it is complete already"
    )
    names = sorted(file.relative_to(whole) for file in whole.rglob("*") if file.is_file())
    assert names == sorted(file.relative_to(parted) for file in parted.rglob("*") if file.is_file())
    for name in names:
        assert (whole / name).read_bytes() == (parted / name).read_bytes(), name


@pytest.mark.slow
def test_no_driver_is_one_sentence_where_opengl_is_wanted(path, tmp_path):
    command = ("render", str(path), "--every", "48", "--workers", "1")
    driver = {"PYOPENGL_PLATFORM": "egl", "EGL_DEVICE_ID": "4711"}
    for painter, code in (("opengl", 1), ("compiled", 0), ("auto", 0)):
        out = tmp_path / painter
        done = run_python(MAIN, *command, "--out", str(out), "--painter", painter, check=False, **driver)
        assert done.returncode == code, done
        saved = json.loads((out / "render.json").read_text())["painter"]
        assert saved == ("opengl" if code else "compiled")
        said = done.stderr.strip()
        if painter == "opengl":
            assert said.startswith("handsim render: drawing without a screen failed (egl: ")
            assert "apt-get install libegl1" in said and "\n" not in said


def test_a_camera_inside_a_hand_is_refused(path):
    take, pose = load_take(path), np.eye(4)
    pose[:3, 3] = take.hands[0].model.skin(take.qpos[:1, 0])[0, 100] + 0.002
    with pytest.raises(HandSimError, match="mm from a hand or object in frame 0"):
        list(draw(path, config=PLAIN, frames=[0], camera=preset("vga").at(pose)))


def test_another_take_under_the_same_name_is_refused(path, tmp_path):
    file, out = tmp_path / "take.npz", tmp_path / "pics"
    config = RenderConfig(passes=("depth",), depth_sensor=None, every=24)
    take = load_take(path)
    take.save(file)
    assert render_take(file, out, "png", config, workers=1) == render_take(file, out, "png", config) == 2
    qpos = take.qpos.copy()
    qpos[..., 7:] *= 0.5
    dataclasses.replace(take, qpos=qpos).save(file)
    with pytest.raises(HandSimError, match="begun with other settings"):
        render_take(file, out, "png", config, workers=1)


def test_another_photograph_is_another_rendering(path, tmp_path):
    folder, out = tmp_path / "photos", tmp_path / "pics"
    folder.mkdir()
    photograph = np.full((48, 64, 3), 90, dtype=np.uint8)
    cv2.imwrite(str(folder / "one.png"), photograph)
    config = RenderConfig(
        passes=("rgb",), background={"photo": 1.0, "photos": str(folder)}, color_sensor=None, every=48
    )
    assert render_take(path, out, "png", config, workers=1) == 1
    cv2.imwrite(str(folder / "two.png"), photograph)
    photo_files.cache_clear()  # as in another process
    with pytest.raises(HandSimError, match="begun with other settings"):
        render_take(path, out, "png", config, workers=1)
