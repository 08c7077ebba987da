"""JSON of webdataset clips as UmeTrack and HOT3D have them, and the ground truth of a frame in ours.

A clip's sample is one time, seen by one or more cameras ("streams"). What their tools read counts pixels from
the first one's center, boxes from the picture's corner. `frame_record`, for formats of our own, counts all
from the corner.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from handsim.hand.shape import HandShape
from handsim.space.camera import Camera
from handsim.space.transforms import quaternion_matrix
from render.formats.annotations.common import (
    CENTER,
    by_side,
    rigid_record,
    rounded,
    shape_record,
)
from render.formats.annotations.joint_orders import to_order
from render.formats.annotations.umetrack_hand import umetrack_hand, umetrack_wrist
from render.formats.png_depth import METERS_PER_UNIT
from render.frames import HandTruth, RenderedFrame

HAND_SHAPES: Final = "__hand_shapes.json__"
"""File of a clip with the hand model; webdataset passes over such names."""
_MODELS: Final = {"pinhole": "PinholePlane", "brown": "OpenCV", "fisheye": "OculusVisionFishEye"}


def camera_record(camera: Camera, T_world_device: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    """One stream of a `cameras.json`: calibration and pose; our own record of the camera beside them.

    Args:
        camera: The stream's camera.
        T_world_device: Pose of what the sample's cameras are fixed to.
    """
    K, lens = camera.K, camera.lens
    coefficients = list(lens.coefficients)
    if lens.kind == "brown":
        k1, k2, p1, p2, k3 = coefficients
        coefficients = [k1, k2, k3, p1, p2]
    elif lens.kind == "fisheye":
        coefficients += [0.0] * 4  # it has four tangential ones too
    focal_center = [K[0, 0], K[1, 1], K[0, 2] - CENTER, K[1, 2] - CENTER]
    return {
        "calibration": {
            "label": f"rgb-{camera.name}",  # readers distinguish color from gray by these letters
            "stream_id": camera.name,
            "serial_number": camera.name,
            "image_width": camera.size[0],
            "image_height": camera.size[1],
            "projection_model_type": _MODELS[lens.kind],
            "projection_params": [*focal_center, *coefficients],
            "T_device_from_camera": rigid_record(np.linalg.inv(T_world_device) @ camera.T_world_camera),
        },
        "T_world_from_camera": rigid_record(camera.T_world_camera),
        "depth_metres_per_unit": METERS_PER_UNIT,
        "camera": camera.record(),
    }


def hands_record(frames: Sequence[RenderedFrame]) -> dict[str, Any]:
    """`hands.json` of one time: `left` and `right`, null for a hand that is not there.

    Args:
        frames: One a stream.

    Raises:
        HandSimError: Two hands are of the same side.
    """
    streams = [(frame.camera.name, by_side(frame)) for frame in frames]
    record: dict[str, Any] = {"left": None, "right": None}
    for side, hand in streams[0][1].items():
        wrist = umetrack_wrist(_wrist(hand))
        record[side] = {
            "umetrack_pose": {
                "joint_angles": hand.qpos[7:].tolist(),
                "wrist_xform": wrist.tolist(),
                "T_world_from_wrist": rigid_record(wrist),
            },
            "landmarks": rounded(to_order(hand.keypoints_world, "umetrack"), 9),
            **_truth(hand),
            "pixels": {name: rounded(hands[side].keypoints - CENTER, 5) for name, hands in streams},
            "visible": {name: hands[side].visible for name, hands in streams},
            "boxes": {name: rounded(hands[side].box, 3) for name, hands in streams},
        }
    return record


def hand_shapes_record(shape: HandShape) -> dict[str, Any]:
    """`__hand_shapes.json__`, shared by both hands of a clip; without MANO parameters."""
    return {"mano": [], "umetrack": umetrack_hand(shape)}


def objects_record(frame: RenderedFrame) -> dict[str, Any]:
    """`objects.json`: poses of the rigid things by name."""
    record: dict[str, Any] = {}
    for body in frame.bodies:
        entry = {"object_name": body.name, "T_world_from_object": rigid_record(body.T_world_body)}
        record.setdefault(body.name, []).append(entry)
    return record


def markers_record(frame: RenderedFrame) -> dict[str, Any]:
    """`markers.json`: what the optical system saw, whose points they are, and where the markers were [m]."""
    return {
        "points": rounded(frame.points, 9),
        "labels": frame.labels,
        "label_names": frame.label_names,
        "hands": [
            {
                "side": hand.shape.side,
                "marker_names": hand.marker_names,
                "markers": rounded(hand.markers, 9),
            }
            for hand in frame.hands
        ],
    }


def frame_record(frame: RenderedFrame) -> dict[str, Any]:
    """The ground truth of a frame without its skin: meters, world axes, pixels from the corner."""
    return {
        "number": frame.number,
        "time": frame.time,
        "camera": frame.camera.record(),
        "depth_metres_per_unit": METERS_PER_UNIT,
        "hands": [
            {
                "side": hand.shape.side,
                **_truth(hand),
                "pixels": rounded(hand.keypoints, 5),
                "visible": hand.visible,
                "box": rounded(hand.box, 3),
            }
            for hand in frame.hands
        ],
        "bodies": [{"name": body.name, "T_world_body": body.T_world_body.tolist()} for body in frame.bodies],
        "markers": markers_record(frame),
        "choices": frame.choices,
    }


def _truth(hand: HandTruth) -> dict[str, Any]:
    return {
        "keypoints": rounded(hand.keypoints_world, 9),
        "qpos": hand.qpos.tolist(),
        "shape": shape_record(hand.shape),
    }


def _wrist(hand: HandTruth) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = quaternion_matrix(hand.qpos[3:7]), hand.qpos[:3]
    return pose
