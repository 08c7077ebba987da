"""`Mano`: a user's own MANO file, and its parameters for our hands, fitted by keypoints and surface.

MANO (Romero, Tzionas and Black 2017, ACM Trans. Graph. 36:245) may not be shipped, and nothing else needs it.
Its vertices are attached to a person's skin at rest once, where the fit puts them. In every other pose the
skin carries them, and MANO follows by Gauss-Newton steps, of which few suffice: our bones give
the first rotations.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from handsim.errors import FileError
from handsim.files.arrays import read_npz
from handsim.files.inputs import check_regular
from handsim.hand.model import HandModel, hand_keypoints, join_qpos
from handsim.hand.shape import HAND_DTYPE, HandShape, pack_hand, unpack_hand
from handsim.hand.skin import all_weights, skin_frames, vertex_normals
from handsim.space.transforms import MIRROR, quaternion_matrix
from poses.shapes import load_gestures
from render.frames import Doubles, Integers

SHAPES: Final[dict[str, tuple[int, ...]]] = {
    "v_template": (778, 3),
    "shapedirs": (778, 3, 10),
    "posedirs": (778, 3, 135),
    "J_regressor": (16, 778),
    "weights": (778, 16),
    "kintree_table": (2, 16),
}
"""Arrays of a MANO file."""
_CONVERT: Final = (
    "expected a .npz, because pickles can run any program; where you trust the .pkl and have its packages, "
    'make one: import pickle, numpy as np; m = pickle.load(open("MANO_RIGHT.pkl", "rb"), encoding="latin1"); '
    'np.savez("MANO_RIGHT.npz", **{k: np.array(m[k].todense() if hasattr(m[k], "todense") else m[k]) '
    f"for k in {[*SHAPES]}}})"
)
_BONES: Final = np.array([0, 4, 5, 6, 7, 8, 9, 13, 14, 15, 10, 11, 12, 1, 2, 3])  # our bone of each joint
_DIGITS: Final = (13, 1, 4, 10, 7)  # first joint of each digit in our order
_ROUGH, _CLOSE = 12, 20  # steps of the first pose, by keypoints and by the surface
_SHAPE_STEPS, _POSE_STEPS = 12, 3  # steps of the poses that tell the shape, and of any pose
_KEYPOINT_WEIGHT: Final = 0.3  # weight of a keypoint over that of a vertex, as MANO's joints lie elsewhere
_SLIDING_WEIGHT: Final = (
    0.05  # weight of distances along our skin, where vertices may slide, over those across
)
_BONE_DISTANCE: Final = 0.02  # distance that stands for vertices whose bones have nothing in common [m]
_FARTHEST: Final = 0.012  # distance from our skin of vertices that are left out, as behind the wrist [m]
_SHAPE_COST: Final = 0.0005  # cost of a shape of one standard deviation, as a distance of vertices [m]
_DAMPING: Final = 1e-7  # of rotations that vertices hardly show [m^2]


class Mano:
    """The right hand of a MANO file."""

    def __init__(self, path: str | Path) -> None:
        """Read the arrays of a file.

        Raises:
            FileError: It is no .npz of plain arrays, or one of MANO's arrays is missing or has another shape.
        """
        path = Path(path)
        check_regular(path, error=FileError)
        if path.suffix.lower() != ".npz":
            raise FileError(f"{path}: {_CONVERT}")
        try:
            arrays = read_npz(path)
        except (OSError, ValueError) as error:
            raise FileError(f"{path}: not an .npz of plain arrays, or a damaged one; {_CONVERT}") from error
        for name, shape in SHAPES.items():
            if name not in arrays or arrays[name].shape != shape:
                found = arrays[name].shape if name in arrays else "no such array"
                raise FileError(f"{path}: {name} has shape {found}, expected {shape} as MANO's")
        self._template, self._shapes, self._posed_by, self._joints_of, self._weights = (
            arrays[name].astype(np.float64) for name in [*SHAPES][:5]
        )
        self._parents = [int(parent) for parent in arrays["kintree_table"][0].astype(np.int64)]
        self._below = np.eye(16)  # whether the second joint turns with the first
        for joint in range(15, 0, -1):
            self._below[self._parents[joint]] += self._below[joint]
        joints = self._joints_of @ self._template
        rows = [joint for first in _DIGITS for joint in (first, first + 1, first + 2, -1)]
        self._keypoints = np.array([0, *rows])  # joint at each of our keypoints; -1 for tips
        lasts = np.array(_DIGITS) + 2
        away = np.linalg.norm(self._template[:, None] - joints[lasts], axis=-1)
        self._tips: Integers = (away * (self._weights[:, lasts] > 0.5)).argmax(axis=0)

    def posed(self, turns: Doubles, shape: Doubles, move: Doubles) -> tuple[Doubles, Doubles, Doubles]:
        """Vertices (B, 778, 3), joints (B, 16, 3) and `_levers` [m]."""
        rest = self._template + self._shapes @ shape
        joints = self._joints_of @ rest
        bent = (turns[:, 1:] - np.eye(3)).reshape(len(turns), -1)
        shaped = rest + np.einsum("vip,bp->bvi", self._posed_by, bent)
        worlds, places = turns.copy(), np.empty((*turns.shape[:2], 3))
        places[:, 0] = joints[0] + move
        for joint, parent in list(enumerate(self._parents))[1:]:
            worlds[:, joint] = worlds[:, parent] @ turns[:, joint]
            places[:, joint] = places[:, parent] + worlds[:, parent] @ (joints[joint] - joints[parent])
        moved = (shaped[:, None] - joints[:, None]) @ np.swapaxes(worlds, 2, 3) + places[:, :, None]
        moved *= self._weights.T[:, :, None]
        return moved.sum(axis=1), places, self._levers(moved, places)

    def _levers(self, moved: Doubles, places: Doubles) -> Doubles:
        """Arms (B, 16, 799, 3) at which joints turn vertices, moved by each joint, and keypoints [m]."""
        of_vertices = (self._below @ moved.reshape(*moved.shape[:2], -1)).reshape(moved.shape)
        of_vertices -= (self._below @ self._weights.T)[:, :, None] * places[:, :, None]
        of_joints = (places[:, None] - places[:, :, None]) * self._below[..., None]
        of_keypoints = of_joints[:, :, self._keypoints]
        of_keypoints[:, :, self._keypoints < 0] = of_vertices[:, :, self._tips]
        return np.concatenate([of_vertices, of_keypoints], axis=2)

    def _points(self, turns: Doubles, shape: Doubles, move: Doubles) -> tuple[Doubles, Doubles]:
        """Vertices and keypoints (B, 799, 3), and their levers."""
        vertices, places, levers = self.posed(turns, shape, move)
        keypoints = places[:, self._keypoints]
        keypoints[:, self._keypoints < 0] = vertices[:, self._tips]
        return np.concatenate([vertices, keypoints], axis=1), levers

    def step(
        self,
        turns: Doubles,
        shape: Doubles,
        move: Doubles,
        targets: Doubles,
        weights: Doubles,
        *,
        shapes: bool,
    ) -> tuple[Doubles, Doubles, Doubles]:
        """One Gauss-Newton step of B poses towards targets (B, 799, 3) with weights (B, 799, 3, 3).

        With `shapes`, also of the shape that all poses have.
        """
        points, levers = self._points(turns, shape, move)
        jacobian = np.zeros((*points.shape, 61 if shapes else 51))
        for row, after, last in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # a turn moves points by its cross product
            jacobian[:, :, row, after:48:3] = np.swapaxes(levers[..., last], 1, 2)
            jacobian[:, :, row, last:48:3] = -np.swapaxes(levers[..., after], 1, 2)
            jacobian[:, :, row, 48 + row] = 1.0
        if shapes:
            for number, one in enumerate(np.eye(10)):
                jacobian[..., 51 + number] = self._points(turns, shape + one, move)[0] - points
        weighted = (weights @ jacobian).reshape(len(points), -1, jacobian.shape[-1])
        normal_matrix = np.swapaxes(jacobian.reshape(weighted.shape), 1, 2) @ weighted
        gradient = ((targets - points).reshape(len(points), 1, -1) @ weighted)[:, 0]
        normal_matrix[:, range(51), range(51)] += _DAMPING * len(points[0])
        if not shapes:
            found = np.linalg.solve(normal_matrix, gradient[..., None])[..., 0]
        else:  # poses are eliminated, each by itself, and the shape is common
            to_shape = np.linalg.solve(normal_matrix[:, :51, :51], normal_matrix[:, :51, 51:])
            own = np.linalg.solve(normal_matrix[:, :51, :51], gradient[:, :51, None])[..., 0]
            usual = _SHAPE_COST**2 * len(points[0]) * len(points)
            coupling = normal_matrix[:, 51:, :51]
            left = (normal_matrix[:, 51:, 51:] - coupling @ to_shape).sum(axis=0) + usual * np.eye(10)
            right = (gradient[:, 51:] - np.einsum("bsp,bp->bs", coupling, own)).sum(axis=0)
            change = np.linalg.solve(left, right - usual * shape)
            shape, found = shape + change, own - to_shape @ change
        by = np.asarray(found[:, :48].reshape(-1, 16, 3), dtype=np.float64)
        return self._turned(turns, by), shape, move + found[:, 48:51]

    def _turned(self, turns: Doubles, by: Doubles) -> Doubles:
        """Rotations after each joint has turned about the world's axes by a rotation vector (B, 16, 3)."""
        from scipy.spatial.transform import Rotation

        worlds, turned = turns.copy(), turns.copy()
        small = Rotation.from_rotvec(by.reshape(-1, 3)).as_matrix().reshape(turns.shape)
        for joint, parent in enumerate(self._parents):
            above = worlds[:, parent] if joint else np.eye(3)
            worlds[:, joint] = above @ turns[:, joint]
            turned[:, joint] = np.swapaxes(np.broadcast_to(above, turns[:, joint].shape), 1, 2) @ (
                small[:, joint] @ worlds[:, joint]
            )
        return turned

    def local(self, worlds: Doubles) -> Doubles:
        """Rotations (B, 16, 3, 3) of joints in their parents, from those in the world."""
        above = worlds[:, [0, *self._parents[1:]]].copy()
        above[:, 0] = np.eye(3)
        return np.swapaxes(above, 2, 3) @ worlds


