"""Motions of hands and things for writers, and joints of hands as tables, as BVH and as OpenXR's joints.

A table (.csv) has a row per frame and hand and a column per number, with the unit in its name. Numbers of a
hand without a pose are empty. OpenSim's .mot has a row per frame, angles in degrees, and y up as OpenSim's
world; a hand without a pose keeps its last one, because OpenSim ends at NaN.

BVH has no unit and no comments, so the root is named `world_cm`: lengths are centimeters, which animation
programs expect, with y up. Its children are the palms of the hands and the things, which have positions; all
other joints have rotations alone. In the flat hand all rotations are zero. BVH cannot omit a frame, so a hand
without a pose keeps its last one.

A joint of OpenXR's hand tracking (XR_EXT_hand_tracking) is the near end of the bone with its name. Its -z
axis points along that bone to the fingertip, its +y axis out of the back (nail) side: OpenXR's x, y and z are
our -y, z and -x. Tips have the axes of their last bone. The near ends of the four finger metacarpals do not
move in our hand; the palm joint is the middle of the middle metacarpal.

Metacarpals are no bones of their own. Where those of ring and little finger flex (`HandShape.arch`), the
first bones of these fingers move in the palm, and BVH has their positions, too. An OpenSim model has a rigid
palm, so that its coordinates lack that motion.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Final, NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from handsim.errors import CaptureError, choices
from handsim.files.inputs import read_bytes
from handsim.files.outputs import as_text, atomic_write
from handsim.hand.angles import ISB_JOINTS, ISB_NAMES, WRIST_NAMES, isb_angles
from handsim.hand.model import KEYPOINT_NAMES, HandModel, hand_keypoints, metacarpal_rotations
from handsim.hand.model_files import coordinate_names, coordinate_values, forearm_names, forearm_values
from handsim.hand.shape import BONE_NAMES, BONES, DIGITS, JOINT_NAMES, PALM, SIDES, Side, bones_of
from handsim.hand.skin import load_cage
from handsim.kernels import CARPUS
from handsim.space.objects import Part, RigidObject
from handsim.space.transforms import (
    UpAxis,
    euler_angles,
    file_axes,
    pose_matrices,
    rigid,
    rotation_quaternions,
)

CHILDREN: Final = tuple(
    tuple(number for number, bone in enumerate(BONES) if bone.parent == parent)
    for parent in range(len(BONES))
)
"""Indices of the children of each bone."""
_PARENTS: Final = np.array([bone.parent for bone in BONES])
_MIN_EDGE_COSINE: Final = np.cos(np.deg2rad(40.0))
_KEY_NAMES: Final = ("frame", "time_s", "hand")
_QPOS_NAMES: Final = (
    *(f"wrist_{axis}_m" for axis in "xyz"),
    *(f"wrist_q{part}" for part in "wxyz"),
    *(f"{joint}_rad" for joint in JOINT_NAMES),
)
NUMBERS: Final[tuple[str, ...]] = (
    *_QPOS_NAMES,
    *(f"{keypoint}_{axis}_m" for keypoint in KEYPOINT_NAMES[1:] for axis in "xyz"),
)
"""Columns after `frame`, `time_s` and `hand`, with positions in the world."""
_OLD_NAMES: Final = {f"thumb_CMC_{n}_rad": f"thumb_metacarpal_{n}_rad" for n in ("abduction", "flexion")}
"""Names of columns in earlier versions, and their names now."""
_BVH_ROOT: Final = "world_cm"
_CENTIMETERS: Final = 100.0
_ROTATIONS: Final = "Zrotation Yrotation Xrotation"
_POSITIONS: Final = "Xposition Yposition Zposition"
OPENXR_JOINTS: Final[tuple[str, ...]] = (
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
_OPENXR_AXES: Final = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""OpenXR's axes as columns in a frame with x along the bone and z out of the back."""


class Material(NamedTuple):
    """The material of a surface."""

    name: str
    color: tuple[float, float, float]
    """Linear light, in [0, 1]."""
    roughness: float


