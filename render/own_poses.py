"""`PoseFile`, a user's own poses to be drawn: an `.npz` of qpos, and whose hands they are."""

from __future__ import annotations

import warnings
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves.fit import GlovedHand, attach
from gloves.layout import load_layout
from gloves.takes.take import label_names
from handsim.errors import ArgumentError, CaptureError, HandSimError, HandSimWarning, choices
from handsim.files.arrays import read_npz
from handsim.files.inputs import check_regular
from handsim.hand.model import HandModel
from handsim.hand.records import HAND_DTYPE, unpack_hand
from handsim.hand.shape import HandShape, named_shape, shape_from_measures
from handsim.hand.topology import NUM_JOINTS, NUM_QPOS, SIDES, Side
from handsim.space.transforms import rotation_quaternions
from poses.shapes.couplings import HIGH, LOW
from render.shown_take import Cast, ShownTake

KEYS: Final = ("qpos", "angles", "T_world_wrist", "times", "person", "hands", "hand_size")
_MOST_FRAMES: Final = 10_000_000
_MOST_PEOPLE: Final = 1_000_000
_FARTHEST: Final = 50.0  # [m] of a wrist from the origin
_BEYOND: Final = np.deg2rad(10.0)  # out of a joint's range that is told
_SECOND: Final = 1.0  # [s] between frames without times, which are poses without a motion
_SHAPES: Final = 3  # spawn key of people's shapes and of who is in which frame; `render.session` has others
_DAMAGE: Final = (
    ValueError, KeyError, TypeError, OverflowError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class PoseFile:
    """A file of poses (T, 27) [m, rad], and what the file does not say of them.

    Raises:
        ArgumentError: A side is unknown or comes twice, or `people` is less than 1.
    """

    path: Path
    sides: tuple[Side, ...] = ("right",)
    """Which hands the poses are of, in the file's order."""
    people: int | None = None
    """People whom the frames are distributed over at random; one for each shard when not given. Not for files
    that say who is in each frame."""
    glove: str = "dense19"
    """Marker layout on the hands, where they wear gloves."""

    def __post_init__(self) -> None:
        for side in self.sides:
            if side not in SIDES:
                raise ArgumentError(choices(side, SIDES, noun="hand"))
        if not 1 <= len(set(self.sides)) == len(self.sides):
            raise ArgumentError(f"hands are {' '.join(self.sides) or 'none'}, expected right, left or both")
        if self.people is not None and not 1 <= self.people <= _MOST_PEOPLE:
            raise ArgumentError(f"people is {self.people}, expected 1 to {_MOST_PEOPLE}")


def load_poses(file: PoseFile, *, seed: int = 0) -> ShownTake:
    """Read a file of poses, to be drawn like a take.

    Args:
        file: The file, and whose hands it holds.
        seed: Seed of the people who are not in the file.

    Returns:
        Poses (T, 27) of each hand [m, rad]; `ShownTake.cast` says who is in each frame.

    Raises:
        CaptureError: The file cannot be read, an array has another shape or impossible numbers, or there is
            no hand in any frame; nothing is unpickled.
        LayoutError: The glove is unknown or does not fit.
    """
    arrays = _arrays(file.path)
    try:
        qpos = _qpos(arrays, len(file.sides))
        times = _times(arrays, len(qpos))
        cast = _cast(arrays, file, len(qpos), seed)
    except HandSimError as error:
        raise CaptureError(f"{file.path}: {error}") from error
    _tell_beyond(file.path, qpos)
    layout = load_layout(file.glove)
    model = HandModel(named_shape("M"))
    hands = tuple(
        GlovedHand(attach(layout, model).with_side(side), qpos[:, number])
        for number, side in enumerate(file.sides)
    )
    rate = _SECOND if times is None else 1.0 / max(float(np.median(np.diff(times))), 1e-6)
    return ShownTake(
        rate=rate,
        times=_SECOND * np.arange(len(qpos)) if times is None else times,
        hands=hands,
        bodies=(),
        points=np.empty((len(qpos), 0, 3)),
        labels=np.empty((len(qpos), 0), dtype=np.int64),
        label_names=label_names([hand.fit for hand in hands], ()),
        cast=cast,
        is_motion=times is not None,
    )


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    check_regular(path, error=CaptureError)
    try:
        arrays = read_npz(path)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read: {error.strerror or error}") from error
    except _DAMAGE as error:
        raise CaptureError(f"{path}: not an .npz of plain arrays, or a damaged one") from error
    for name in arrays:
        if name not in KEYS:
            raise CaptureError(f"{path}: {choices(name, KEYS, noun='array')}")
    return arrays


def _qpos(arrays: Mapping[str, NDArray[Any]], count: int) -> Float[np.ndarray, "T H 27"]:
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
        hands = "a hand" if shape[0] == 1 else f"{shape[0]} hands (--hands names them)"
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


def _tell_beyond(path: Path, qpos: NDArray[np.float64]) -> None:
    angles = qpos[..., 7:]
    beyond = ((angles < LOW - _BEYOND) | (angles > HIGH + _BEYOND)).any(axis=(1, 2))
    if beyond.any():
        told = (
            f"{path}: in {beyond.sum()} of {len(beyond)} frames (the first: {beyond.argmax()}) a joint is "
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


def _cast(arrays: Mapping[str, NDArray[Any]], file: PoseFile, frames: int, seed: int) -> Cast:
    shapes = _stored_shapes(arrays)
    given = "person" in arrays or (shapes is not None and len(shapes) > 1)
    if given and file.people is not None:
        raise ArgumentError("the file says who is in each frame; leave out --people")
    if shapes is not None and len(shapes) == 1 and file.people is not None:
        raise ArgumentError("the file has the hand of one person; leave out --people")
    if "person" in arrays:
        return Cast(seed, _stored_people(arrays["person"], frames, shapes), shapes)
    if shapes is None:
        if file.people is None:
            return Cast(seed)
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_SHAPES,)))
        return Cast(seed, rng.integers(file.people, size=frames))
    if len(shapes) not in (1, frames):
        raise ArgumentError(
            f"it holds {len(shapes)} hands and {frames} frames, expected one hand, one for each frame, or "
            "the array person that says which"
        )
    return Cast(seed, np.arange(frames) if len(shapes) > 1 else np.zeros(frames, dtype=np.int64), shapes)


