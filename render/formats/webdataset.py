"""Writes clips in webdataset tars, as UmeTrack and HOT3D have them, and records a frame's ground truth.

docs/formats.md defines the records. A clip holds our hand as a hand model of UmeTrack, which describes left
hands and mirrors them in its x axis for right ones; ours are mirrored in y. UmeTrack's wrist frame is
therefore ours rotated by 90 degrees about z. Its model has four joint angles per digit, and equal angles for
mirrored poses, as ours has, so that its angles are our angles.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from handsim.errors import HandSimError
from handsim.hand.model import KEYPOINT_BONES, HandModel, hand_keypoints, join_qpos
from handsim.hand.shape import JOINTS, NUM_JOINTS, HandShape
from handsim.hand.skin import all_weights
from handsim.space.camera import Camera
from handsim.space.transforms import frame_with_z, quaternion_matrix, rigid
from render.formats.records import (
    CENTER,
    METERS_PER_UNIT,
    UMETRACK_JOINTS,
    body_records,
    by_side,
    encode_pictures,
    is_seen,
    rigid_record,
    rounded,
    to_json,
)
from render.formats.shards import new_tar, one_sentence, shard_name, shards_in
from render.frames import Doubles, HandTruth, RenderedFrame

HAND_SHAPES: Final = "__hand_shapes.json__"
"""File of a clip with the hand model; webdataset skips names of this form."""
_PROJECTION_MODELS: Final = {"pinhole": "PinholePlane", "brown": "OpenCV", "fisheye": "OculusVisionFishEye"}
# Rotation from our wrist frame to UmeTrack's.
_UMETRACK_FROM_OURS: Final = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_JOINTS_PER_DIGIT: Final = 4
_ROOT_FRAMES: Final = 1  # number of frames before those of our bones: a root that moves with the wrist
_STREAM_NAME: Final = re.compile(r"[A-Za-z0-9_-]+")
TAR: Final = ".tar"
_FILLED_SHARE: Final = 0.8  # distance of the outermost keypoint from a crop's middle [half widths]
_WIDEST_CROP: Final = np.deg2rad(120.0)  # largest angle of view of a crop
_CROP_ROUNDS: Final = 5  # rotations of a crop's camera to the keypoints' middle, which moves each time
_NEAREST_KEYPOINT: Final = 1e-3  # least depth of a keypoint in a crop [m]


def camera_record(camera: Camera, T_world_device: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    """Record of one stream in `cameras.json`: calibration, pose, and our own record of the camera."""
    K, lens = camera.K, camera.lens
    coefficients = list(lens.coefficients)
    if lens.kind == "brown":
        k1, k2, p1, p2, k3 = coefficients
        coefficients = [k1, k2, k3, p1, p2]
    elif lens.kind == "fisheye":
        coefficients += [0.0] * 4  # four tangential coefficients
    focal_center = [K[0, 0], K[1, 1], K[0, 2] - CENTER, K[1, 2] - CENTER]
    return {
        "calibration": {
            "label": f"rgb-{camera.name}",  # readers distinguish color from gray by these letters
            "stream_id": camera.name,
            "serial_number": camera.name,
            "image_width": camera.size[0],
            "image_height": camera.size[1],
            "projection_model_type": _PROJECTION_MODELS[lens.kind],
            "projection_params": [*focal_center, *coefficients],
            "T_device_from_camera": rigid_record(np.linalg.inv(T_world_device) @ camera.T_world_camera),
        },
        "T_world_from_camera": rigid_record(camera.T_world_camera),
        "depth_metres_per_unit": METERS_PER_UNIT,
        "camera": camera.record(),
    }


def hands_record(frames: Sequence[RenderedFrame]) -> dict[str, Any]:
    """`hands.json` of the frames of one time: `left` and `right`, null for a hand that is absent."""
    streams = [(frame.camera.name, by_side(frame)) for frame in frames]
    record: dict[str, Any] = {"left": None, "right": None}
    for side, hand in streams[0][1].items():
        wrist = umetrack_wrist(rigid(quaternion_matrix(hand.qpos[3:7]), hand.qpos[:3]))
        record[side] = {
            "umetrack_pose": {
                "joint_angles": hand.qpos[7:].tolist(),
                "wrist_xform": wrist.tolist(),
                "T_world_from_wrist": rigid_record(wrist),
            },
            "landmarks": rounded(hand.keypoints_world[UMETRACK_JOINTS], 9),
            **_pose_record(hand),
            "pixels": {name: rounded(hands[side].keypoints - CENTER, 5) for name, hands in streams},
            "visible": {name: hands[side].visible for name, hands in streams},
            "boxes": {name: rounded(hands[side].box, 3) for name, hands in streams},
        }
    return record


def objects_record(frame: RenderedFrame) -> dict[str, Any]:
    """`objects.json`: poses of the rigid bodies by name."""
    record: dict[str, Any] = {}
    for body in frame.bodies:
        entry = {"object_name": body.name, "T_world_from_object": rigid_record(body.T_world_body)}
        record.setdefault(body.name, []).append(entry)
    return record


def markers_record(frame: RenderedFrame) -> dict[str, Any]:
    """`markers.json`: points of the optical system [m], their labels, and the markers' true positions [m]."""
    return {
        "points": rounded(frame.points, 9),
        "labels": frame.labels,
        "label_names": frame.label_names,
        "hands": [
            {"side": hand.shape.side, "marker_names": hand.marker_names, "markers": rounded(hand.markers, 9)}
            for hand in frame.hands
        ],
    }


