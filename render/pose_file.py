"""Own poses: qpos in an array, an `.npz` or a `.csv`, checked, and whose hands they are."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from handsim.errors import ArgumentError, CaptureError, HandSimError, HandSimWarning, choices
from handsim.files.arrays import read_npz
from handsim.files.inputs import check_regular
from handsim.hand.model import join_qpos
from handsim.hand.shape import (
    HAND_DTYPE,
    NUM_JOINTS,
    NUM_QPOS,
    HandShape,
    Side,
    shape_from_measures,
    unpack_hand,
)
from handsim.motion_files.joint_files import read_joint_csv
from handsim.space.transforms import rotation_quaternions
from poses.shapes.couplings import HIGH, LOW

KEYS: Final = ("qpos", "angles", "T_world_wrist", "times", "person", "hands", "hand_size")
CSV: Final = ".csv"
MOST_PEOPLE: Final = 1_000_000
_MOST_FRAMES: Final = 10_000_000
_FARTHEST: Final = 50.0  # [m] of a wrist from the origin
_BEYOND: Final = np.deg2rad(10.0)  # out of a joint's range that is told


class OwnPoses(NamedTuple):
    """Poses that a user made: T frames, H hands."""

    qpos: Float[np.ndarray, "T H 27"]
    """Wrist position [m], wrist orientation (wxyz), joint angles [rad]; NaN where a hand is not there."""
    times: Float[np.ndarray, "T"] | None = None
    """Increasing [s]; None for poses that are no motion."""
    person: Int[np.ndarray, "T"] | None = None
    """Who is in each frame; None where the poses do not say."""
    shapes: tuple[HandShape, ...] | None = None
    """Hands of the people; None where the poses do not say."""


def read_pose_file(path: Path, sides: Sequence[Side] | None = None) -> tuple[OwnPoses, tuple[Side, ...]]:
    """Poses of an `.npz` that `numpy.savez` wrote, or of a `.csv` of `handsim export`; and whose they are.

    docs/rendering.md has the arrays, docs/motion_files.md the columns.

    Args:
        path: The file; nothing in it is unpickled.
        sides: Whose poses an `.npz` has, in its order, a right hand's when not given; or which are read of a
            `.csv`, all when not given.
    """
    if path.suffix.lower() == CSV:
        arrays, sides = _columns(path, sides)
    else:
        arrays, sides = _arrays(path), tuple(sides or ("right",))
    try:
        qpos = _stored_qpos(arrays, len(sides))
        times = _times(arrays, len(qpos))
        shapes = _stored_shapes(arrays)
        person = _person(arrays, len(qpos), shapes)
    except HandSimError as error:
        raise CaptureError(f"{path}: {error}") from error
    _tell_beyond(str(path), qpos)
    return OwnPoses(qpos, times, person, shapes), sides


def _columns(path: Path, sides: Sequence[Side] | None) -> tuple[dict[str, NDArray[Any]], tuple[Side, ...]]:
    """A table's poses and times, as the arrays of an `.npz` of these hands."""
    table = read_joint_csv(path)
    chosen = tuple(sides or table.sides)
    for side in chosen:
        if side not in table.sides:
            raise CaptureError(f"{path}: {choices(side, table.sides, noun='hand')}")
    qpos = table.qpos[:, [table.sides.index(side) for side in chosen]]
    return {"qpos": qpos, "times": table.times}, chosen


def check_poses(
    qpos: NDArray[Any],
    num_hands: int,
    *,
    times: NDArray[Any] | None = None,
    person: NDArray[Any] | None = None,
    shapes: tuple[HandShape, ...] | None = None,
) -> OwnPoses:
    """A user's arrays as poses: (T, 27), (T, H, 27), or (T, 20) without wrists, [m, rad].

    Times (T,) increase [s], and poses are no motion without them; `person` (T,) is who is in each frame.

    Raises:
        ArgumentError: An array has another shape or impossible numbers, or there is no hand in any frame.
    """
    arrays = {"qpos": np.asarray(qpos)}
    if num_hands == 1 and arrays["qpos"].ndim == 2 and arrays["qpos"].shape[1] == NUM_JOINTS:
        arrays["qpos"] = join_qpos(arrays["qpos"])
    arrays |= {} if times is None else {"times": np.asarray(times)}
    arrays |= {} if person is None else {"person": np.asarray(person)}
    whole = _stored_qpos(arrays, num_hands)
    _tell_beyond("poses", whole)
    return OwnPoses(whole, _times(arrays, len(whole)), _person(arrays, len(whole), shapes), shapes)


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    check_regular(path, error=CaptureError)
    try:
        arrays = read_npz(path)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise CaptureError(f"{path}: not an .npz of plain arrays, or a damaged one") from error
    for name in arrays:
        if name not in KEYS:
            raise CaptureError(f"{path}: {choices(name, KEYS, noun='array')}")
    return arrays


