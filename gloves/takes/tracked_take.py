"""A tracked take: the motion, labels and status that a tracker made of a capture."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import DTypeLike, NDArray

from gloves.attachment import Attachment
from gloves.captures.capture import Capture
from gloves.fit import GloveFit
from gloves.layout import stored_layout
from gloves.takes.archives import (
    check_shapes,
    check_types,
    names_of,
    read_archive,
    settings_of,
    write_archive,
)
from gloves.takes.growing import Column
from handsim.errors import ArgumentError, choices
from handsim.hand.keypoints import KEYPOINT_NAMES, NUM_KEYPOINTS, hand_keypoints
from handsim.hand.model import HandModel
from handsim.hand.motion import HandMotion, bridge_gaps
from handsim.hand.records import HAND_DTYPE, pack_hand, unpack_hand
from handsim.hand.topology import NUM_QPOS, Side

KIND: Final = "tracked take"
SCHEMA: Final = 2
READABLE: Final = (1, SCHEMA)
"""Schema 1 had no joint positions."""
STATUSES: Final = ("lost", "coasting", "found", "tracked")
"""Names of the status numbers as files hold them ("found": initialized); only a lost hand has no pose."""
LOST, COASTING, INITIALIZED, TRACKED = range(4)


@dataclass(frozen=True, slots=True, eq=False)
class MarkedBody:
    """A rigid body with markers of its own."""

    name: str
    marker_names: tuple[str, ...]
    positions: Float[np.ndarray, "Q 3"]
    """Its markers in its own frame [m]."""

    def __post_init__(self) -> None:
        if self.positions.shape != (len(self.marker_names), 3):
            expected = f"({len(self.marker_names)}, 3)"
            raise ArgumentError(
                f"{self.name}: positions has shape {self.positions.shape}, expected {expected}"
            )
        if not all(isinstance(name, str) for name in (self.name, *self.marker_names)):
            raise ArgumentError(f"{self.name!r}: a name is no text, expected text for body and markers")


@dataclass(frozen=True, slots=True, eq=False)
class TrackedTake:
    """Motion, labels and status of every frame; T frames, H hands, M markers, N points, B bodies.

    A label counts through the markers of the hands, in their order, then those of the bodies; -1 is a point
    of none of them, or no point at all.

    Raises:
        ArgumentError: The arrays do not fit together, or hold what they cannot.
    """

    rate: float
    """Frames per second [Hz]; of a stream, the usual one."""
    times: Float[np.ndarray, "T"]
    """Time of each frame [s], increasing."""
    hands: tuple[GloveFit, ...]
    """The tracked hands, at most one per side, with equal numbers of markers."""
    qpos: Float[np.ndarray, "T H 27"]
    """Wrist position [m], wrist orientation (wxyz), joint angles [rad]; NaN where a hand is lost."""
    status: Int[np.ndarray, "T H"]
    """Indices into `STATUSES`."""
    rms: Float[np.ndarray, "T H"]
    """3D RMS distance of the labeled markers from the pose's [m]; NaN without a fit."""
    markers: Float[np.ndarray, "T H M 3"]
    """Markers [m] as seen, or from the pose where `filled`; NaN where a hand is lost."""
    filled: Bool[np.ndarray, "T H M"]
    """Which markers were not seen and come from the pose."""
    points: Float[np.ndarray, "T N 3"]
    """Observed points [m], NaN where a column has no point. The columns are the capture's; a stream's points
    are in the order in which they arrived."""
    ids: Int[np.ndarray, "T N"]
    """The system's ID of each point, -1 where it has none."""
    labels: Int[np.ndarray, "T N"]
    """Label of each point."""
    confidence: Float[np.ndarray, "T N"]
    """Probability of each label, 0 to 1; NaN where there is no point."""
    bodies: tuple[MarkedBody, ...]
    """The tracked rigid bodies."""
    body_poses: Float[np.ndarray, "T B 7"]
    """Position [m] and orientation (wxyz) in the world, NaN where a body is lost."""
    body_status: Int[np.ndarray, "T B"]
    """Indices into `STATUSES`."""
    body_rms: Float[np.ndarray, "T B"]
    """3D RMS distance of the labeled markers from the pose's [m]; NaN without a fit."""
    settings: dict[str, Any]
    """Settings that made it, as JSON; of a stream, also how many frames are missing and were left out."""
    numbers: Int[np.ndarray, "T"] | None = None
    """The server's number of each frame of a stream, which shows where frames are missing; None otherwise."""

    def __post_init__(self) -> None:
        try:
            _check(self)
        except ValueError as error:
            raise ArgumentError(f"not a tracked take: {error}") from error

    @property
    def num_frames(self) -> int:
        """Number of frames, T."""
        return len(self.times)

    @property
    def sides(self) -> tuple[Side, ...]:
        """Sides of the hands, in their order."""
        return tuple(hand.side for hand in self.hands)

    @property
    def label_names(self) -> tuple[str, ...]:
        """Name of each label: `right:ThumbTip`, `pen:Pen1`."""
        return label_names(self.hands, self.bodies)

    def hand(self, side: Side) -> int:
        """The index of a hand among the hands.

        Raises:
            ArgumentError: It was not tracked.
        """
        if side not in self.sides:
            raise ArgumentError(choices(side, self.sides, noun="hand"))
        return self.sides.index(side)

    def observed(self, side: Side) -> Float[np.ndarray, "T M 3"]:
        """The markers of a hand that were seen [m], NaN for the others."""
        hand = self.hand(side)
        return np.where(self.filled[:, hand, :, None], np.nan, self.markers[:, hand])

    def motion(self, side: Side) -> HandMotion:
        """The motion of a hand without gaps: where it is lost, linear from the pose before to the pose after.

        It keeps its first pose before it and its last pose after it; `status` tells which frames are filled.

        Raises:
            ArgumentError: The hand was never tracked.
        """
        qpos = self.qpos[:, self.hand(side)]
        if np.isnan(qpos[:, 0]).all():
            raise ArgumentError(f"the {side} hand has no pose in any frame")
        return bridge_gaps(self.times, qpos, self.rate)

    def keypoints(self) -> Float[np.ndarray, "T H 21 3"]:
        """The wrist, the joints and the tips of the hands in the world [m]; NaN where a hand is lost.

        Their names are `handsim.hand.keypoints.KEYPOINT_NAMES`.
        """
        return keypoints_of(self.hands, self.qpos)

    def capture(self) -> Capture:
        """The points without labels, as an optical system exports them: one trajectory per column."""
        names = tuple(f"*{column}" for column in range(self.points.shape[1]))
        return Capture(names, self.points, self.rate)

    def save(self, path: Path) -> None:
        """Write the take (.npz), whole or not at all; `load_tracked_take` gives the same numbers again.

        The file also holds `keypoints`, for programs that have no model of the hand.

        Raises:
            OSError: The file cannot be written.
        """
        arrays = {name: np.asarray(getattr(self, name), dtype) for name, dtype in _ARRAYS.items()}
        arrays |= {} if self.numbers is None else {NUMBERS: self.numbers}
        arrays |= {KEYPOINTS: self.keypoints(), **worn_arrays(self.hands, self.bodies)}
        header = take_header(self.hands, self.bodies, self.rate, self.settings)
        write_archive(path, KIND, SCHEMA, header, arrays)


