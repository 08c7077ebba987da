"""`Subject`: the poses that pictures show, of a take or a user's own, and the people in these poses."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, SupportsIndex

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike, NDArray

from gloves.fit import GloveFit, check_layout, settle_glove
from gloves.layout import MarkerLayout, load_layout
from gloves.takes.take import Take, load_take
from handsim._checks import as_array, as_numbers, check_choice, check_count, check_type
from handsim.errors import ArgumentError, CaptureError, HandSimError, HandSimWarning, choices, errors_of
from handsim.files.arrays import read_npz
from handsim.files.inputs import check_regular, checksum
from handsim.hand.model import HandModel, check_bounds, join_qpos, load_model
from handsim.hand.shape import (
    HAND_DTYPE,
    NUM_JOINTS,
    NUM_QPOS,
    SIDES,
    HandShape,
    Side,
    pack_hand,
    sample_shape,
    shape_from_measures,
    unpack_hand,
)
from handsim.motion_files.motion import read_joint_csv
from handsim.space.transforms import UpAxis, room_axes, rotation_quaternions
from poses.shapes import HIGH, LOW
from render.config import SpawnKey
from render.frames import Doubles, Footage

KEYS: Final = ("qpos", "angles", "T_world_wrist", "times", "person", "hands", "hand_size")
CSV: Final = ".csv"
MOST_PEOPLE: Final = 1_000_000
_MOST_FRAMES: Final = 10_000_000
_RANGE_TOLERANCE: Final = np.deg2rad(10.0)  # angle beyond a joint's range from which on users are warned
_POSE_INTERVAL: Final = 1.0  # time between frames without times, which are poses without a motion [s]


class OwnPoses(NamedTuple):
    """Poses that a user made: T frames, H hands."""

    qpos: Float[np.ndarray, "T H 27"]
    """Wrist position [m], wrist orientation (wxyz), joint angles [rad]; NaN where a hand is absent."""
    times: Float[np.ndarray, "T"] | None = None  # increasing times [s]; None for poses without motion
    person: Int[np.ndarray, "T"] | None = None  # number of the person in each frame; None if not given
    shapes: tuple[HandShape, ...] | None = None  # hands of the people; None if not given


def _own_poses(
    arrays: Mapping[str, NDArray[Any]], num_hands: int, shapes: tuple[HandShape, ...] | None
) -> OwnPoses:
    qpos = _stored_qpos(arrays, num_hands)
    return OwnPoses(qpos, _times(arrays, len(qpos)), _person(arrays, len(qpos), shapes), shapes)


def _read_arrays(path: Path) -> dict[str, NDArray[Any]]:
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
        qpos = _checked_floats(arrays, "qpos", (count, NUM_QPOS))
        lost = np.asarray(np.isnan(qpos).any(axis=-1))
        lengths = np.where(lost, 1.0, np.linalg.norm(qpos[..., 3:7], axis=-1))
        worst = np.abs(lengths - 1.0).argmax()
        if abs(lengths.flat[worst] - 1.0) > 1e-2:
            raise ArgumentError(
                f"qpos has a quaternion (numbers 3 to 6, wxyz) of length {lengths.flat[worst]:.4g} in frame "
                f"{worst // lengths.shape[1]}, expected 1"
            )
    else:
        angles, wrist = _checked_floats(arrays, "angles", (count, NUM_JOINTS)), _checked_wrists(arrays, count)
        if len(angles) != len(wrist):
            raise ArgumentError(f"angles has {len(angles)} frames and T_world_wrist {len(wrist)}")
        lost = np.asarray(np.isnan(angles).any(axis=-1) | np.isnan(wrist).any(axis=(-2, -1)))
        rotations = np.where(lost[..., None, None], np.eye(3), wrist[..., :3, :3]).reshape(-1, 3, 3)
        quaternions = rotation_quaternions(rotations).reshape(*lost.shape, 4)
        qpos = np.concatenate([wrist[..., :3, 3], quaternions, angles], axis=-1)
    qpos[lost] = np.nan
    if lost.all():
        raise ArgumentError("there is no hand in any frame, expected one to draw")
    check_bounds(qpos)
    qpos[..., 3:7] /= np.linalg.norm(qpos[..., 3:7], axis=-1, keepdims=True)
    return qpos


def _checked_floats(arrays: Mapping[str, NDArray[Any]], name: str, shape: tuple[int, ...]) -> Doubles:
    """An array (T, *shape), NaN allowed; for one hand, its axis of hands may be missing."""
    given = values = as_numbers(name, arrays[name]).copy()  # orientations are normalized in place
    if shape[0] == 1 and values.ndim == len(shape):
        values = values[:, None]
    if values.shape[1:] != shape or not 1 <= len(values) <= _MOST_FRAMES:
        hands = "a hand" if shape[0] == 1 else f"{shape[0]} hands"
        expected = ", ".join(map(str, shape))
        raise ArgumentError(f"{name} has shape {given.shape}, expected (T, {expected}) for {hands}")
    if np.isinf(values).any():
        raise ArgumentError(f"{name} holds infinite numbers; an absent hand is NaN")
    return values


def _checked_wrists(arrays: Mapping[str, NDArray[Any]], count: int) -> Doubles:
    poses = _checked_floats(arrays, "T_world_wrist", (count, 4, 4))
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


def _warn_of_ranges(name: str, qpos: Doubles) -> None:
    angles = qpos[..., 7:]
    beyond = ((angles < LOW - _RANGE_TOLERANCE) | (angles > HIGH + _RANGE_TOLERANCE)).any(axis=(1, 2))
    if beyond.any():
        frames = f"{name}: in {beyond.sum()} of {len(beyond)} frames (the first: {beyond.argmax()})"
        range_text = "a joint is more than 10 degrees beyond its range; they are drawn as they are"
        warnings.warn(f"{frames} {range_text}", HandSimWarning, stacklevel=3)


def _times(arrays: Mapping[str, NDArray[Any]], frames: int) -> Doubles | None:
    if "times" not in arrays:
        return None
    times = as_numbers("times", arrays["times"])
    if times.shape != (frames,):
        raise ArgumentError(f"times has shape {times.shape}, expected ({frames},) numbers [s]")
    if not np.isfinite(times).all() or (np.diff(times) <= 0.0).any():
        raise ArgumentError("times are not finite and increasing")
    return times if len(times) > 1 else None


def _person(
    arrays: Mapping[str, NDArray[Any]], frames: int, shapes: tuple[HandShape, ...] | None
) -> Int[np.ndarray, "T"] | None:
    """Number of the person in each frame: as given, the frame's own, or 0; None without people."""
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