load_mano = functools.lru_cache(maxsize=2)(Mano)


class ManoFit:
    """A person's hand as MANO's: the shape, and the pose of any frame. Left hands are fitted as mirrored."""

    shape: Float[np.ndarray, "10"]
    """MANO's shape."""

    def __init__(self, mano: Mano, model: HandModel) -> None:
        self._mano, self._mirrored = mano, model.shape.side == "left"
        self._model = model = HandModel(model.shape.with_side("right"))
        surface, flat = model.surface, join_qpos(np.zeros((1, 20)))
        normals = vertex_normals(surface.vertices, surface.faces)
        turns, self.shape, move = np.tile(np.eye(3), (1, 16, 1, 1)), np.zeros(10), np.zeros((1, 3))
        targets, weights = np.zeros((1, 799, 3)), np.zeros((1, 799, 3, 3))
        targets[:, 778:], weights[:, 778:] = hand_keypoints(model, flat), np.eye(3)
        for _ in range(_ROUGH):
            turns, self.shape, move = mano.step(turns, self.shape, move, targets, weights, shapes=True)
        weights[:, 778:] *= _KEYPOINT_WEIGHT
        for _ in range(_CLOSE):
            self._attach(mano.posed(turns, self.shape, move)[0][0], normals)
            across = normals[self._nearest][:, :, None] * normals[self._nearest][:, None]
            targets[0, :778] = self._rest
            directions = (1.0 - _SLIDING_WEIGHT) * across + _SLIDING_WEIGHT * np.eye(3)
            weights[0, :778] = self._known[:, None, None] * directions
            turns, self.shape, move = mano.step(turns, self.shape, move, targets, weights, shapes=True)
        self._attach(mano.posed(turns, self.shape, move)[0][0], normals)
        self._flat, self._move = self._worlds(turns), move
        poses = join_qpos(np.stack([np.zeros(20), *(load_gestures()[name] for name in ("relaxed", "fist"))]))
        starts = self._start(poses), self.shape, np.repeat(move, len(poses), axis=0)
        self.shape = self._steps(poses, *starts, _SHAPE_STEPS, shapes=True)[1]

    def _attach(self, vertices: Doubles, normals: Doubles) -> None:
        """Attach MANO's vertices (778, 3) to the skin at rest, where they are nearest."""
        from scipy.spatial import KDTree

        surface = self._model.surface
        skin, shares = surface.vertices, all_weights(surface.bone_indices, surface.bone_weights)[:, _BONES]
        ours = np.hstack([skin, _BONE_DISTANCE * shares])
        theirs = np.hstack([vertices, _BONE_DISTANCE * self._mano._weights])
        self._nearest = KDTree(ours).query(theirs)[1]
        far = np.linalg.norm(vertices - skin[self._nearest], axis=1)
        here = normals[self._nearest]
        self._rest = vertices - ((vertices - skin[self._nearest]) * here).sum(axis=1, keepdims=True) * here
        self._known = (far < _FARTHEST).astype(np.float64)

    def _worlds(self, turns: Doubles) -> Doubles:
        worlds: Doubles = turns[0].copy()
        for joint, parent in list(enumerate(self._mano._parents))[1:]:
            worlds[joint] = worlds[parent] @ turns[0, joint]
        return worlds

    def _start(self, qpos: Doubles) -> Doubles:
        """Rotations (B, 16, 3, 3) of MANO's joints that turn as our bones do."""
        bones = self._model.forward_kinematics(qpos)[:, _BONES, :3, :3]
        rest = self._model.rest_transforms[_BONES, :3, :3]
        return self._mano.local(bones @ np.swapaxes(rest, 1, 2) @ self._flat)

    def _steps(
        self, qpos: Doubles, turns: Doubles, shape: Doubles, move: Doubles, count: int, *, shapes: bool
    ) -> tuple[Doubles, Doubles, Doubles, Doubles]:
        """Rotations, shape, moves and RMS distances (B,) [m] after some steps from these."""
        surface, model = self._model.surface, self._model
        bones, shares = surface.bone_indices[self._nearest], surface.bone_weights[self._nearest]
        skin = skin_frames(self._rest, bones, shares, model.rest_transforms, model.forward_kinematics(qpos))
        targets = np.concatenate([skin, hand_keypoints(model, qpos)], axis=1)
        known = np.append(self._known, np.full(21, _KEYPOINT_WEIGHT))
        weights = np.broadcast_to(known[:, None, None] * np.eye(3), (len(qpos), 799, 3, 3))
        for _ in range(count):
            turns, shape, move = self._mano.step(turns, shape, move, targets, weights, shapes=shapes)
        off = np.square(self._mano.posed(turns, shape, move)[0] - skin).sum(axis=2)
        return turns, shape, move, np.sqrt(off @ self._known / self._known.sum())

    def records(
        self, qpos: Float[np.ndarray, "B 27"], T_camera_world: Float[np.ndarray, "4 4"]
    ) -> list[dict[str, Any]]:
        """MANO's parameters of poses in a camera's axes, as JSON: docs/formats.md."""
        from scipy.spatial.transform import Rotation

        local = join_qpos(qpos[:, 7:])
        move = np.repeat(self._move, len(qpos), axis=0)
        start = self._start(local)
        turns, _, move, off = self._steps(local, start, self.shape, move, _POSE_STEPS, shapes=False)
        into = T_camera_world[:3, :3] @ quaternion_matrix(qpos[:, 3:7])
        at = qpos[:, :3] @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        if self._mirrored:  # the skin of a right hand, in a picture that is mirrored left to right
            flip = np.diag([-1.0, 1.0, 1.0])
            into, at = flip @ into @ MIRROR, at @ flip
        root = self._mano._joints_of[0] @ (self._mano._template + self._mano._shapes @ self.shape)
        turns[:, 0] = into @ turns[:, 0]
        move = (into @ (root + move)[..., None])[..., 0] + at - root
        vectors = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_rotvec().reshape(-1, 48)
        return [
            {
                "pose": np.round(pose, 6).tolist(),
                "shape": np.round(self.shape, 6).tolist(),
                "translation": np.round(one, 6).tolist(),
                "mirrored": self._mirrored,
                "rms_mm": round(1e3 * float(rms), 3),
            }
            for pose, one, rms in zip(vectors, move, off, strict=True)
        ]


def mano_fit(path: str, shape: HandShape) -> ManoFit:
    """The fit of a file's hand to a person's; cached, because it takes a second or two."""
    return _fit(path, np.array([pack_hand(shape)], HAND_DTYPE).tobytes(), tuple(shape.arch.tolist()))


@functools.lru_cache(maxsize=64)
def _fit(path: str, packed: bytes, arch: tuple[float, float]) -> ManoFit:
    shape = unpack_hand(np.frombuffer(packed, HAND_DTYPE)[0])
    return ManoFit(load_mano(path), HandModel(dataclasses.replace(shape, arch=np.array(arch))))