SKIN: Final = Material("skin", (0.66, 0.38, 0.28), 0.65)
THING: Final = Material("thing", (0.16, 0.2, 0.26), 0.5)


class PosedHand(NamedTuple):
    """A hand of a motion."""

    model: HandModel
    present: Bool[np.ndarray, "T"]
    """Frames with a pose, at least one."""
    qpos: Float[np.ndarray, "T 27"]
    """Poses [m, rad]; missing ones repeat the last pose, or else the first."""
    neutral: Float[np.ndarray, "20"] | None = None
    """Joint angles [rad] of the pose in which those of the ISB are zero; None for the convention's zero."""
    former: Sequence[tuple[int, HandModel]] = ()
    """Models of earlier frames, each with the first frame after them; `model` is that of the last frames."""
    shown: Bool[np.ndarray, "20"] | None = None
    """Which joints markers showed; tables leave out the others. None if all are known."""
    wrist: Float[np.ndarray, "T 3"] | None = None
    """Angles of the wrist in the order of `WRIST_NAMES` [rad], NaN where unknown; None without a forearm."""

    @property
    def side(self) -> Side:
        """Which hand it is."""
        return self.model.shape.side

    @classmethod
    def of(
        cls,
        model: HandModel,
        qpos: Float[np.ndarray, "T 27"],
        neutral: Float[np.ndarray, "20"] | None = None,
        former: Sequence[tuple[int, HandModel]] = (),
    ) -> PosedHand:
        """A hand with its poses, NaN where it has none."""
        present: NDArray[np.bool_] = np.isfinite(qpos[:, 0])
        return cls(model, present, _filled_rows(qpos, present), neutral, former)

    def by_frame(
        self, compute: Callable[[HandModel, Float[np.ndarray, "K 27"]], NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        """Results (T, ...) of a function of a model and its poses, over all frames and their models."""
        first, parts = 0, []
        for stop, model in (*self.former, (len(self.qpos), self.model)):
            if stop > first:
                parts.append(compute(model, self.qpos[first:stop]))
                first = stop
        return np.concatenate(parts)

    def bones(self) -> Float[np.ndarray, "T L 4 4"]:
        """`T_world_bone` of all bones [m]."""
        return self.by_frame(lambda model, qpos: model.forward_kinematics(qpos))

    def offsets(self) -> Float[np.ndarray, "T L 3"]:
        """The position of each bone in its parent's frame, and the palm's in the world [m]."""
        offsets = self.by_frame(_offsets)
        offsets[:, PALM] = self.qpos[:, :3]
        return offsets

    def keypoints(self) -> Float[np.ndarray, "T 21 3"]:
        """Wrist, joints and fingertips in the world [m]."""
        return self.by_frame(hand_keypoints)


class PosedBody(NamedTuple):
    """A rigid body of a motion."""

    name: str
    shape: RigidObject | None
    """The surface, None if unknown."""
    present: Bool[np.ndarray, "T"]
    """Frames with a pose, at least one."""
    T_world_body: Float[np.ndarray, "T 4 4"]
    """Poses [m]; missing ones repeat the last pose, or else the first."""
    forearm: Side | None = None
    """The hand whose forearm it is, in the frame of the straight hand's wrist; None for other bodies."""
    markers: Mapping[str, Float[np.ndarray, "3"]] = MappingProxyType({})
    """A forearm's markers by name, in its frame [m]."""

    @classmethod
    def of(cls, name: str, shape: RigidObject | None, poses: Float[np.ndarray, "T 7"]) -> PosedBody:
        """A body with its positions [m] and orientations (wxyz), NaN where it has none."""
        present: NDArray[np.bool_] = np.isfinite(poses[:, 0])
        return cls(name, shape, present, pose_matrices(_filled_rows(poses, present)))

    def as_forearm(self, hand: PosedHand, markers: Mapping[str, Float[np.ndarray, "3"]]) -> PosedBody:
        """The forearm of a hand: the outline of its skin at the wrist, extruded to the farthest marker."""
        import trimesh

        # The body's origin may be above the wrist, so the skin begins at the median position of the hand.
        away = hand.qpos[:, :3] - self.T_world_body[:, :3, 3]
        wrist = np.median(np.einsum("ti,tij->tj", away, self.T_world_body[:, :3, :3]), axis=0)
        loop = hand.model.surface.vertices[load_cage().wrist_loop] + wrist
        end = loop * [0.0, 1.0, 1.0] + [min(place[0] for place in markers.values()), 0.0, 0.0]
        hull = trimesh.convex.convex_hull(np.concatenate([loop, end]))
        corners, faces = np.array(hull.vertices), np.array(hull.faces)
        shape = RigidObject(self.name, corners, faces, (Part("mesh", np.zeros(3), np.eye(4), corners),))
        return self._replace(shape=shape, forearm=hand.side, markers=markers)

    @property
    def material(self) -> Material:
        """What its surface is made of."""
        return THING if self.forearm is None else SKIN


class Motion(NamedTuple):
    """Hands and rigid bodies, frame by frame."""

    rate: float
    """Frames per second [Hz]; for a stream, the median rate."""
    times: Float[np.ndarray, "T"]
    """Time of each frame [s], increasing."""
    hands: Sequence[PosedHand]
    bodies: Sequence[PosedBody]

    @property
    def seconds(self) -> Float[np.ndarray, "T"]:
        """Time since the first frame [s]."""
        return np.asarray(self.times - self.times[0])

    def forearm(self, side: Side) -> PosedBody | None:
        """The forearm of a hand, None if it has none with axes."""
        return next((body for body in self.bodies if body.forearm == side), None)


def are_moved(model: HandModel) -> Bool[np.ndarray, "L"]:
    """Whether each bone moves in its parent's frame: the palm, and fingers whose metacarpals flex."""
    moved: NDArray[np.bool_] = np.arange(len(BONES)) == PALM
    moved[1::3] = model.skeleton.arch > 0.0
    return moved


def _offsets(model: HandModel, qpos: Float[np.ndarray, "T 27"]) -> Float[np.ndarray, "T L 3"]:
    """The position of each bone in its parent's frame [m]; zero for the palm."""
    offsets = np.tile(model.skeleton.offsets, (len(qpos), 1, 1))
    arched = 1 + 3 * np.flatnonzero(model.skeleton.arch)
    if len(arched):
        bones = model.forward_kinematics(qpos)
        begins = bones[:, arched][..., :3, 3] - bones[:, PALM, None, :3, 3]
        offsets[:, arched] = begins @ bones[:, PALM, :3, :3]
    return offsets


def changes(present: Bool[np.ndarray, "T"]) -> Int[np.ndarray, "K"]:
    """The numbers of the first frame and of each frame in which `present` changes."""
    return np.flatnonzero(np.diff(present, prepend=not present[0]))


def _filled_rows(values: NDArray[np.float64], present: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Replace each missing row by the last present one before it, or by the first present one."""
    last = np.maximum.accumulate(np.where(present, np.arange(len(present)), -1))
    return values[np.where(last < 0, np.argmax(present), last)]


def local_rotations(rotations: Float[np.ndarray, "T L 3 3"]) -> Float[np.ndarray, "T L 3 3"]:
    """Each bone's orientation in its parent's frame, and the palm's in the world."""
    local: NDArray[np.float64] = np.swapaxes(rotations[:, _PARENTS], -1, -2) @ rotations
    local[:, PALM] = rotations[:, PALM]
    return local


def smooth_quaternions(rotations: Float[np.ndarray, "T *batch 3 3"]) -> Float[np.ndarray, "T *batch 4"]:
    """Unit wxyz quaternions of rotations over time, without sign flips."""
    quaternions = rotation_quaternions(rotations.reshape(-1, 3, 3)).reshape(*rotations.shape[:-2], 4)
    dots = (quaternions[1:] * quaternions[:-1]).sum(axis=-1, keepdims=True)
    signs = np.cumprod(np.where(dots < 0.0, -1.0, 1.0), axis=0)
    quaternions[1:] *= signs
    return quaternions


def corner_normals(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "F 3 3"]:
    """Outward unit normal at each corner of a face: the mean of adjacent faces within 40 degrees."""
    from scipy import sparse  # takes a quarter of a second, which help does not need

    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    areas = np.cross(second - first, third - first)
    units = _unit(areas)
    count = faces.size
    at = sparse.csr_array((np.ones(count), (np.arange(count), faces.ravel())), shape=(count, len(vertices)))
    one, other = (at @ at.T).nonzero()  # pairs of corners at one vertex
    near = (units[one // 3] * units[other // 3]).sum(axis=1) > _MIN_EDGE_COSINE
    near |= one == other  # also on a face without an area
    sums = np.zeros((count, 3))
    np.add.at(sums, one[near], areas[other[near] // 3])
    return _unit(sums).reshape(-1, 3, 3)


def split_vertices(
    faces: Int[np.ndarray, "F 3"], normals: Float[np.ndarray, "F 3 3"]
) -> tuple[Int[np.ndarray, "W"], Float[np.ndarray, "W 3"], Int[np.ndarray, "F 3"]]:
    """Split vertices so that each has one normal; returns old indices, normals and new faces."""
    keys = np.column_stack([faces.ravel(), np.round(normals.reshape(-1, 3), 4)])
    _, index, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return faces.ravel()[index], normals.reshape(-1, 3)[index], inverse.reshape(-1, 3)


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: NDArray[np.float64] = np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0.0)
    unit[lengths[:, 0] == 0.0] = (0.0, 0.0, 1.0)
    return unit


class JointTable(NamedTuple):
    """Poses read from a table."""

    sides: tuple[Side, ...]
    """Sides of the hands, in the order of their first rows."""
    times: Float[np.ndarray, "T"]
    """Time of each frame [s]."""
    qpos: Float[np.ndarray, "T H 27"]
    """Wrist position [m], wrist orientation (wxyz), joint angles [rad]; NaN without a pose."""


def read_joint_csv(path: Path) -> JointTable:
    """Read a .csv with the columns frame, time, hand and qpos of `write_joint_csv`."""
    text = read_bytes(path, error=CaptureError).decode("utf-8-sig", "replace")
    lines = csv.reader(text.splitlines())
    try:
        titles = [_OLD_NAMES.get(title.strip(), title.strip()) for title in next(lines, [])]
        wanted = [*_KEY_NAMES, *_QPOS_NAMES]
        missing = [name for name in wanted if name not in titles]
        if missing:
            raise CaptureError(
                f"{path}: no column '{missing[0]}'; of a .csv are read {', '.join(_KEY_NAMES)}, "
                f"{_QPOS_NAMES[0]} to {_QPOS_NAMES[6]} and the joint angles {_QPOS_NAMES[7]} to "
                f"{_QPOS_NAMES[-1]}, as handsim export writes them"
            )
        columns = [titles.index(name) for name in wanted]
        rows = [(lines.line_num, [row[column].strip() for column in columns]) for row in lines if any(row)]
    except (csv.Error, IndexError) as error:
        raise CaptureError(f"{path}: line {lines.line_num} cannot be read: {error}") from error
    if not rows:
        raise CaptureError(f"{path}: no frames: nothing follows the line of titles")
    return _posed_table(path, rows)


def _posed_table(path: Path, rows: list[tuple[int, list[str]]]) -> JointTable:
    """Poses by frame and hand, from the columns `_KEY_NAMES` and `_QPOS_NAMES` of numbered lines."""
    frames: dict[str, int] = {}
    sides: dict[str, int] = {}
    for number, (frame, _, side, *_) in rows:
        if side not in SIDES:
            raise CaptureError(f"{path}: line {number}: {choices(side, SIDES, noun='hand')}")
        frames.setdefault(frame, len(frames))
        sides.setdefault(side, len(sides))
    times = np.full(len(frames), np.nan)
    qpos = np.full((len(frames), len(sides), len(_QPOS_NAMES)), np.nan)
    filled = np.zeros(qpos.shape[:2], dtype=np.bool_)
    for number, (frame, time, side, *cells) in rows:
        place = frames[frame], sides[side]
        if filled[place]:
            raise CaptureError(f"{path}: line {number} has frame {frame} of the {side} hand again")
        filled[place] = True
        try:
            times[place[0]] = float(time)
            qpos[place] = [float(cell) if cell else np.nan for cell in cells]
        except ValueError as error:
            raise CaptureError(f"{path}: line {number}: {error}") from error
    return JointTable(cast("tuple[Side, ...]", tuple(sides)), times, qpos)


def write_joint_csv(path: Path, motion: Motion, up: UpAxis = "z") -> None:
    """Write the table as text with nine digits (times: sixteen), in the take's axes whatever `up` is."""
    hands, titles = motion.hands, _titles(motion)
    tables = [_numbers(hand, len(titles)) for hand in hands]
    row_format = ",%.9g" * len(titles)
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        file.write(",".join([*_KEY_NAMES, *titles]) + "\n")
        for frame, time in enumerate(motion.times.tolist()):
            for hand, table in zip(hands, tables, strict=True):
                row = table[frame]
                text = row_format % tuple(row.tolist()) if hand.present[frame] else "," * len(titles)
                text = text.replace("nan", "")
                file.write(f"{frame},{time:.16g},{hand.side}{text}\n")


def _titles(motion: Motion) -> tuple[str, ...]:
    """The columns `NUMBERS`, and ISB angles, whose names state whether a neutral pose is their zero."""
    isb = "isb" if motion.hands[0].neutral is None else "isb_neutral"
    names = ISB_NAMES if all(hand.wrist is None for hand in motion.hands) else (*ISB_NAMES, *WRIST_NAMES)
    return *NUMBERS, *(f"{name}_{isb}_rad" for name in names)


def _numbers(hand: PosedHand, count: int) -> Float[np.ndarray, "T K"]:
    """The `count` columns of `_titles`; NaN without a pose, and for joints that no marker shows."""
    qpos = hand.qpos
    keypoints = hand.keypoints()[:, 1:].reshape(len(qpos), -1)
    isb = hand.by_frame(lambda model, poses: isb_angles(model.shape, poses[:, 7:], hand.neutral))
    numbers = np.concatenate([qpos, keypoints, isb], axis=1)
    numbers[~hand.present] = np.nan
    if hand.shown is not None:
        hidden = ~hand.shown
        moved = np.logical_or.accumulate(hidden.reshape(len(DIGITS), -1), axis=1)
        moved[:, 0] = False  # a digit's first keypoint does not move
        wrist, isb = np.zeros(qpos.shape[1] - len(hidden), dtype=np.bool_), hidden[list(ISB_JOINTS)]
        numbers[:, np.concatenate([wrist, hidden, np.repeat(moved, 3), isb])] = np.nan
    if count > numbers.shape[1]:
        unknown = np.full((len(qpos), len(WRIST_NAMES)), np.nan)
        numbers = np.concatenate([numbers, unknown if hand.wrist is None else hand.wrist], axis=1)
    return numbers


def write_mot(path: Path, motion: Motion, up: UpAxis = "z") -> None:
    """Write the coordinates of all hands in every frame."""
    columns, names = [motion.seconds[:, None]], ["time"]
    for hand in motion.hands:
        values = coordinate_values(hand.qpos, up)
        columns += [values[:, :3], np.rad2deg(values[:, 3:])]
        names += coordinate_names(hand.side)
        if (forearm := motion.forearm(hand.side)) is not None:
            in_hand = np.linalg.inv(pose_matrices(hand.qpos[:, :7])) @ forearm.T_world_body
            values = forearm_values(hand.side, in_hand)
            columns += [np.rad2deg(values[:, :3]), values[:, 3:]]
            names += forearm_names(hand.side)
    table = np.concatenate(columns, axis=1)
    header = [
        as_text(path.stem),
        "version=1",
        f"nRows={len(table)}",
        f"nColumns={table.shape[1]}",
        "inDegrees=yes",
        "convention=model",
        "endheader",
        "\t".join(names),
    ]
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        file.write("\n".join(header) + "\n")
        np.savetxt(file, table, fmt="%.9f", delimiter="\t")


def write_bvh(path: Path, motion: Motion, up: UpAxis = "z") -> None:
    """Write hands and things of a motion at a steady rate."""
    turn = file_axes(up)
    columns = [np.zeros((len(motion.times), 6))]
    lines = [f"ROOT {_BVH_ROOT}", "{", *_indented(_joint_lines(np.zeros(3), moves=True))]
    for hand in motion.hands:
        lines += _indented(_bone_lines(hand.model, hand.side, PALM, _CENTIMETERS * turn))
        # In BVH all joints have the axes of the file at rest.
        rotations = turn @ hand.by_frame(_from_rest) @ turn.T
        local = local_rotations(rotations)
        places, moved = _CENTIMETERS * hand.offsets() @ turn.T, are_moved(hand.model)
        for bone in _bone_order(PALM):
            columns += [places[:, bone]] if moved[bone] else []
            columns.append(_euler_degrees(local[:, bone]))
    for thing in motion.bodies:
        end = np.eye(3)[0]
        if thing.forearm is not None:  # its bone goes from the wrist to the farthest marker
            end = _CENTIMETERS * min(place[0] for place in thing.markers.values()) * turn[:, 0]
        content = [*_joint_lines(np.zeros(3), moves=True), *_end_lines(end)]
        word = "".join(one if one.isascii() and one.isalnum() else "_" for one in thing.name) or "thing"
        lines += _indented([f"JOINT {word}", "{", *_indented(content), "}"])
        poses = thing.T_world_body
        angles = _euler_degrees(turn @ poses[:, :3, :3] @ turn.T)
        columns.append(np.concatenate([_CENTIMETERS * poses[:, :3, 3] @ turn.T, angles], axis=1))
    with atomic_write(path) as temporary, temporary.open("w", encoding="ascii", newline="\n") as file:
        file.write("HIERARCHY\n" + "\n".join([*lines, "}"]) + "\n")
        table = np.concatenate(columns, axis=1)
        file.write(f"MOTION\nFrames: {len(table)}\nFrame Time: {1.0 / motion.rate:.9f}\n")
        np.savetxt(file, table, fmt="%.6f")


def _from_rest(model: HandModel, qpos: Float[np.ndarray, "T 27"]) -> Float[np.ndarray, "T L 3 3"]:
    """The rotation of each bone in the world from its orientation at rest."""
    rest = np.swapaxes(model.rest_transforms[:, :3, :3], -1, -2)
    return np.asarray(model.forward_kinematics(qpos)[..., :3, :3] @ rest)


def _euler_degrees(rotations: Float[np.ndarray, "T 3 3"]) -> NDArray[np.float64]:
    """Unwrapped angles (T, 3) about z, y and x [deg]."""
    return np.rad2deg(np.unwrap(euler_angles(rotations), axis=0))


def _bone_order(bone: int) -> Iterator[int]:
    """Yield a bone and those below it, each before its children, as in the file."""
    yield bone
    for child in CHILDREN[bone]:
        yield from _bone_order(child)


def _bone_lines(model: HandModel, side: str, bone: int, axes: Float[np.ndarray, "3 3"]) -> list[str]:
    """The lines of a bone and its children; `axes` maps the wrist's frame [m] to the file's [cm]."""
    rest = model.rest_transforms
    offset = np.zeros(3) if bone == PALM else rest[bone, :3, 3] - rest[BONES[bone].parent, :3, 3]
    joint = _joint_lines(axes @ offset, moves=bool(are_moved(model)[bone]))
    lines = [f"JOINT {side}_{BONE_NAMES[bone]}", "{", *_indented(joint)]
    for child in CHILDREN[bone]:
        lines += _indented(_bone_lines(model, side, child, axes))
    if not CHILDREN[bone]:
        lines += _indented(_end_lines(axes @ (model.skeleton.lengths[bone] * rest[bone, :3, 0])))
    return [*lines, "}"]


def _joint_lines(offset: Float[np.ndarray, "3"], *, moves: bool) -> list[str]:
    channels = f"CHANNELS 6 {_POSITIONS} {_ROTATIONS}" if moves else f"CHANNELS 3 {_ROTATIONS}"
    return [_offset_line(offset), channels]


def _end_lines(offset: Float[np.ndarray, "3"]) -> list[str]:
    return ["End Site", "{", f"\t{_offset_line(offset)}", "}"]


def _offset_line(offset: Float[np.ndarray, "3"]) -> str:
    return "OFFSET " + " ".join(f"{value:.6f}" for value in offset.tolist())


def _indented(lines: list[str]) -> list[str]:
    return [f"\t{line}" for line in lines]


def joint_poses(model: HandModel, qpos: Float[np.ndarray, "T 27"]) -> Float[np.ndarray, "T 26 4 4"]:
    """`T_world_joint` of OpenXR's joints, in our world [m]."""
    bones = model.forward_kinematics(qpos)
    poses = np.empty((len(bones), len(OPENXR_JOINTS), 4, 4))
    number = 2
    in_palm = _palm_joints(model)
    poses[:, :2] = bones[:, PALM, None] @ in_palm[:2]
    for digit, name in enumerate(DIGITS):
        first, second, third = bones_of(name)
        if digit:
            poses[:, number] = bones[:, PALM] @ in_palm[1 + digit]
            if model.skeleton.arch[digit] > 0.0:
                turned = metacarpal_rotations(model.skeleton, bones)[:, digit]
                poses[:, number, :3, :3] = turned @ in_palm[1 + digit, :3, :3]
            number += 1
        tip = np.eye(4)
        tip[0, 3] = model.skeleton.lengths[third]
        ends = (bones[:, first], bones[:, second], bones[:, third], bones[:, third] @ tip)
        for offset, end in enumerate(ends):
            poses[:, number + offset] = end
            poses[:, number + offset, :3, :3] = end[:, :3, :3] @ _OPENXR_AXES
        number += 4
    return poses


def joint_radii(model: HandModel) -> Float[np.ndarray, "26"]:
    """Radius of the hand at each joint [m]; in the palm, half its thickness."""
    shape, palm = model.shape, 0.5 * model.shape.palm_thickness
    fingers = [radius for row in shape.radii[1:].tolist() for radius in (palm, *row)]
    return np.array([palm, palm, *shape.radii[0].tolist(), *fingers])


def _palm_joints(model: HandModel) -> Float[np.ndarray, "6 4 4"]:
    """`T_wrist_joint` of palm, wrist and the four finger metacarpals."""
    knuckles = np.array([model.skeleton.offsets[bones_of(digit)[0]] for digit in DIGITS[1:]])
    bases = CARPUS * knuckles
    middle = 1  # among the four fingers
    starts = [0.5 * (bases[middle] + knuckles[middle]), np.zeros(3), *bases]
    directions = [knuckles[middle] - bases[middle], bases[middle], *(knuckles - bases)]
    joints = []
    for start, direction in zip(starts, directions, strict=True):
        along = direction / np.linalg.norm(direction)
        back = np.array([0.0, 0.0, 1.0]) - along[2] * along
        back /= np.linalg.norm(back)
        joints.append(rigid(np.stack([along, np.cross(back, along), back], axis=1) @ _OPENXR_AXES, start))
    return np.array(joints)
