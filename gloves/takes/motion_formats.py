"""The formats of motion that takes are written in for other programs, by the endings of file names."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from gloves.captures.capture import Capture
from gloves.captures.formats import write_capture
from handsim.errors import ArgumentError
from handsim.hand.model import KEYPOINT_NAMES
from handsim.motion_files.motion import (
    Motion,
    write_bvh,
    write_joint_csv,
    write_mot,
)
from handsim.motion_files.scenes import write_glb, write_usd
from handsim.space.transforms import UpAxis, file_axes

HELD_POSE: Final = "held at its last pose"


class MotionFormat(NamedTuple):
    """A format of motion."""

    write: Callable[[Path, Motion, UpAxis], None]
    without_pose: str
    """How a hand without a pose is written, in words."""
    steady: bool = False
    """Whether frames are written without times, so that they must come at a steady rate."""
    keeps_axes: bool = False
    """Whether positions stay in the take's axes, whatever points up or forward."""


def motion_format(path: Path) -> MotionFormat:
    """The format of a file, by the ending of its name."""
    for ending, form in MOTION_FORMATS.items():
        if path.name.lower().endswith(ending):
            return form
    endings = ", ".join(MOTION_FORMATS)
    raise ArgumentError(f"cannot write a take as '{path}', expected a name that ends in {endings}")


def _write_joint_trc(path: Path, motion: Motion, up: UpAxis) -> None:
    """Write a .trc file for OpenSim, y up: keypoints of the hands and markers of their forearms."""
    turn, positions, names = file_axes(up), [], []
    for hand in motion.hands:
        positions.append(hand.keypoints() @ turn.T)
        names += [f"{hand.side}_{name}" for name in KEYPOINT_NAMES]
        if (forearm := motion.forearm(hand.side)) is not None:
            places = np.array([*forearm.markers.values()])
            pose = forearm.T_world_body
            positions.append((places @ pose[:, :3, :3].swapaxes(1, 2) + pose[:, None, :3, 3]) @ turn.T)
            names += [f"{forearm.name}:{name}" for name in forearm.markers]
    write_capture(path, Capture(tuple(names), np.concatenate(positions, axis=1), motion.rate))


MOTION_FORMATS: Final[dict[str, MotionFormat]] = {
    ".glb": MotionFormat(write_glb, "hidden (scale 0)"),
    ".bvh": MotionFormat(write_bvh, HELD_POSE, steady=True),
    ".usda": MotionFormat(write_usd, "invisible"),
    ".usdc": MotionFormat(write_usd, "invisible"),
    ".csv": MotionFormat(write_joint_csv, "blank", keeps_axes=True),
    ".trc": MotionFormat(_write_joint_trc, HELD_POSE, steady=True),
    ".mot": MotionFormat(write_mot, HELD_POSE),
}
"""The formats, by the endings of file names."""