Model = HandModel | HandShape | str
"""A hand, or its shape, or the name of its size: XS, S, M, L or XL."""


@dataclass(frozen=True, slots=True, eq=False)
class Cast:
    """People who are drawn in a take's poses instead of its own hands."""

    seed: int  # seed of random hands and skins
    person: Int[np.ndarray, "T"] | None = None
    """Number of the person in each frame; None for another person in every shard."""
    shapes: tuple[HandShape, ...] | None = None  # hands of the people; None for random adults

    def rng(self, person: int) -> np.random.Generator:
        """A generator for a person's skin, the same in all frames."""
        return SpawnKey.PERSON.rng(self.seed, person, 1)

    def hands(self, person: int, worn: Sequence[GloveFit]) -> tuple[GloveFit, ...]:
        """A person's hands, each in a glove of the same layout as the hand of `worn` that it replaces."""
        if self.shapes is not None:
            shape = self.shapes[person if len(self.shapes) > 1 else 0]
        else:
            shape = sample_shape(rng=SpawnKey.PERSON.rng(self.seed, person, 0))
        model = HandModel(shape.with_side("right"))
        return tuple(settle_glove(fit.layout, model).with_side(fit.side) for fit in worn)


@dataclass(frozen=True, slots=True, eq=False)
class Subject:
    """Poses, rigid bodies and people in pictures."""

    take: Take  # poses, rigid bodies, points of the optical system
    name: str  # name in a rendering's settings: that of the file, or a digest of arrays
    cast: Cast | None = None  # people; None if the take's hands are drawn
    is_motion: bool = True  # whether frames follow one another in time
    poses: dict[str, Any] | None = None  # other settings of poses, as JSON; None for a take
    footage: Footage | None = None  # pictures of a camera in the place of drawn colors
    origin: tuple[Path | PoseFile, int] | None = None  # file and seed, from which other processes read it

    def __post_init__(self) -> None:
        if not np.isfinite(self.take.qpos[..., 0]).any():
            raise ArgumentError("there is no hand in any frame, expected one to draw")

    def __reduce_ex__(self, protocol: SupportsIndex) -> Any:
        if self.origin is None:
            return object.__reduce_ex__(self, protocol)
        return _read_in_worker, (*self.origin, self.name)

    def upright(self, up: UpAxis) -> Subject:
        """This subject in a world with z up, if `up` is the axis that points up in the take's own world."""
        if up == "z":
            return self
        return dataclasses.replace(self, take=self.take.turned(room_axes(up)), origin=None)