def label_names(hands: Sequence[GloveFit], bodies: Sequence[MarkedBody]) -> tuple[str, ...]:
    """Name of each label of these hands and bodies: `right:ThumbTip`, `pen:Pen1`."""
    worn = [f"{hand.side}:{name}" for hand in hands for name in hand.layout.names]
    return (*worn, *(f"{body.name}:{name}" for body in bodies for name in body.marker_names))


def take_header(
    hands: Sequence[GloveFit], bodies: Sequence[MarkedBody], rate: float | None, settings: dict[str, Any]
) -> dict[str, Any]:
    """The header of a file, as JSON; without a rate that of a recording, whose rate is its usual one."""
    return {
        "units": "metres, radians, seconds, wxyz, world frame",
        "rate": rate,
        "layouts": [dataclasses.asdict(hand.layout) for hand in hands],
        "statuses": STATUSES,
        "keypoint_names": KEYPOINT_NAMES,
        "bodies": [{"name": body.name, "marker_names": list(body.marker_names)} for body in bodies],
        "settings": settings,
    }


def worn_arrays(hands: Sequence[GloveFit], bodies: Sequence[MarkedBody]) -> dict[str, NDArray[Any]]:
    """The arrays of a file that are no motion: hands, gloves and the bodies' markers."""
    arrays: dict[str, NDArray[Any]] = {
        "hands": np.array([pack_hand(hand.shape) for hand in hands], dtype=HAND_DTYPE)
    }
    for name in _ATTACHMENT:
        arrays[f"attachment_{name}"] = np.stack([getattr(hand.attachment, name) for hand in hands])
    arrays["body_places"] = np.concatenate([np.zeros((0, 3)), *(body.positions for body in bodies)])
    return arrays