def frame_record(frame: RenderedFrame) -> dict[str, Any]:
    """The ground truth of a frame without vertices, in meters, world axes, and pixels from the corner."""
    return {
        "number": frame.number,
        "time": frame.time,
        "camera": frame.camera.record(),
        "depth_metres_per_unit": METERS_PER_UNIT,
        "hands": [
            {
                "side": hand.shape.side,
                **_pose_record(hand),
                "pixels": rounded(hand.keypoints, 5),
                "visible": hand.visible,
                "box": rounded(hand.box, 3),
            }
            for hand in frame.hands
        ],
        "bodies": body_records(frame),
        "markers": markers_record(frame),
        "choices": frame.choices,
    }


def _pose_record(hand: HandTruth) -> dict[str, Any]:
    return {
        "keypoints": rounded(hand.keypoints_world, 9),
        "qpos": hand.qpos.tolist(),
        "shape": dataclasses.asdict(hand.shape),
    }


def umetrack_wrist(T_world_wrist: Doubles) -> Doubles:
    """UmeTrack's `T_world_from_wrist` (4, 4) of our wrist pose."""
    pose = T_world_wrist.copy()
    pose[:3, :3] = pose[:3, :3] @ _UMETRACK_FROM_OURS.T
    return pose


def umetrack_hand(shape: HandShape) -> dict[str, Any]:
    """UmeTrack's hand model of a person, the same for both sides, in millimeters."""
    model = HandModel(shape.with_side("left"))
    bones = [joint.bone for joint in JOINTS]
    rest = model.rest_transforms[bones]
    axes = np.einsum("jab,jb->ja", rest[:, :3, :3], model.skeleton.axes)
    numbers, surface = np.arange(NUM_JOINTS), model.surface
    step, next_digit = numbers % _JOINTS_PER_DIGIT, numbers + _JOINTS_PER_DIGIT
    weights = np.pad(all_weights(surface.bone_indices, surface.bone_weights), ((0, 0), (_ROOT_FRAMES, 0)))
    landmarks = hand_keypoints(model, join_qpos(np.zeros((1, NUM_JOINTS))))[0, UMETRACK_JOINTS]
    return {
        "joint_rotation_axes": rounded(axes @ _UMETRACK_FROM_OURS.T, 8),
        "joint_rest_positions": rounded(1e3 * rest[:, :3, 3] @ _UMETRACK_FROM_OURS.T, 5),
        "joint_frame_index": [_ROOT_FRAMES + bone for bone in bones],
        "joint_parent": np.where(step == 0, -1, numbers - 1).tolist(),
        "joint_first_child": np.where(step == _JOINTS_PER_DIGIT - 1, -1, numbers + 1).tolist(),
        "joint_next_sibling": np.where((step == 0) & (next_digit < NUM_JOINTS), next_digit, -1).tolist(),
        "landmark_rest_positions": rounded(1e3 * landmarks @ _UMETRACK_FROM_OURS.T, 5),
        "landmark_rest_bone_weights": [[1.0]] * len(landmarks),
        "landmark_rest_bone_indices": [[_ROOT_FRAMES + KEYPOINT_BONES[n]] for n in UMETRACK_JOINTS],
        "mesh_vertices": rounded(1e3 * surface.vertices @ _UMETRACK_FROM_OURS.T, 4),
        "mesh_triangles": surface.faces.tolist(),
        "dense_bone_weights": rounded(weights, 6),
        "joint_limits": rounded(model.skeleton.ranges, 6),
    }


