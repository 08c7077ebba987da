"""The 26 joints of OpenXR's hand tracking (XR_EXT_hand_tracking), as JSON.

A joint of OpenXR is the near end of the bone that it is named after; its -z axis points along that bone to
the fingertip, its +y axis out of the back (nail) side, so +x points to the right of a hand that lies on its
palm. Our bones have x along, z out of the back: OpenXR's x, y and z are our -y, z and -x. Tips have the axes
of their last bone. The near ends of the four finger metacarpals, which do not move in our hand, are put at 38
percent of the way from the wrist to the knuckle (the carpus of Buryanov and Kotiuk); the palm joint is the
middle of the middle metacarpal.

The world has y up, as OpenXR's reference spaces have. Quaternions are xyzw, as in XrQuaternionf. A hand
without a pose in a frame is null there, as `isActive` would be false.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.files.atomic import atomic_write
from handsim.hand.model import HandModel
from handsim.hand.topology import DIGITS, PALM, bones_of
from handsim.motion_files.motion import Motion, PosedHand, file_axes, posed_hands, smooth_quaternions
from handsim.space.transforms import UpAxis

JOINTS: Final[tuple[str, ...]] = (
    "PALM",
    "WRIST",
    *(f"THUMB_{part}" for part in ("METACARPAL", "PROXIMAL", "DISTAL", "TIP")),
    *(
        f"{digit.upper()}_{part}"
        for digit in DIGITS[1:]
        for part in ("METACARPAL", "PROXIMAL", "INTERMEDIATE", "DISTAL", "TIP")
    ),
)
"""The names of XrHandJointEXT, without XR_HAND_JOINT_ and _EXT, in its order."""
SUFFIX: Final = ".openxr.json"
_CARPUS: Final = 0.38
_MIDDLE: Final = 2  # of the digits
_AXES: Final = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""OpenXR's axes as columns in a frame with x along the bone and z out of the back."""


def write_openxr(path: Path, motion: Motion, up: UpAxis = "z") -> None:
    """Write the joints of all hands as JSON, by custom to a name that ends in `.openxr.json`."""
    tracks = tuple(posed_hands(motion))
    header = {
        "format": "XR_EXT_hand_tracking joints by handsim",
        "schema": 1,
        "units": {"position": "m", "orientation": "xyzw", "radius": "m", "time": "s"},
        "axes": "x right, y up, -z forward",
        "pose": ["x", "y", "z", "qx", "qy", "qz", "qw"],
        "rate": motion.rate,
        "joints": JOINTS,
        "radius": {hand.side: np.round(joint_radii(hand.model), 7).tolist() for hand in tracks},
    }
    poses = [_pose_rows(hand, file_axes(up)) for hand in tracks]
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        file.write(json.dumps(header, indent=1)[:-2] + ',\n "frames": [')
        for frame, time in enumerate(motion.times.tolist()):
            hands = {
                hand.side: rows[frame].tolist() if hand.present[frame] else None
                for hand, rows in zip(tracks, poses, strict=True)
            }
            file.write((",\n" if frame else "\n") + json.dumps({"time": time, "hands": hands}))
        file.write("\n ]\n}\n")


def joint_poses(model: HandModel, qpos: Float[np.ndarray, "T 27"]) -> Float[np.ndarray, "T 26 4 4"]:
    """`T_world_joint` of OpenXR's joints, in our world [m].

    Raises:
        ArgumentError: `qpos` is not (T, 27) or not finite.
    """
    bones = model.forward_kinematics(qpos)
    poses = np.empty((len(bones), len(JOINTS), 4, 4))
    number = 2
    in_palm = _palm_joints(model)
    poses[:, :2] = bones[:, PALM, None] @ in_palm[:2]
    for digit, name in enumerate(DIGITS):
        first, second, third = bones_of(name)
        if digit:
            poses[:, number] = bones[:, PALM] @ in_palm[1 + digit]
            number += 1
        tip = np.eye(4)
        tip[0, 3] = model.skeleton.lengths[third]
        ends = (bones[:, first], bones[:, second], bones[:, third], bones[:, third] @ tip)
        for offset, end in enumerate(ends):
            poses[:, number + offset] = end
            poses[:, number + offset, :3, :3] = end[:, :3, :3] @ _AXES
        number += 4
    return poses


def joint_radii(model: HandModel) -> Float[np.ndarray, "26"]:
    """Distance from each joint to the skin [m]: of the digits their girths', elsewhere half the palm."""
    shape, palm = model.shape, 0.5 * model.shape.palm_thickness
    fingers = [radius for row in shape.radii[1:].tolist() for radius in (palm, *row)]
    return np.array([palm, palm, *shape.radii[0].tolist(), *fingers])


def _palm_joints(model: HandModel) -> Float[np.ndarray, "6 4 4"]:
    """`T_wrist_joint` of palm, wrist and the four finger metacarpals."""
    knuckles = np.array([model.skeleton.offsets[bones_of(digit)[0]] for digit in DIGITS[1:]])
    bases = _CARPUS * knuckles
    middle = _MIDDLE - 1
    starts = [0.5 * (bases[middle] + knuckles[middle]), np.zeros(3), *bases]
    ways = [knuckles[middle] - bases[middle], bases[middle], *(knuckles - bases)]
    joints = np.tile(np.eye(4), (len(starts), 1, 1))
    for joint, start, way in zip(joints, starts, ways, strict=True):
        along = way / np.linalg.norm(way)
        back = np.array([0.0, 0.0, 1.0]) - along[2] * along
        back /= np.linalg.norm(back)
        joint[:3, :3] = np.stack([along, np.cross(back, along), back], axis=1) @ _AXES
        joint[:3, 3] = start
    return joints


def _pose_rows(hand: PosedHand, turn: NDArray[np.float64]) -> Float[np.ndarray, "T 26 7"]:
    """Positions and quaternions (xyzw) in the file's axes."""
    poses = joint_poses(hand.model, hand.qpos)
    quaternions = smooth_quaternions(turn @ poses[..., :3, :3])
    rows = np.concatenate([poses[..., :3, 3] @ turn.T, np.roll(quaternions, -1, axis=-1)], axis=-1)
    return np.round(rows, 8)