@dataclass(frozen=True, slots=True)
class PoseFile:
    """A file of poses (.npz or .csv), and what the file does not say of them.

    Raises:
        ArgumentError: A side is unknown or comes twice, or `people` is less than 1.
    """

    path: Path
    sides: tuple[Side, ...] | None = None
    """Which hands the poses of an .npz are of, in the file's order, a right one when None; or which of a
    .csv, which names them, all when None."""
    people: int | None = None
    """People whom the frames are distributed over at random; one for each shard when not given. Not for files
    that say who is in each frame."""
    glove: str = "dense19"
    """Marker layout on the hands, where they wear gloves."""

    def __post_init__(self) -> None:
        sides = ("right",) if self.sides is None else self.sides
        for side in sides:
            check_choice(side, SIDES, noun="hand")
        if not 1 <= len(set(sides)) == len(sides):
            raise ArgumentError(f"hands are {' '.join(sides) or 'none'}, expected right, left or both")
        _check_people(self.people)


def subject_of(
    source: Take | str | Path | PoseFile | Subject | ArrayLike, *, seed: int = 0, **options: Any
) -> Subject:
    """The subject that a user gave, or its file; the options are those of `subject_of_poses`."""
    given = {name: value for name, value in options.items() if value is not None}
    if not isinstance(source, Take | str | Path | PoseFile | Subject):
        return subject_of_poses(source, seed=seed, **given)
    for name in given:
        raise ArgumentError(f"{name} belongs to poses of your own; a take and a file have their own")
    if isinstance(source, Subject):
        return source
    return subject_of_take(source) if isinstance(source, Take) else _read(source, seed)


def _read(source: str | Path | PoseFile, seed: int) -> Subject:
    """A take or poses of a file."""
    if isinstance(source, PoseFile):
        return _load_poses(source, seed)
    path = Path(source)
    if path.suffix.lower() == CSV:
        return _load_poses(PoseFile(path), seed)
    try:
        take = load_take(path)
    except HandSimError as error:
        if not _holds_poses(path):
            raise
        raise CaptureError(
            f"{path}: no take, but poses of your own; give them to --poses, or as a PoseFile"
        ) from error
    with errors_of(path, CaptureError):
        return Subject(take, f"{path.name}, sha256:{checksum(path)}", origin=(path, seed))


@functools.lru_cache(maxsize=1)
def _read_in_worker(source: Path | PoseFile, seed: int, name: str) -> Subject:
    """Read a subject again in a worker process; its name tells the cache whether the file changed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HandSimWarning)  # the main process has warned already
        return _read(source, seed)


def _holds_poses(path: Path) -> bool:
    """Whether the names of a file's arrays are those of hand poses that a user made."""
    try:
        return bool({"qpos", "angles"} & set(_read_arrays(path)))
    except HandSimError:
        return False


def subject_of_take(take: Take) -> Subject:
    """A take in memory."""
    hands = np.array([pack_hand(hand.model.shape) for hand in take.hands], dtype=HAND_DTYPE)
    return Subject(take, _digest(take.times, take.qpos, hands))


def subject_of_poses(
    qpos: ArrayLike,
    *,
    model: Model | tuple[Model, Model] | None = None,
    times: ArrayLike | None = None,
    people: int | Sequence[Model] | None = None,
    person: ArrayLike | None = None,
    glove: MarkerLayout | str = "dense19",
    seed: int = 0,
) -> Subject:
    """A user's own poses."""
    array = as_numbers("qpos", qpos)
    models = models_of(model, 2 if array.ndim == 3 else 1)
    if len(models) == 1 and array.ndim == 2 and array.shape[1] == NUM_JOINTS:
        array = join_qpos(array)
    if model is not None and person is not None and people is None:
        raise ArgumentError("person says who strikes each pose, and the model is one hand; give people")
    if people is not None:
        check_type("people", people, (int, list, tuple), "a number of people, or their hands")
    count = people if isinstance(people, int) else None
    _check_people(count)
    known = () if people is None or isinstance(people, int) else people
    shapes = tuple(load_model(one).shape for one in known) or None
    given = {"qpos": array, "times": times, "person": person}
    arrays = {name: as_array(value, None) for name, value in given.items() if value is not None}
    poses = _own_poses(arrays, len(models), shapes)
    _warn_of_ranges("poses", poses.qpos)
    cast = _cast(poses, count, seed) if model is None or people is not None else None
    hands = [pack_hand(shape) for shape in (*(one.shape for one in models), *(shapes or ()))]
    own = (array for array in (poses.qpos, poses.times, poses.person) if array is not None)
    name, layout = _digest(*own, np.array(hands, dtype=HAND_DTYPE)), load_layout(glove)
    return _posed_subject(name, poses, models, layout, cast, {"people": count, "glove": layout.name})


