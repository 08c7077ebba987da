"""Formats of motion for other programs, by the ends of names."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from gloves.captures.capture import Capture
from gloves.captures.formats import write_capture
from handsim.errors import ArgumentError
from handsim.hand.keypoints import KEYPOINT_NAMES, hand_keypoints
from handsim.motion_files import openxr
from handsim.motion_files.bvh import write_bvh
from handsim.motion_files.glb_animation import write_glb
from handsim.motion_files.joint_table import write_joint_csv, write_joint_parquet, write_mot
from handsim.motion_files.motion import Motion, posed_hands
from handsim.motion_files.usd import write_usd
from handsim.space.transforms import UpAxis


class MotionFormat(NamedTuple):
    """A format of motion."""

    write: Callable[[Path, Motion, UpAxis], None]
    without_pose: str
    """What a hand without a pose is in it."""
    steady: bool = False
    """Whether its frames have no times of their own, and must come at a steady rate."""


def motion_format(path: Path) -> MotionFormat:
    """The format that the end of a name says."""
    for ending, form in MOTION_FORMATS.items():
        if path.name.lower().endswith(ending):
            return form
    endings = ", ".join(MOTION_FORMATS)
    raise ArgumentError(f"cannot write a take as '{path}', expected a name that ends in {endings}")


def _write_joint_trc(path: Path, motion: Motion, up: UpAxis) -> None:
    """The keypoints of all hands as markers, in the take's axes, so that they lie among its markers."""
    del up
    positions, names = [], []
    for hand in posed_hands(motion):
        keypoints = hand_keypoints(hand.model, hand.qpos)
        positions.append(np.where(hand.present[:, None, None], keypoints, np.nan))
        names += [f"{hand.side}_{name}" for name in KEYPOINT_NAMES]
    write_capture(path, Capture(tuple(names), np.concatenate(positions, axis=1), motion.rate))


MOTION_FORMATS: Final[dict[str, MotionFormat]] = {
    ".glb": MotionFormat(write_glb, "hidden (scale 0)"),
    ".bvh": MotionFormat(write_bvh, "held at its last pose", steady=True),
    ".usda": MotionFormat(write_usd, "invisible"),
    ".usdc": MotionFormat(write_usd, "invisible"),
    ".csv": MotionFormat(write_joint_csv, "blank"),
    ".parquet": MotionFormat(write_joint_parquet, "null"),
    ".trc": MotionFormat(_write_joint_trc, "blank", steady=True),
    ".mot": MotionFormat(write_mot, "NaN"),
    openxr.SUFFIX: MotionFormat(openxr.write_openxr, "null"),
}
"""The formats, by the ends of names."""