def take_columns(hands: int, markers: int, bodies: int) -> tuple[Column, ...]:
    """The columns of a recording of so many hands, markers of each glove, and bodies."""
    shapes: dict[str, tuple[int, ...]] = {
        "times": (),
        "qpos": (hands, NUM_QPOS),
        "status": (hands,),
        "rms": (hands,),
        "markers": (hands, markers, 3),
        "filled": (hands, markers),
        "body_poses": (bodies, 7),
        "body_status": (bodies,),
        "body_rms": (bodies,),
        "points": (3,),
    }
    missing = {"points": np.nan, "ids": -1, "labels": -1, "confidence": np.nan}
    columns = [
        Column(name, f"<{dtype}", shapes.get(name, ()), missing.get(name)) for name, dtype in _ARRAYS.items()
    ]
    return (*columns, Column(NUMBERS, "<i8", ()), Column(KEYPOINTS, "<f8", (hands, NUM_KEYPOINTS, 3)))


def keypoints_of(
    hands: Sequence[GloveFit], qpos: Float[np.ndarray, "T H 27"]
) -> Float[np.ndarray, "T H 21 3"]:
    """Keypoints in the world [m] of some poses of each hand; NaN where these are."""
    keypoints = np.full((*qpos.shape[:2], NUM_KEYPOINTS, 3), np.nan)
    for index, hand in enumerate(hands):
        there = np.isfinite(qpos[:, index, 0])
        keypoints[there, index] = hand_keypoints(hand.model, qpos[there, index])
    return keypoints


def usual_rate(times: Float[np.ndarray, "T"]) -> float:
    """Frames per second of a stream: the median one of its first quarter of an hour."""
    return 1.0 / float(np.median(np.diff(times[:RATED_FRAMES])))


def load_tracked_take(path: str | Path) -> TrackedTake:
    """Read the `.npz` that `handsim track` or `TrackedTake.save` wrote; nothing is unpickled.

    The `.npz.part` of a live recording that was cut off, or is still running, is read up to its last whole
    half second; a `CutOffWarning` says so.

    Args:
        path: The file.

    Returns:
        Times (T,) [s], poses (T, H, 27) [m, rad], markers (T, H, M, 3) [m] and labels (T, N).

    Raises:
        CaptureError: No such file, of another kind or schema, or damaged.
    """
    return read_archive(path, KIND, READABLE, unpack_take)


NUMBERS: Final = "numbers"
"""The name of the frame numbers, which only the takes of streams have."""
KEYPOINTS: Final = "keypoints"
"""The name of the joint positions, which follow from the poses and are not read."""
RATED_FRAMES: Final = 100_000
"""Frames of a stream that its rate is measured on."""
_ARRAYS: Final = {
    "times": "f8",
    "qpos": "f8",
    "status": "i1",
    "rms": "f8",
    "markers": "f8",
    "filled": "?",
    "points": "f8",
    "ids": "i4",
    "labels": "i2",
    "confidence": "f8",
    "body_poses": "f8",
    "body_status": "i1",
    "body_rms": "f8",
}
"""The fields that a file holds by their names, and their types."""
_ATTACHMENT: Final = ("points", "normals", "bone_indices", "bone_weights")
_TYPES: Final[dict[str, DTypeLike]] = {
    **_ARRAYS,
    NUMBERS: "i8",
    KEYPOINTS: "f8",
    "hands": HAND_DTYPE,
    "body_places": "f8",
    **{f"attachment_{name}": "f8" for name in _ATTACHMENT if name != "bone_indices"},
}
"""The types of the arrays of a file; indices of bones may be of any whole type."""
_LARGEST: Final = 1e9  # [m], of anything