def _load_poses(file: PoseFile, seed: int) -> Subject:
    """The poses of an `.npz` (docs/rendering.md) or a `.csv` of `handsim export`."""
    path = file.path
    if path.suffix.lower() == CSV:
        table = read_joint_csv(path)
        sides = tuple(file.sides or table.sides)
        for side in sides:
            if side not in table.sides:
                raise CaptureError(f"{path}: {choices(side, table.sides, noun='hand')}")
        qpos = table.qpos[:, [table.sides.index(side) for side in sides]]
        arrays: dict[str, NDArray[Any]] = {"qpos": qpos, "times": table.times}
    else:
        arrays, sides = _read_arrays(path), file.sides or ("right",)
    with errors_of(path, CaptureError):
        poses = _own_poses(arrays, len(sides), _stored_shapes(arrays))
    _warn_of_ranges(str(path), poses.qpos)
    if poses.person is not None and file.people is not None:
        whose = "the hand of one person" if len(poses.shapes or ()) == 1 else "who is in each frame"
        raise CaptureError(f"{path}: the file has {whose}; leave out --people")
    record = {"sha256": checksum(path), "sides": list(sides), "people": file.people, "glove": file.glove}
    models = tuple(HandModel.named("M", side=side) for side in sides)
    cast = _cast(poses, file.people, seed)
    return _posed_subject(path.name, poses, models, load_layout(file.glove), cast, record, (file, seed))


def _cast(poses: OwnPoses, people: int | None, seed: int) -> Cast:
    """The people of poses: as given, distributed over the frames at random, or another in every shard."""
    if people is None or poses.person is not None:
        return Cast(seed, poses.person, poses.shapes)
    return Cast(seed, SpawnKey.PEOPLE_OF_FRAMES.rng(seed).integers(people, size=len(poses.qpos)))


def _posed_subject(
    name: str,
    poses: OwnPoses,
    models: Sequence[HandModel],
    layout: MarkerLayout,
    cast: Cast | None,
    record: dict[str, Any],
    origin: tuple[PoseFile, int] | None = None,
) -> Subject:
    """The subject with these hands, in gloves, in these poses."""
    check_layout(layout)
    shapes = [model.shape for model in models]
    hands = [settle_glove(layout, HandModel(one.with_side("right"))).with_side(one.side) for one in shapes]
    times = _POSE_INTERVAL * np.arange(len(poses.qpos)) if poses.times is None else poses.times
    rate = 1.0 / _POSE_INTERVAL if poses.times is None else 1.0 / max(float(np.median(np.diff(times))), 1e-6)
    take = Take.of_poses(hands, poses.qpos, rate=rate, times=times)
    return Subject(take, name, cast, poses.times is not None, record, origin=origin)


def models_of(model: Model | tuple[Model, Model] | None, num_hands: int) -> tuple[HandModel, ...]:
    """The hands of poses: those given, or a right one, or both."""
    if model is None:
        return tuple(HandModel.named("M", side=side) for side in SIDES[::-1][:num_hands])
    models = tuple(load_model(one) for one in (model if isinstance(model, tuple | list) else (model,)))
    if len(models) == 1 and num_hands == 2:
        other: Side = "left" if models[0].shape.side == "right" else "right"
        models = (models[0], HandModel(models[0].shape.with_side(other)))
    if len(models) != num_hands or len({one.shape.side for one in models}) < len(models):
        sides = " and ".join(one.shape.side for one in models)
        raise ArgumentError(
            f"the models are of {len(models)} hands ({sides}) and the poses of {num_hands}, expected a model "
            "for each, and one hand of each side"
        )
    return models


def _check_people(people: int | None) -> None:
    if people is not None:
        check_count("people", people, 1, MOST_PEOPLE)


def _digest(*arrays: np.ndarray) -> str:
    """A digest of arrays."""
    content = hashlib.sha256()
    for array in arrays:
        content.update(np.ascontiguousarray(array).tobytes())
    return f"sha256:{content.hexdigest()}"
