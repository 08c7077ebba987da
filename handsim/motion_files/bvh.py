"""BVH: the skeletons of hands and the frames of the things, as rotations in degrees about fixed axes.

The format has no unit and no comments, so the root is named `world_cm`: lengths are centimeters, which
animation programs expect, with y up. Below it stand the palm of each hand and the things, which have
positions; every other joint has rotations alone. All rotations zero is the flat hand. BVH cannot leave a
frame out: a hand without a pose keeps its last one.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.files.atomic import atomic_write
from handsim.hand.model import HandModel
from handsim.hand.topology import BONE_NAMES, BONES, PALM
from handsim.motion_files.motion import (
    CHILDREN,
    Motion,
    PosedHand,
    file_axes,
    local_rotations,
    posed_bodies,
    posed_hands,
)
from handsim.space.transforms import UpAxis, euler_angles

ROOT: Final = "world_cm"
_CENTIMETERS: Final = 100.0
_ROTATIONS: Final = "Zrotation Yrotation Xrotation"
_POSITIONS: Final = "Xposition Yposition Zposition"


def write_bvh(path: Path, motion: Motion, up: UpAxis = "z") -> None:
    """Write hands and things, of a motion at a steady rate; an `OSError` if the file cannot be written."""
    turn = file_axes(up)
    columns = [np.zeros((len(motion.times), 6))]
    lines = [f"ROOT {ROOT}", "{", *_indented(_joint(np.zeros(3), moves=True))]
    for hand in posed_hands(motion):
        lines += _indented(_bone_lines(hand.model, hand.side, PALM, _CENTIMETERS * turn))
        columns.append(_hand_columns(hand, turn))
    for thing in posed_bodies(motion):
        content = [*_joint(np.zeros(3), moves=True), *_end(np.eye(3)[0])]
        lines += _indented([f"JOINT {_word(thing.name)}", "{", *_indented(content), "}"])
        poses = thing.T_world_body
        angles = _degrees(turn @ poses[:, :3, :3] @ turn.T)
        columns.append(np.concatenate([_CENTIMETERS * poses[:, :3, 3] @ turn.T, angles], axis=1))
    with atomic_write(path) as temporary, temporary.open("w", encoding="ascii", newline="\n") as file:
        file.write("HIERARCHY\n" + "\n".join([*lines, "}"]) + "\n")
        table = np.concatenate(columns, axis=1)
        file.write(f"MOTION\nFrames: {len(table)}\nFrame Time: {1.0 / motion.rate:.9f}\n")
        np.savetxt(file, table, fmt="%.6f")


def _hand_columns(hand: PosedHand, turn: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "T 51"]:
    """Position of the palm [cm] and rotations of all bones [deg] from the flat hand, in the file's order."""
    qpos = hand.qpos
    rest = hand.model.rest_transforms[:, :3, :3]
    # In BVH all joints have the same axes at rest, here the file's.
    rotations = turn @ hand.model.forward_kinematics(qpos)[..., :3, :3] @ np.swapaxes(rest, -1, -2) @ turn.T
    local = local_rotations(rotations)
    position = _CENTIMETERS * qpos[:, :3] @ turn.T
    return np.concatenate([position, *(_degrees(local[:, bone]) for bone in _order(PALM))], axis=1)


def _degrees(rotations: Float[np.ndarray, "T 3 3"]) -> NDArray[np.float64]:
    """Angles (T, 3) about z, y and x [deg], without jumps from frame to frame."""
    return np.rad2deg(np.unwrap(euler_angles(rotations), axis=0))


def _order(bone: int) -> Iterator[int]:
    """Bones in the order of the file: each before its children."""
    yield bone
    for child in CHILDREN[bone]:
        yield from _order(child)


def _bone_lines(model: HandModel, side: str, bone: int, lay: Float[np.ndarray, "3 3"]) -> list[str]:
    """A bone and its children; `lay` takes the flat hand from the wrist's frame [m] to the file's [cm]."""
    rest = model.rest_transforms
    offset = np.zeros(3) if bone == PALM else rest[bone, :3, 3] - rest[BONES[bone].parent, :3, 3]
    lines = [f"JOINT {side}_{BONE_NAMES[bone]}", "{", *_indented(_joint(lay @ offset, moves=bone == PALM))]
    for child in CHILDREN[bone]:
        lines += _indented(_bone_lines(model, side, child, lay))
    if not CHILDREN[bone]:
        lines += _indented(_end(lay @ (model.skeleton.lengths[bone] * rest[bone, :3, 0])))
    return [*lines, "}"]


def _joint(offset: Float[np.ndarray, "3"], *, moves: bool) -> list[str]:
    channels = f"CHANNELS 6 {_POSITIONS} {_ROTATIONS}" if moves else f"CHANNELS 3 {_ROTATIONS}"
    return [_offset(offset), channels]


def _end(offset: Float[np.ndarray, "3"]) -> list[str]:
    return ["End Site", "{", f"\t{_offset(offset)}", "}"]


def _offset(offset: Float[np.ndarray, "3"]) -> str:
    return "OFFSET " + " ".join(f"{value:.6f}" for value in offset.tolist())


def _indented(lines: list[str]) -> list[str]:
    return [f"\t{line}" for line in lines]


def _word(name: str) -> str:
    """A name as one word."""
    return "".join(one if one.isascii() and one.isalnum() else "_" for one in name) or "thing"