def unpack_take(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> TrackedTake:
    """A take from the header and the arrays of a file; any exception means that they are damaged."""
    check_types(arrays, {**_ARRAYS, "hands": HAND_DTYPE})
    if tuple(header["statuses"]) != STATUSES:
        raise ValueError("other statuses")
    if any(arrays[name].dtype != dtype for name, dtype in _TYPES.items() if name in arrays):
        raise ValueError("numbers of another type")
    if header["schema"] > 1:
        check_shapes([(arrays[KEYPOINTS], (*arrays["qpos"].shape[:2], NUM_KEYPOINTS, 3))])
    hands = []
    worn = zip(*(arrays[f"attachment_{name}"] for name in _ATTACHMENT), strict=True)
    for record, layout, parts in zip(arrays["hands"], header["layouts"], worn, strict=True):
        attachment = Attachment(stored_layout(layout), *parts)
        hands.append(GloveFit(HandModel(unpack_hand(record)), attachment))
    names = [(stored["name"], names_of(stored["marker_names"])) for stored in header["bodies"]]
    positions = np.split(arrays["body_places"], np.cumsum([len(markers) for _, markers in names], dtype=int))
    if len(positions.pop()):
        raise ValueError("positions of markers without a body")
    return TrackedTake(
        rate=usual_rate(arrays["times"]) if header["rate"] is None else float(header["rate"]),
        hands=tuple(hands),
        bodies=tuple(MarkedBody(*name, markers) for name, markers in zip(names, positions, strict=True)),
        settings=settings_of(header),
        numbers=arrays.get(NUMBERS),
        **{name: arrays[name] for name in _ARRAYS},
    )


def _check(take: TrackedTake) -> None:
    """Whether the parts of a tracked take fit together; a `ValueError` says what does not."""
    frames, columns = take.num_frames, take.points.shape[1]
    hands, bodies = len(take.hands), len(take.bodies)
    if not frames or not hands or len(set(take.sides)) < hands:
        raise ValueError(
            f"{frames} frames of the hands {take.sides}, expected at least one frame and one hand per side"
        )
    counts = {hand.layout.num_markers for hand in take.hands}
    if len(counts) > 1:
        raise ValueError("the hands wear gloves with different numbers of markers")
    markers = counts.pop()
    check_shapes(
        [
            (take.times, (frames,)),
            (take.qpos, (frames, hands, NUM_QPOS)),
            (take.status, (frames, hands)),
            (take.rms, (frames, hands)),
            (take.markers, (frames, hands, markers, 3)),
            (take.filled, (frames, hands, markers)),
            (take.points, (frames, columns, 3)),
            *((array, (frames, columns)) for array in (take.ids, take.labels, take.confidence)),
            (take.body_poses, (frames, bodies, 7)),
            (take.body_status, (frames, bodies)),
            (take.body_rms, (frames, bodies)),
            *([] if take.numbers is None else [(take.numbers, (frames,))]),
        ]
    )
    if not 0.0 < take.rate < np.inf or not np.isfinite(take.times).all() or (np.diff(take.times) <= 0).any():
        raise ValueError("the rate is not positive, or times do not increase")
    for status, poses in ((take.status, take.qpos), (take.body_status, take.body_poses)):
        if (
            not _within(status, 0, len(STATUSES) - 1)
            or (np.isnan(poses) != (status == LOST)[..., None]).any()
        ):
            raise ValueError("a status is unknown, or does not fit its pose")
    bodies_markers = [body.positions for body in take.bodies]
    for values in (take.qpos, take.markers, take.points, take.body_poses, *bodies_markers):
        _check_range(values, -_LARGEST, _LARGEST)
    for values in (take.rms, take.body_rms):
        _check_range(values, 0.0, _LARGEST)
    _check_range(take.confidence, 0.0, 1.0)
    if not _within(take.labels, -1, len(take.label_names) - 1):
        raise ValueError("a label names no marker")


def _check_range(values: NDArray[np.float64], low: float, high: float) -> None:
    """Raise a `ValueError` unless all numbers that are not NaN are within a range."""
    if not (
        np.fmin.reduce(values, axis=None, initial=low) >= low
        and np.fmax.reduce(values, axis=None, initial=high) <= high
    ):
        raise ValueError(f"a number is not from {low:g} to {high:g}")


def _within(values: NDArray[Any], low: float, high: float) -> bool:
    return bool(((values >= low) & (values <= high)).all())