def _stored_qpos(arrays: Mapping[str, NDArray[Any]], count: int) -> Float[np.ndarray, "T H 27"]:
    if ("qpos" in arrays) == ("angles" in arrays) or ("angles" in arrays) != ("T_world_wrist" in arrays):
        raise ArgumentError(
            f"it holds {', '.join(arrays) or 'nothing'}, expected qpos, or angles and T_world_wrist"
        )
    if "qpos" in arrays:
        qpos = _floats(arrays, "qpos", (count, NUM_QPOS))
        lost = np.asarray(np.isnan(qpos).any(axis=-1))
        _check_unit_quaternions(qpos[..., 3:7], lost)
    else:
        angles, wrist = _floats(arrays, "angles", (count, NUM_JOINTS)), _wrists(arrays, count)
        if len(angles) != len(wrist):
            raise ArgumentError(f"angles has {len(angles)} frames and T_world_wrist {len(wrist)}")
        lost = np.asarray(np.isnan(angles).any(axis=-1) | np.isnan(wrist).any(axis=(-2, -1)))
        turned = rotation_quaternions(
            np.where(lost[..., None, None], np.eye(3), wrist[..., :3, :3]).reshape(-1, 3, 3)
        )
        qpos = np.concatenate([wrist[..., :3, 3], turned.reshape(*lost.shape, 4), angles], axis=-1)
    qpos[lost] = np.nan
    if lost.all():
        raise ArgumentError("there is no hand in any frame, expected one to draw")
    _check_bounds(qpos)
    qpos[..., 3:7] /= np.linalg.norm(qpos[..., 3:7], axis=-1, keepdims=True)
    return qpos


