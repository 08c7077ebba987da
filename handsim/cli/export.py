"""The command `handsim export`: takes and labelers as files of other programs, by the ending of the file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import numpy as np
import tyro

from gloves.captures.capture import Capture
from gloves.captures.formats import write_capture
from gloves.takes.growing import SUFFIX as GROWING
from gloves.takes.motion import load_motion
from handsim.app.messages import print_line
from handsim.errors import ArgumentError
from handsim.files.outputs import check_outputs
from handsim.hand.keypoints import KEYPOINT_NAMES, hand_keypoints
from handsim.motion_files import openxr
from handsim.motion_files.bvh import write_bvh
from handsim.motion_files.glb_animation import write_glb
from handsim.motion_files.hands_in_motion import HandsInMotion, UpAxis
from handsim.motion_files.joint_table import write_joint_csv, write_joint_parquet
from handsim.motion_files.opensim_motion import write_mot
from handsim.motion_files.usd import write_usd


class _Format(NamedTuple):
    """A format of motion."""

    write: Callable[[Path, HandsInMotion], None]
    without_pose: str
    """What a hand without a pose is in it."""


def export(
    source: Annotated[str, tyro.conf.Positional], out: Path, fps: float | None = None, up: UpAxis = "z"
) -> None:
    """Write the motion of a take, or a trained labeler, for other programs.

    Args:
        source: A take (.npz, of `handsim track` or the .truth.npz of `handsim simulate`); or a labeler, by
            the name of a glove with a shipped one or the folder of a trained one.
        out: The file. Of a take .glb (skinned and animated), .bvh, .usda or .usdc, .csv or .parquet (joint
            angles and positions), .trc (joint positions), .mot (joint angles for OpenSim) or .openxr.json;
            of a labeler .onnx, which labels without torch.
        fps: Frames per second of the file, such as 30 or 60 for a game; those of the take when not given.
        up: The axis of the take that points up; y for captures of Motive's default.
    """
    if source.lower().endswith((".npz", f".npz{GROWING}")):
        _export_take(Path(source), out, fps, up)
    elif source.lower().endswith(".json"):
        raise ArgumentError(
            f"cannot export '{source}', expected a take (.npz) or a labeler; `handsim hand --shape` writes "
            "the hand of a user's file"
        )
    else:
        _export_labeler(source, out)


def _export_take(source: Path, out: Path, fps: float | None, up: UpAxis) -> None:
    form = next((form for ending, form in _FORMATS.items() if out.name.lower().endswith(ending)), None)
    if form is None:
        raise ArgumentError(
            f"cannot write the take '{source}' as '{out}', expected a name that ends in {', '.join(_FORMATS)}"
        )
    check_outputs([source], [out])
    motion = load_motion(source, up=up)
    if fps is not None:
        motion = motion.resampled(fps)
    form.write(out, motion)
    sides = " and ".join(hand.side for hand in motion.hands)
    things = "".join(f", {thing.name}" for thing in motion.things)
    print_line(
        f"{out}: {sides} hand{'s' * (len(motion.hands) > 1)}{things}; {motion.num_frames} frames at "
        f"{motion.rate:g} Hz"
    )
    for hand in motion.hands:
        absent = int((~hand.present).sum())
        if absent:
            print_line(f"{hand.side} hand: without a pose in {absent} frames, {form.without_pose} there")


def _export_labeler(source: str, out: Path) -> None:
    from train.labelers.onnx_labeler import export_onnx
    from train.labelers.storage import load_network

    if out.suffix.lower() != ".onnx":
        raise ArgumentError(
            f"cannot write the labeler '{source}' as '{out}', expected a name that ends in .onnx; takes, "
            f"which end in .npz, become {', '.join(_FORMATS)}"
        )
    check_outputs([source], [out])
    network, card = load_network(source)
    export_onnx(network, card["marker_names"], out)
    print_line(f"{out}: {len(card['marker_names'])} markers")


def _write_joint_trc(path: Path, motion: HandsInMotion) -> None:
    """The keypoints of all hands as markers, in the take's axes, so that they lie among its markers."""
    steady = motion.steady()
    positions = []
    for hand in steady.hands:
        keypoints = hand_keypoints(hand.model, hand.held_qpos)
        positions.append(np.where(hand.present[:, None, None], keypoints, np.nan))
    names = tuple(f"{hand.side}_{name}" for hand in steady.hands for name in KEYPOINT_NAMES)
    write_capture(path, Capture(names, np.concatenate(positions, axis=1), steady.rate))


_FORMATS: Final[dict[str, _Format]] = {
    ".glb": _Format(write_glb, "hidden (scale 0)"),
    ".bvh": _Format(write_bvh, "held at its last pose"),
    ".usda": _Format(write_usd, "invisible"),
    ".usdc": _Format(write_usd, "invisible"),
    ".csv": _Format(write_joint_csv, "blank"),
    ".parquet": _Format(write_joint_parquet, "null"),
    ".trc": _Format(_write_joint_trc, "blank"),
    ".mot": _Format(write_mot, "NaN"),
    openxr.SUFFIX: _Format(openxr.write_openxr, "null"),
}
"""Formats of motion by the ends of names."""