class WebdatasetWriter:
    """Writes `shard-00000.tar`: clips as UmeTrack and HOT3D have them, with a stream for each camera."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def done(self) -> frozenset[int]:
        """Shards that are complete."""
        return shards_in(self.folder, suffix=TAR)

    def files(self, shard: int) -> dict[str, Path]:
        """The tar of a shard by its name."""
        name = f"{shard_name(shard)}{TAR}"
        return {name: self.folder / name}

    def write(self, shard: int, frames: Iterable[RenderedFrame]) -> None:
        """Write a shard, or write it anew; frames of one number follow one another."""
        shapes, numbers = dict[str, HandShape](), set[int]()
        (path,) = self.files(shard).values()
        with one_sentence(self.folder, f"writing shard {shard}"), new_tar(path) as add:
            for number, group in itertools.groupby(frames, key=lambda frame: frame.number):
                if number in numbers:
                    raise HandSimError(f"the pictures of frame {number} do not follow one another")
                numbers.add(number)
                views = list(group)
                for name, content in _sample(views):
                    add(f"{number:06d}.{name}", content)
                for hand in views[0].hands:
                    shape = dataclasses.asdict(hand.shape) | {"side": None}
                    shapes.setdefault(to_json(shape), hand.shape)
            if len(shapes) == 1:  # a clip has room for one person
                record = {"mano": [], "umetrack": umetrack_hand(*shapes.values())}
                add(HAND_SHAPES, to_json(record).encode())

    def finish(self) -> list[Path]:
        """Do nothing, because tars are complete in themselves."""
        return []


def _sample(views: list[RenderedFrame]) -> Iterator[tuple[str, bytes]]:
    """Yield the files of one time: the ends of their names, and their bytes."""
    names = [view.camera.name for view in views]
    for name in names:
        if not _STREAM_NAME.fullmatch(name):
            raise HandSimError(f"camera '{name}': a stream's name has letters, digits, - and _ only")
    if len(set(names)) < len(names):
        raise HandSimError(f"frame {views[0].number} has two pictures of one camera: {', '.join(names)}")
    for view in views:
        for suffix, content in encode_pictures(view, lossless=False).items():
            kind, _, ending = suffix.rpartition(".")
            yield f"{kind.strip('.') or 'image'}_{view.camera.name}.{ending}", content
    first = views[0]
    device = first.camera.T_world_camera  # poses are relative to a device, which is the first camera here
    records = {
        "cameras": {view.camera.name: camera_record(view.camera, device) for view in views},
        "hands": hands_record(views),
        "hand_crops": crops_record(views),
        "objects": objects_record(first),
        "markers": markers_record(first),
        "choices": {view.camera.name: view.choices for view in views},
        "info": {"number": first.number, "time": first.time},
    }
    for name, record in records.items():
        yield f"{name}.json", to_json(record).encode()


def crops_record(frames: Sequence[RenderedFrame]) -> dict[str, Any]:
    """`hand_crops.json` of one time: by side and stream the pose and angle of view of the crop's camera."""
    record: dict[str, Any] = {"left": {}, "right": {}}
    for frame in frames:
        for side, hand in by_side(frame).items():
            crop = crop_camera(frame.camera, hand.keypoints_world) if is_seen(hand) else None
            if crop is not None:
                T_world_crop, angle = crop
                record[side][frame.camera.name] = {
                    "T_world_from_crop_camera": rigid_record(T_world_crop),
                    "crop_camera_fov": angle,
                }
    return record


def crop_camera(camera: Camera, keypoints: Doubles) -> tuple[Doubles, float] | None:
    """The pose of a camera for one hand's keypoints (21, 3) [m], and its full angle of view [rad].

    It is None for a hand beside or behind the camera, and for one that no flat picture of 120 degrees holds.
    """
    local = camera.local(keypoints)
    target = local.mean(axis=0)
    if target[2] < _NEAREST_KEYPOINT:
        return None
    for _ in range(_CROP_ROUNDS + 1):
        rotation = frame_with_z(target, down=np.array([0.0, 1.0, 0.0]))
        rotated = local @ rotation
        if rotated[:, 2].min() < _NEAREST_KEYPOINT:
            return None
        flat = rotated[:, :2] / rotated[:, 2:]
        target = rotation @ np.append((flat.min(axis=0) + flat.max(axis=0)) / 2.0, 1.0)
    angle = 2.0 * float(np.arctan(float(np.abs(flat).max()) / _FILLED_SHARE))
    if angle > _WIDEST_CROP:
        return None
    T_world_crop: Doubles = camera.T_world_camera.copy()
    T_world_crop[:3, :3] = T_world_crop[:3, :3] @ rotation
    return T_world_crop, angle