def _floats(arrays: Mapping[str, NDArray[Any]], name: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """An array (T, ...) or, for one hand, (T, ...) without the axis of hands; NaN is allowed."""
    given = arrays[name]
    if given.dtype.kind not in "fiu":
        raise ArgumentError(f"{name} is of type {given.dtype}, expected numbers")
    values = given.astype(np.float64)
    if shape[0] == 1 and values.ndim == len(shape):
        values = values[:, None]
    if values.shape[1:] != shape or not 1 <= len(values) <= _MOST_FRAMES:
        hands = "a hand" if shape[0] == 1 else f"{shape[0]} hands"
        expected = ", ".join(map(str, shape))
        raise ArgumentError(f"{name} has shape {given.shape}, expected (T, {expected}) for {hands}")
    if np.isinf(values).any():
        raise ArgumentError(f"{name} holds infinite numbers; a hand that is not there is NaN")
    return values


def _wrists(arrays: Mapping[str, NDArray[Any]], count: int) -> NDArray[np.float64]:
    poses = _floats(arrays, "T_world_wrist", (count, 4, 4))
    rotations = poses[..., :3, :3]
    off = np.abs(rotations @ np.swapaxes(rotations, -1, -2) - np.eye(3)).max(axis=(-2, -1))
    bad = (
        (off > 1e-4)
        | (np.linalg.det(rotations) < 0.0)
        | (poses[..., 3, :] != [0.0, 0.0, 0.0, 1.0]).any(axis=-1)
    )
    bad &= ~np.isnan(poses).any(axis=(-2, -1))
    if bad.any():
        raise ArgumentError(f"T_world_wrist is not a rigid transform in frame {np.argwhere(bad)[0][0]}")
    return poses


def _check_unit_quaternions(quaternions: NDArray[np.float64], lost: NDArray[np.bool_]) -> None:
    lengths = np.where(lost, 1.0, np.linalg.norm(quaternions, axis=-1))
    worst = np.abs(lengths - 1.0).argmax()
    if abs(lengths.flat[worst] - 1.0) > 1e-2:
        raise ArgumentError(
            f"qpos has a quaternion (numbers 3 to 6, wxyz) of length {lengths.flat[worst]:.4g} in frame "
            f"{worst // lengths.shape[1]}, expected 1"
        )


def _check_bounds(qpos: NDArray[np.float64]) -> None:
    farthest, widest = np.nanmax(np.abs(qpos[..., :3])), np.nanmax(np.abs(qpos[..., 7:]))
    if farthest > _FARTHEST:
        raise ArgumentError(
            f"a wrist is {farthest:.4g} m from the origin along an axis, expected at most {_FARTHEST:g}; are "
            "these millimeters?"
        )
    if widest > np.pi:
        raise ArgumentError(
            f"a joint angle is {widest:.4g} rad, expected at most {np.pi:.3f}; are these degrees?"
        )


def _tell_beyond(name: str, qpos: NDArray[np.float64]) -> None:
    angles = qpos[..., 7:]
    beyond = ((angles < LOW - _BEYOND) | (angles > HIGH + _BEYOND)).any(axis=(1, 2))
    if beyond.any():
        told = (
            f"{name}: in {beyond.sum()} of {len(beyond)} frames (the first: {beyond.argmax()}) a joint is "
            "more than 10 degrees beyond its range; they are drawn as they are"
        )
        warnings.warn(told, HandSimWarning, stacklevel=3)


def _times(arrays: Mapping[str, NDArray[Any]], frames: int) -> NDArray[np.float64] | None:
    if "times" not in arrays:
        return None
    times = arrays["times"]
    if times.dtype.kind not in "fiu" or times.shape != (frames,):
        raise ArgumentError(
            f"times is {times.dtype} of shape {times.shape}, expected ({frames},) numbers [s]"
        )
    times = times.astype(np.float64)
    if not np.isfinite(times).all() or (np.diff(times) <= 0.0).any():
        raise ArgumentError("times are not finite and increasing")
    return times if len(times) > 1 else None


def _person(
    arrays: Mapping[str, NDArray[Any]], frames: int, shapes: tuple[HandShape, ...] | None
) -> Int[np.ndarray, "T"] | None:
    """Who is in each frame: told, or a person a frame, or one for all; None where nothing tells."""
    if "person" in arrays:
        person = arrays["person"]
        most = MOST_PEOPLE if shapes is None else len(shapes)
        if person.dtype.kind not in "iu" or person.shape != (frames,):
            raise ArgumentError(
                f"person is {person.dtype} of shape {person.shape}, expected whole numbers ({frames},)"
            )
        if person.min() < 0 or person.max() >= most:
            raise ArgumentError(f"person is {person.min()} to {person.max()}, expected 0 to {most - 1}")
        return person.astype(np.int64)
    if shapes is None:
        return None
    if len(shapes) not in (1, frames):
        raise ArgumentError(
            f"it holds {len(shapes)} hands and {frames} frames, expected one hand, one for each frame, or "
            "the array person that says which"
        )
    return np.arange(frames) if len(shapes) > 1 else np.zeros(frames, dtype=np.int64)


def _stored_shapes(arrays: Mapping[str, NDArray[Any]]) -> tuple[HandShape, ...] | None:
    if "hands" in arrays and "hand_size" in arrays:
        raise ArgumentError("it holds hands and hand_size, expected at most one of them")
    if "hands" in arrays:
        hands = np.atleast_1d(arrays["hands"])
        if hands.dtype != HAND_DTYPE or hands.ndim != 1 or not 1 <= len(hands) <= MOST_PEOPLE:
            raise ArgumentError("hands are not records of handsim.hand.shape.HAND_DTYPE")
        return tuple(unpack_hand(hand) for hand in hands)
    if "hand_size" not in arrays:
        return None
    sizes = arrays["hand_size"]
    if sizes.dtype.kind not in "fiu" or sizes.shape[-1:] != (2,) or sizes.ndim > 2 or not sizes.size:
        raise ArgumentError(f"hand_size has shape {sizes.shape}, expected (P, 2): length and breadth [m]")
    sizes = sizes.reshape(-1, 2).astype(np.float64)
    if not ((sizes > 0.03) & (sizes < 0.35)).all():
        raise ArgumentError("hand_size is not within 0.03 to 0.35, expected length and breadth [m]")
    return tuple(shape_from_measures(float(length), float(breadth)) for length, breadth in sizes)