def _stored_people(
    person: NDArray[Any], frames: int, shapes: tuple[HandShape, ...] | None
) -> Int[np.ndarray, "T"]:
    most = _MOST_PEOPLE if shapes is None else len(shapes)
    if person.dtype.kind not in "iu" or person.shape != (frames,):
        raise ArgumentError(
            f"person is {person.dtype} of shape {person.shape}, expected whole numbers ({frames},)"
        )
    if person.min() < 0 or person.max() >= most:
        raise ArgumentError(f"person is {person.min()} to {person.max()}, expected 0 to {most - 1}")
    return person.astype(np.int64)


def _stored_shapes(arrays: Mapping[str, NDArray[Any]]) -> tuple[HandShape, ...] | None:
    if "hands" in arrays and "hand_size" in arrays:
        raise ArgumentError("it holds hands and hand_size, expected at most one of them")
    if "hands" in arrays:
        hands = np.atleast_1d(arrays["hands"])
        if hands.dtype != HAND_DTYPE or hands.ndim != 1 or not 1 <= len(hands) <= _MOST_PEOPLE:
            raise ArgumentError("hands are not records of handsim.hand.records.HAND_DTYPE")
        return tuple(unpack_hand(hand) for hand in hands)
    if "hand_size" not in arrays:
        return None
    sizes = arrays["hand_size"]
    if sizes.dtype.kind != "f" or sizes.shape[-1:] != (2,) or sizes.ndim > 2 or not sizes.size:
        raise ArgumentError(f"hand_size has shape {sizes.shape}, expected (P, 2): length and breadth [m]")
    sizes = sizes.reshape(-1, 2).astype(np.float64)
    if not ((sizes > 0.03) & (sizes < 0.35)).all():
        raise ArgumentError("hand_size is not within 0.03 to 0.35, expected length and breadth [m]")
    return tuple(shape_from_measures(float(length), float(breadth)) for length, breadth in sizes)
