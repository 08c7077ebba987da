"""A take: hands in gloves over time, the points that an optical system saw, and the marker of each point.

Simulated captures with their truth, the output of a tracker, and poses of a user's own are all takes.
"""

from __future__ import annotations

import dataclasses
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NoReturn, Self, get_args

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike, NDArray

from gloves.captures.capture import Capture, labeled_columns
from gloves.fit import GlovedHand, GloveFit
from gloves.layout import stored_layout
from gloves.takes.archives import SCHEMA, read_archive, settings_of, write_archive
from gloves.takes.bodies import RigidBody, body_arrays, stored_body
from gloves.takes.motion_formats import MOTION_FORMATS, MotionFormat, motion_format
from gloves.takes.points import (
    FRAMES,
    KEYPOINTS,
    NUMBERS,
    OPTIONAL,
    POINT_COLUMNS,
    POINT_COUNTS,
    POINTS,
    Column,
    PointList,
    Status,
    check_stored,
    fitted,
    spans,
)
from gloves.takes.worn import (
    FORMER,
    FormerHands,
    check_former,
    former_array,
    hand_arrays,
    unpack_former,
    unpack_hands,
)
from handsim._checks import as_numbers, check_choice, check_number, check_type
from handsim._version import full_version
from handsim.cards import card, span_drawing
from handsim.errors import ArgumentError, HandSimWarning, choices
from handsim.files.outputs import check_ending
from handsim.hand.angles import ISB_NAMES, WRIST_NAMES, Convention, isb_angles, wrist_angles
from handsim.hand.model import (
    KEYPOINT_NAMES,
    HandMotion,
    between_poses,
    bridge_gaps,
    check_bounds,
    hand_keypoints,
    is_steady,
    times_at,
)
from handsim.hand.shape import JOINT_NAMES, NUM_JOINTS, NUM_KEYPOINTS, Side
from handsim.motion_files.motion import Motion, PosedBody, PosedHand
from handsim.space.transforms import FORWARD, ForwardAxis, UpAxis, facing, quaternion_matrix, rotated_poses

TRUTH_SUFFIX: Final = ".truth.npz"
"""Ending of the name of a simulated take that lies beside its capture."""
STATUSES: Final = tuple(map(str, Status))
"""Words for the status numbers in files; only a lost hand has no pose."""
LOST, COASTING, INITIALIZED, TRACKED = Status
RATED_FRAMES: Final = 100_000
"""Number of frames of a stream from which its rate is measured."""
HARDLY_SEEN: Final = 0.05
"""A marker that is seen in a smaller share of its hand's frames shows no joint."""
_MAX_LENGTH: Final = 1e9  # [m]
_MAX_TIME: Final = 1e12  # largest time [s] and rate [Hz]; clocks of computers count 2e9 s
_QUATERNION_TOLERANCE: Final = 1e-2  # largest deviation of a quaternion's length from 1; ours deviate by 1e-6
_CHUNK_FRAMES: Final = 4096  # number of frames whose markers are filled in at once
_MAX_BIAS_FRAMES: Final = 2000  # largest number of frames from which marker biases are learned
_MAX_STILL_SPREAD_DEG: Final = 3.0  # largest standard deviation of an angle of a still hand
_MIN_BIAS_FRAMES: Final = 30  # least number of frames with a marker from which its bias is learned


class _NamedAngles(dict[str, Float[np.ndarray, "T"]]):
    """Values of angles by their names; an unknown name is an error in one sentence."""

    def __missing__(self, name: str) -> NoReturn:
        raise ArgumentError(choices(name, self, noun="angle"))


@dataclass(frozen=True, slots=True, eq=False, init=False)
class Take:
    """Hands in motion and labeled points: T frames, H hands, N columns of points, B rigid bodies.

    Labels number the markers of all hands, in the order of `hands`, then those of the bodies. The label -1
    marks a ghost (a point of no marker), or no point at all. `of_truth` and `of_poses` build takes from fewer
    arrays.

    The points are kept in `point_list`. `points`, `ids`, `labels` and `confidence` are tables of them, built
    on first use; these tables may be given instead of the list, or to replace some of its entries
    (`dataclasses.replace(take, labels=...)`).

    Raises:
        ArgumentError: The arrays do not fit together, or a value is out of range; a method is given a hand
            that is not in the take.
    """

    rate: float
    """Frames per second [Hz]; for a stream, the median rate."""
    times: Float[np.ndarray, "T"]
    """Time of each frame [s], increasing."""
    hands: tuple[GloveFit, ...]
    """The hands with their gloves as worn, at most one per side."""
    qpos: Float[np.ndarray, "T H 27"]
    """Wrist position [m], wrist orientation (wxyz), joint angles [rad]; NaN where a hand has no pose."""
    status: Int[np.ndarray, "T H"]
    """The `Status` of each hand, as its number; true poses count as tracked."""
    rms: Float[np.ndarray, "T H"]
    """3D RMS distance of the labeled markers from the pose's [m]; NaN where no pose was fitted."""
    point_list: PointList
    """The observed points, frame by frame, with their IDs, labels and confidence."""
    bodies: tuple[RigidBody, ...]
    """The rigid bodies."""
    body_poses: Float[np.ndarray, "T B 7"]
    """Position [m] and orientation (wxyz) in the world, NaN where a body has no pose."""
    body_status: Int[np.ndarray, "T B"]
    """The `Status` of each rigid body, as its number."""
    body_rms: Float[np.ndarray, "T B"]
    """3D RMS distance of the labeled markers from the pose's [m]; NaN where no pose was fitted."""
    settings: dict[str, Any]
    """Settings that made it, as JSON; for a stream, also the numbers of missing and of left-out frames."""
    former: tuple[FormerHands, ...] = ()
    """The hands of earlier frames where they are not `hands`: of other people, or of another size."""
    numbers: Int[np.ndarray, "T"] | None = None
    """The server's number of each frame of a stream, which shows where frames are missing; None otherwise."""
    angle_spread: Float[np.ndarray, "T H 20"] | None = None
    """Standard deviation of each joint angle [rad]; NaN where a hand has no pose, None if unknown."""
    keypoint_spread: Float[np.ndarray, "T H 21"] | None = None
    """Standard deviation of each keypoint per axis [m]; NaN where a hand has no pose, None if unknown."""
    wrist_spread: Float[np.ndarray, "T H 3"] | None = None
    """Standard deviation of each hand's `WRIST_NAMES` [rad]; NaN where unknown, None without a forearm."""

    def __init__(
        self,
        *,
        rate: float,
        times: ArrayLike,
        hands: Sequence[GloveFit],
        qpos: ArrayLike,
        status: ArrayLike,
        rms: ArrayLike,
        bodies: Sequence[RigidBody],
        body_poses: ArrayLike,
        body_status: ArrayLike,
        body_rms: ArrayLike,
        settings: dict[str, Any],
        former: Sequence[FormerHands] = (),
        point_list: PointList | None = None,
        points: ArrayLike | None = None,
        ids: ArrayLike | None = None,
        labels: ArrayLike | None = None,
        confidence: ArrayLike | None = None,
        numbers: ArrayLike | None = None,
        angle_spread: ArrayLike | None = None,
        keypoint_spread: ArrayLike | None = None,
        wrist_spread: ArrayLike | None = None,
    ) -> None:
        by_frame = dict(times=times, qpos=qpos, status=status, rms=rms, body_poses=body_poses,
                        body_status=body_status, body_rms=body_rms, numbers=numbers,
                        angle_spread=angle_spread, keypoint_spread=keypoint_spread,
                        wrist_spread=wrist_spread)  # fmt: skip
        tables = dict(points=points, ids=ids, labels=labels, confidence=confidence)
        given = {name: table for name, table in tables.items() if table is not None}
        check_type("hands", hands, Sequence, "a list of GloveFits")
        for hand in hands:
            check_type("a hand", hand, GloveFit, "a GloveFit, as attach and nominal_fit return it")
        others = dict(rate=rate, hands=tuple(hands), bodies=tuple(bodies), settings=settings,
                      former=tuple(former))  # fmt: skip
        check_type("the rate [Hz]", rate, (int, float, np.integer, np.floating), "a number")
        for name, value in (*by_frame.items(), *others.items()):
            object.__setattr__(self, name, value)
        try:
            object.__setattr__(self, "rate", float(rate))  # whole numbers and NumPy's are rates, too
            if given or point_list is None:  # all tables, or some that replace those of the list
                point_list = PointList.of_tables(**(point_list.tables if point_list else {}) | given)
            object.__setattr__(self, "point_list", point_list)
            sizes = {"T": len(self.times), "H": len(self.hands), "B": len(self.bodies)}
            for column in (*FRAMES, *self._known()):
                object.__setattr__(self, column.name, fitted(column, getattr(self, column.name), sizes))
            _check_take(self)
        except ValueError as error:
            raise ArgumentError(f"not a take: {error}") from error

    def __repr__(self) -> str:
        """A summary of the take without its arrays."""
        bodies = "".join(f", {body.name}" for body in self.bodies)
        return (
            f"Take({self.num_frames} frames at {self.rate:g} Hz of {', '.join(self.sides)}{bodies}; "
            f"{self.point_list.num_columns} columns of points)"
        )

    def _repr_html_(self) -> str:
        """The card that notebooks show: facts on the take, and the frames in which each hand is tracked."""
        facts = {
            "frames": f"{self.num_frames} at {self.rate:g} Hz, {self.duration:.1f} s",
            "gloves": ", ".join(f"{hand.side} {hand.layout.name}" for hand in self.hands),
            "bodies": ", ".join(body.name for body in self.bodies) or "none",
        }
        return card("Take", facts, span_drawing({side: self.is_tracked(side) for side in self.sides}))

    @property
    def points(self) -> Float[np.ndarray, "T N 3"]:
        """Observed points in the world [m], NaN where a column has no point.

        The columns are the capture's; a stream's points are in the order in which they arrived.
        """
        return self.point_list.tables["points"]

    @property
    def ids(self) -> Int[np.ndarray, "T N"]:
        """The system's ID of each point, -1 where it has none."""
        return self.point_list.tables["ids"]

    @property
    def labels(self) -> Int[np.ndarray, "T N"]:
        """Label of each point, -1 where it has none."""
        return self.point_list.tables["labels"]

    @property
    def confidence(self) -> Float[np.ndarray, "T N"]:
        """Probability that each label is right, or that a point without one is no marker; NaN elsewhere."""
        return self.point_list.tables["confidence"]

    @classmethod
    def of_truth(
        cls,
        hands: Sequence[GloveFit],
        qpos: Float[np.ndarray, "T H 27"],
        points: Float[np.ndarray, "T N 3"],
        ids: Int[np.ndarray, "T N"],
        labels: Int[np.ndarray, "T N"],
        *,
        rate: float,
        bodies: Sequence[RigidBody] = (),
        body_poses: Float[np.ndarray, "T B 7"] | None = None,
        settings: Mapping[str, Any] | None = None,
    ) -> Self:
        """A take whose poses and labels are known: tracked in every frame, with a confidence of 1.

        Args:
            hands: The hands with their gloves as worn.
            qpos: Their poses; NaN where a hand has none.
            points: The observed points in the world [m].
            ids: The system's ID of each point.
            labels: True label of each point, -1 for a ghost.
            rate: Frames per second [Hz].
            bodies: Rigid bodies.
            body_poses: Their positions [m] and orientations (wxyz).
            settings: What made it, as JSON.

        Raises:
            ArgumentError: The arrays do not fit together, or hold what they cannot, such as degrees.
        """
        qpos, points = as_numbers("qpos", qpos), as_numbers("points", points)
        nowhere = np.full((len(points), len(bodies), 7), np.nan)
        poses = nowhere if body_poses is None else as_numbers("body_poses", body_poses)
        check_number("the rate [Hz]", rate, 0.0, above=True)
        take = cls(
            rate=rate,
            times=np.arange(len(qpos)) / rate,
            hands=hands,
            qpos=qpos,
            status=_true_status(qpos),
            rms=np.full(qpos.shape[:2], np.nan),
            points=points,
            ids=ids,
            labels=labels,
            confidence=np.where(np.isfinite(points[..., 0]), 1.0, np.nan),
            bodies=bodies,
            body_poses=poses,
            body_status=_true_status(poses),
            body_rms=np.full(poses.shape[:2], np.nan),
            settings=dict(settings or {}),
        )
        check_bounds(take.qpos)
        return take

    @classmethod
    def of_poses(
        cls,
        hands: Sequence[GloveFit],
        qpos: Float[np.ndarray, "T H 27"],
        *,
        rate: float,
        times: Float[np.ndarray, "T"] | None = None,
        bodies: Sequence[RigidBody] = (),
        body_poses: Float[np.ndarray, "T B 7"] | None = None,
        settings: Mapping[str, Any] | None = None,
    ) -> Self:
        """A take of poses alone, without points.

        The arguments are those of `of_truth`; without `times` [s] frames follow from 0 at the steady rate.

        Raises:
            ArgumentError: The arrays do not fit together, or hold what they cannot.
        """
        qpos = np.atleast_1d(as_numbers("qpos", qpos))
        points, nothing = np.empty((len(qpos), 0, 3)), np.empty((len(qpos), 0), dtype=np.int32)
        take = cls.of_truth(
            hands, qpos, points, nothing, nothing, rate=rate, bodies=bodies, body_poses=body_poses,
            settings=settings,
        )  # fmt: skip
        return take if times is None else dataclasses.replace(take, times=times)

    @property
    def num_frames(self) -> int:
        """Number of frames, T."""
        return len(self.times)

    @property
    def duration(self) -> float:
        """Time from the first frame to the end of the last one [s]."""
        return float(self.times[-1] - self.times[0]) + 1.0 / self.rate

    @property
    def made_by_tracker(self) -> bool:
        """Whether a tracker made the take, so that labels may be wrong."""
        return "tracker" in self.settings

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the twenty joint angles of a hand, in their order in `qpos`."""
        return JOINT_NAMES

    @property
    def keypoint_names(self) -> tuple[str, ...]:
        """Names of the 21 keypoints of a hand, in the order of `keypoints()`."""
        return KEYPOINT_NAMES

    def angles(
        self,
        side: Side,
        *,
        convention: Convention = "model",
        neutral: tuple[float, float] | Take | None = None,
    ) -> dict[str, Float[np.ndarray, "T"]]:
        """The angles of a hand's joints over time [rad], by their names; NaN where it has no pose.

        Args:
            side: The hand.
            convention: `model` for the hinges of the model, `isb` for angles as the ISB writes them, with
                those of wrist and forearm (`WRIST_NAMES`) if the hand's forearm is among the bodies: NaN
                without a neutral pose and without axes of the forearm; pronation also without an elbow.
            neutral: The first and the last time [s] of a pose of which all angles are taken as zero, such as
                the flat hand for a second, or the take of a trial that shows this pose; zero of the
                convention when not given.

        Raises:
            ArgumentError: The hand or the convention is unknown, or no pose is between these times.

        Warns:
            HandSimWarning: The hand moves between these times.
        """
        check_choice(convention, get_args(Convention), noun="convention")
        number = self.hand_index(side)
        angles = self.qpos[:, number, 7:]
        zero = None if neutral is None else self.mean_pose(side, neutral)
        if convention == "isb":
            parts = [isb_angles(hands[number].shape, angles[one], zero) for one, hands in self.worn()]
            found = _NamedAngles(zip(ISB_NAMES, np.concatenate(parts).T, strict=True))
            if (wrist := self.wrist_angles(side, neutral)) is not None:
                found.update(zip(WRIST_NAMES, wrist.T, strict=True))
            return found
        return _NamedAngles(zip(JOINT_NAMES, (angles if zero is None else angles - zero).T, strict=True))

    def forearm_index(self, side: Side) -> int | None:
        """The index of a hand's forearm among the bodies; None if there is none."""
        return next((number for number, body in enumerate(self.bodies) if body.forearm == side), None)

    def elbow_index(self, side: Side) -> int | None:
        """The index of a hand's elbow among the bodies; None if there is none."""
        return next((number for number, body in enumerate(self.bodies) if body.elbow == side), None)

    def wrist_angles(
        self, side: Side, neutral: tuple[float, float] | Take | None
    ) -> Float[np.ndarray, "T 3"] | None:
        """The angles `WRIST_NAMES` of a hand [rad]; None if its forearm is not among the bodies.

        They are NaN where one of two bodies has no pose. The axes of the forearm are those of the hand in the
        neutral pose, in which pronation is zero, else those of the body; if it has none, all are NaN.
        """
        if (body := self.forearm_index(side)) is None:
            return None
        hands, forearms = self.arm_turns(side)
        if neutral is None:
            axes = np.eye(3) if self.bodies[body].has_axes else np.full((3, 3), np.nan)
            return wrist_angles(side, hands @ axes, forearms @ axes)
        take, there = self._neutral_frames(side, neutral)
        axes, held = (_mean_rotation(turns[there]) for turns in take.arm_turns(side))
        zero = wrist_angles(side, np.eye(3)[None], (held @ axes)[None])
        return np.asarray(wrist_angles(side, axes.T @ hands, forearms @ axes) - zero)

    def arm_turns(self, side: Side) -> tuple[Float[np.ndarray, "T 3 3"], Float[np.ndarray, "T 3 3"]]:
        """Rotations of a hand in its forearm's frame, and of this in the elbow's; NaN where unknown."""
        hand = quaternion_matrix(self.qpos[:, self.hand_index(side), 3:7])
        forearm, elbow = (
            np.full_like(hand, np.nan) if body is None else quaternion_matrix(self.body_poses[:, body, 3:])
            for body in (self.forearm_index(side), self.elbow_index(side))
        )
        return forearm.swapaxes(1, 2) @ hand, elbow.swapaxes(1, 2) @ forearm

    def mean_pose(self, side: Side, between: tuple[float, float] | Take) -> Float[np.ndarray, "20"]:
        """The mean joint angles of a hand between two times, or in another take [rad]; warns if it moves."""
        take, there = self._neutral_frames(side, between)
        angles, times = take.qpos[there, take.hand_index(side), 7:], take.times[there]
        spread = np.rad2deg(angles.std(axis=0))
        if spread.max() > _MAX_STILL_SPREAD_DEG:
            joint = f"{JOINT_NAMES[spread.argmax()]} by {spread.max():.1f} degrees (standard deviation)"
            moves = f"the {side} hand moves from {times[0]:g} to {times[-1]:g} s, {joint}"
            warnings.warn(f"{moves}; expected a still pose", HandSimWarning, stacklevel=3)
        return np.asarray(angles.mean(axis=0))

    def _neutral_frames(
        self, side: Side, between: tuple[float, float] | Take
    ) -> tuple[Take, Bool[np.ndarray, "T"]]:
        """The take that shows the neutral pose, this or the given one, and its frames with a tracked hand."""
        if isinstance(between, Take):
            end = float(np.nextafter(between.times[-1], np.inf))  # after the start also of one frame
            return between._neutral_frames(side, (float(between.times[0]), end))
        first, last = between
        if not first < last:
            raise ArgumentError(f"neutral is {first:g} to {last:g} s, expected the earlier time first")
        there = self.is_tracked(side) & (self.times >= first) & (self.times <= last)
        if not there.any():
            raise ArgumentError(
                f"neutral is {first:g} to {last:g} s, where the {side} hand has no pose; expected a part of "
                f"{self.times[0]:g} to {self.times[-1]:g} s in which it is tracked"
            )
        return self, there

    def angle_spreads(self, side: Side) -> dict[str, Float[np.ndarray, "T"]]:
        """The standard deviation of each joint's angle over time [rad]; NaN where it is not known."""
        spread = self.angle_spread
        if spread is None:
            spread = np.full((*self.status.shape, NUM_JOINTS), np.nan, dtype=np.float32)
        found = _NamedAngles(zip(JOINT_NAMES, spread[:, self.hand_index(side)].T, strict=True))
        if self.wrist_spread is not None and self.forearm_index(side) is not None:
            found.update(zip(WRIST_NAMES, self.wrist_spread[:, self.hand_index(side)].T, strict=True))
        return found

    def is_tracked(self, side: Side) -> Bool[np.ndarray, "T"]:
        """Frames in which a hand's pose follows from the points; in the others it coasts or is lost."""
        return np.asarray(self.status[:, self.hand_index(side)] >= INITIALIZED)

    def shown_joints(self, side: Side) -> Bool[np.ndarray, "20"]:
        """Joints of a hand beyond which a marker was seen in some frames; the other angles are guesses.

        All joints count as shown if no tracker made the take, or if the take never shows the hand.
        """
        number, there = self.hand_index(side), np.flatnonzero(self.is_tracked(side))
        if not self.made_by_tracker or not len(there) or not len(self.point_list.points):
            return np.ones(NUM_JOINTS, dtype=np.bool_)
        seen = np.isfinite(self.point_list.labeled(self.hand_labels[number], there)[..., 0])
        return np.asarray(self.hands[number].attachment.beyond @ (seen.mean(axis=0) >= HARDLY_SEEN))

    @property
    def sides(self) -> tuple[Side, ...]:
        """Sides of the hands, in their order."""
        return tuple(hand.side for hand in self.hands)

    @property
    def label_names(self) -> tuple[str, ...]:
        """Name of each label: `right:ThumbTip`, `pen:Pen1`."""
        return label_names(self.hands, self.bodies)

    @property
    def hand_labels(self) -> tuple[range, ...]:
        """The labels of each hand's markers."""
        return spans([hand.layout.num_markers for hand in self.hands])

    def hand_index(self, side: Side) -> int:
        """The index of a hand among the hands."""
        check_choice(side, self.sides, noun="hand")
        return self.sides.index(side)

    def worn(self) -> Iterator[tuple[slice, tuple[GloveFit, ...]]]:
        """Yield the spans of frames with the same hands, in order, each with its hands."""
        first = 0
        for stop, hands in (*(one[:2] for one in self.former), (self.num_frames, self.hands)):
            if stop > first:
                yield slice(first, stop), hands
                first = stop

    def hands_at(self, frame: int) -> tuple[GloveFit, ...]:
        """The hands of a frame with their gloves as worn."""
        return next((one.hands for one in self.former if frame < one.stop), self.hands)

    def worn_at(self, times: Float[np.ndarray, "F"]) -> tuple[tuple[GloveFit, ...], list[FormerHands]]:
        """The last and the former hands of frames at other times [s]; stops count these frames."""
        stops = np.searchsorted(times, [self.times[one.stop] for one in self.former]).tolist()
        worn = [one._replace(stop=stop) for one, stop in zip(self.former, stops, strict=True)]
        last = next((one.hands for one in worn if one.stop >= len(times)), self.hands)
        return last, [one for one in worn if one.stop < len(times)]

    def moving_hands(self) -> tuple[GlovedHand, ...]:
        """Each hand with its poses."""
        return tuple(
            GlovedHand(hand, np.ascontiguousarray(self.qpos[:, number]))
            for number, hand in enumerate(self.hands)
        )

    def observed(self, of: Side | str | range) -> Float[np.ndarray, "T M 3"]:
        """The markers of a hand or a body that were seen [m], NaN for the others.

        Args:
            of: A hand's side, a body's name, or a range of labels.
        """
        if not isinstance(of, range):
            names = [*self.sides, *(body.name for body in self.bodies)]
            check_choice(of, names, noun="hand or body")
            counts = [hand.layout.num_markers for hand in self.hands]
            of = spans([*counts, *(len(body.marker_names) for body in self.bodies)])[names.index(of)]
        return self.point_list.labeled(of)

    def filled(self, side: Side) -> Bool[np.ndarray, "T M"]:
        """Markers of a hand that were not seen in a frame with a pose, so that `markers` computes them."""
        missing = np.isnan(self.observed(side)[..., 0])
        return np.asarray(missing & (self.status[:, self.hand_index(side)] != LOST)[:, None])

    def markers(self, side: Side) -> Float[np.ndarray, "T M 3"]:
        """The markers of a hand [m]: observed or computed from the pose; NaN where the hand has no pose.

        Gloves slip, so the `marker_bias` is subtracted from computed markers.
        """
        number, markers = self.hand_index(side), self.observed(side)
        there = self.status[:, number] != LOST
        filled = np.isnan(markers[..., 0])
        markers[~there] = np.nan
        every = np.flatnonzero(there & filled.any(axis=1))
        markers[every] = np.where(filled[every, :, None], self.pose_markers(side, every), markers[every])
        return markers

    def pose_markers(
        self, side: Side, frames: Int[np.ndarray, "F"] | None = None
    ) -> Float[np.ndarray, "F M 3"]:
        """A hand's markers computed from its pose [m], less their `marker_bias`; NaN without a pose.

        Args:
            side: The hand.
            frames: The frames; all when None.
        """
        if self.former:
            frames = np.arange(self.num_frames) if frames is None else frames
            return np.concatenate([part.pose_markers(side, some) for part, some in self._parts(frames)])
        number, bias = self.hand_index(side), self.marker_bias(side)
        worn, qpos = self.hands[number], self.qpos[:, number]
        qpos = qpos if frames is None else qpos[frames]
        markers = np.full((len(qpos), worn.layout.num_markers, 3), np.nan)
        there = np.flatnonzero(np.isfinite(qpos[:, 0]))
        for first in range(0, len(there), _CHUNK_FRAMES):
            some = there[first : first + _CHUNK_FRAMES]
            bones = worn.model.forward_kinematics(qpos[some])
            rotations = bones[:, worn.attachment.main_bones, :3, :3]
            shifts = np.einsum("tmij,mj->tmi", rotations, bias)
            markers[some] = worn.attachment.centers(worn.model, bones) - shifts
        return markers

    def marker_bias(self, side: Side) -> Float[np.ndarray, "M 3"]:
        """Median of `marker_offsets` of each marker of a hand, in the frame of its bone [m].

        It is learned from frames whose pose was fitted to points, and is 0 if these are few. A tracker fits
        poses to markers with these offsets, so markers that are computed from its poses need them too.
        """
        number = self.hand_index(side)
        fits = np.flatnonzero((self.status[:, number] == TRACKED) & np.isfinite(self.rms[:, number]))
        fits = fits[:: -(-len(fits) // _MAX_BIAS_FRAMES) or 1]
        bias = np.zeros((self.hands[number].layout.num_markers, 3))
        if len(fits) < _MIN_BIAS_FRAMES:
            return bias
        local = self.marker_offsets(side, fits)
        enough = np.isfinite(local[..., 0]).sum(axis=0) >= _MIN_BIAS_FRAMES
        bias[enough] = np.nanmedian(local[:, enough], axis=0)
        return bias

    def marker_offsets(self, side: Side, frames: Int[np.ndarray, "F"]) -> Float[np.ndarray, "F M 3"]:
        """Computed minus observed markers of a hand, in the frames of their bones [m]; NaN if unseen.

        The frames are in increasing order.
        """
        if self.former:
            return np.concatenate([part.marker_offsets(side, some) for part, some in self._parts(frames)])
        number = self.hand_index(side)
        worn, qpos = self.hands[number], self.qpos[frames, number]
        seen = self.point_list.labeled(self.hand_labels[number], frames)
        rotations = worn.model.forward_kinematics(qpos)[:, worn.attachment.main_bones, :3, :3]
        return np.asarray(np.einsum("tmji,tmj->tmi", rotations, worn.markers(qpos)[0] - seen))

    def _parts(self, frames: Int[np.ndarray, "F"]) -> Iterator[tuple[Take, Int[np.ndarray, "K"]]]:
        """Yield each span of `worn` as a take, with the given frames (in increasing order) that it holds."""
        for span, _ in self.worn():
            some = frames[(frames >= span.start) & (frames < span.stop)] - span.start
            yield self.cut(span.start, span.stop), some

    def markers_present(self) -> Bool[np.ndarray, "T M"]:
        """Whether each marker of all hands has a point in each frame."""
        return np.asarray(np.isfinite(self.observed(range(self.hand_labels[-1].stop))[..., 0]))

    def keypoints(self) -> Float[np.ndarray, "T H 21 3"]:
        """Wrists, joints and fingertips in the world [m], named as in `handsim.hand.model.KEYPOINT_NAMES`.

        They are NaN where a hand has no pose.
        """
        return np.concatenate([keypoints_of(hands, self.qpos[frames]) for frames, hands in self.worn()])

    def motion(self, side: Side) -> HandMotion:
        """The motion of a hand, with linear interpolation over the frames where it is lost.

        Before the first pose and after the last one the hand rests; `status` tells which frames are filled.

        Raises:
            ArgumentError: The hand is not in the take, or has no pose in any frame.
        """
        qpos = self.qpos[:, self.hand_index(side)]
        if np.isnan(qpos[:, 0]).all():
            raise ArgumentError(f"the {side} hand has no pose in any frame")
        return bridge_gaps(self.times, qpos, self.rate)

    def poses_alone(self, rate: float | None = None) -> Take:
        """The hands and bodies that have a pose in some frame, without points, resampled if a rate is given.

        Positions and angles are interpolated linearly, rotations along the shortest way. There is no pose
        between two frames of which one has none, or which are more than 0.1 s and 2.5 frames apart.

        Args:
            rate: Frames per second [Hz].

        Raises:
            ArgumentError: No hand has a pose, the rate is not positive, or there would be too many frames.
        """
        times, qpos, poses = self.times, self.qpos, self.body_poses
        if rate is not None:
            times = times_at(self.times, rate)
            qpos = between_poses(self.times, times, qpos, self.rate)
            poses = between_poses(self.times, times, poses, self.rate)
        shown = np.flatnonzero(np.isfinite(qpos[..., 0]).any(axis=0))
        moving = np.flatnonzero(np.isfinite(poses[..., 0]).any(axis=0))
        if not len(shown):
            raise ArgumentError("no hand has a pose in any frame, expected one at least")
        hands, former = self.worn_at(times)
        alone = Take.of_poses(
            [hands[number] for number in shown],
            qpos[:, shown],
            rate=self.rate if rate is None else rate,
            times=times,
            bodies=[self.bodies[number] for number in moving],
            body_poses=poses[:, moving],
            settings=self.settings,
        )
        former = [one._replace(hands=tuple(one.hands[number] for number in shown)) for one in former]
        return dataclasses.replace(alone, former=tuple(former))

    def capture(self) -> Capture:
        """The points without labels, as an optical system exports them: one trajectory per column.

        Frames that a stream lacks are included, without points.

        Raises:
            CaptureError: There are no points.
        """
        names = tuple(f"*{column}" for column in range(self.point_list.num_columns))
        return self._steady(Capture(names, self.points, self.rate))

    def labeled_capture(self, *, sides: bool = True) -> Capture:
        """The labeled points, for `write_capture`: one column per marker, then columns of unlabeled points.

        A hand without any label has no columns if the other hand has one. See `capture` for streams.

        Args:
            sides: Whether the names of columns begin with the hand, `right:ThumbTip`; if not, they are
                `ThumbTip`, and no frame may hold two hands.

        Raises:
            CaptureError: There are no points.
        """
        names, labels = self.label_names, self.point_list.labels.astype(np.int64)
        if sides:
            seen = [((labels >= hand.start) & (labels < hand.stop)).any() for hand in self.hand_labels]
            kept = np.ones(len(names), dtype=np.bool_)
            for hand, is_seen in zip(self.hand_labels, seen, strict=True):
                kept[hand.start : hand.stop] = is_seen or not any(seen)
            names = tuple(name for name, keeps in zip(names, kept, strict=True) if keeps)
            columns = np.cumsum(kept) - 1
        else:
            worn = self.hands[0].layout
            names = (*worn.names, *(one.name for one in worn.forearm))
            own = [name for hand in self.hands for name in hand.layout.names]
            own += [name if body.forearm else "" for body in self.bodies for name in body.marker_names]
            columns = np.array([names.index(name) if name in names else -1 for name in own])
        labels = np.where(labels >= 0, columns[labels], -1)
        begins = self.point_list.starts[1:-1]
        frames, rows = (np.split(values, begins) for values in (self.point_list.points, labels))
        return self._steady(labeled_columns(frames, rows, names, self.rate))

    def _steady(self, capture: Capture) -> Capture:
        """Insert empty frames where a stream lacks frames, because marker files have no times."""
        if self.numbers is None:
            return capture
        times_at(self.times, self.rate)  # refuses too many frames
        order = np.arange(self.num_frames)
        places = np.rint((self.times - self.times[0]) * self.rate).astype(np.intp) - order
        places = np.maximum.accumulate(places) + order  # Two late frames must not share a place.
        positions = np.full((places[-1] + 1, *capture.positions.shape[1:]), np.nan)
        positions[places] = capture.positions
        return dataclasses.replace(capture, positions=positions)

    def without_body(self) -> Take:
        """The take without rigid bodies and their points; many optical systems track bodies themselves."""
        return dataclasses.replace(
            self,
            point_list=self.point_list.without(self.point_list.labels >= self.hand_labels[-1].stop),
            bodies=(),
            body_poses=self.body_poses[:, :0],
            body_status=self.body_status[:, :0],
            body_rms=self.body_rms[:, :0],
        )

    def turned(self, turn: Float[np.ndarray, "3 3"]) -> Take:
        """The take after a rotation of its world."""
        points = dataclasses.replace(self.point_list, points=self.point_list.points @ turn.T)
        qpos, poses = rotated_poses(self.qpos, turn), rotated_poses(self.body_poses, turn)
        return dataclasses.replace(self, qpos=qpos, body_poses=poses, point_list=points)

    def cut(self, first: int, last: int) -> Take:
        """The frames from `first` up to, not including, `last`, with their times.

        Raises:
            ArgumentError: The take does not have these frames.
        """
        whole = isinstance(first, int | np.integer) and isinstance(last, int | np.integer)
        if not whole or not 0 <= first < last <= self.num_frames:
            raise ArgumentError(f"frames {first} to {last}, expected a part of 0 to {self.num_frames}")
        parts = {column.name: getattr(self, column.name)[first:last] for column in (*FRAMES, *self._known())}
        ended = [one._replace(stop=one.stop - first) for one in self.former if first < one.stop < last]
        others: dict[str, Any] = {"former": ended, "point_list": self.point_list.cut(first, last)}
        if (worn := next((one for one in self.former if one.stop >= last), None)) is not None:
            settings = {**self.settings, "user": worn.notes, "size_state": ""}
            others |= {"hands": worn.hands, "settings": settings}
        return dataclasses.replace(self, **parts, **others)

    def export(
        self,
        path: str | Path,
        *,
        rate: float | None = None,
        up: UpAxis = "z",
        forward: ForwardAxis | None = None,
        neutral: tuple[float, float] | Take | None = None,
        guesses: bool = False,
    ) -> None:
        """Write the motion for other programs, in a format by the ending of the file name.

        Args:
            path: A .glb (skinned and animated), .bvh, .usda or .usdc, .csv (joint angles and positions),
                .trc (joint positions) or .mot (joint angles for OpenSim) file.
            rate: Frames per second of the file [Hz]; those of the take when not given.
            up: The axis of the take's world that points up.
            forward: Its axis that becomes -z, as in OpenXR, of a file with y up, and y of a .usdc with z up;
                when not given, y if z points up and -z if y does.
            neutral: The first and the last time [s] of a pose in which a table's angles of the ISB are zero,
                or the take of a trial that shows it; see `angles`.
            guesses: Whether a table also has joints that nothing shows, see `shown_joints`.

        Raises:
            ArgumentError: The ending or the axis is unknown, no hand has a pose, or the rate is out of range.
            HandSimError: A package that the format needs is not installed.
            OSError: The file cannot be written.
        """
        check_type("path", path, (str, os.PathLike), "the path of a file")
        check_choice(up, get_args(UpAxis), noun="axis that points up")
        path = Path(path)
        form = motion_format(path)
        if (up != "z" or forward is not None) and form.keeps_axes:
            given = f"up is {up}" if forward is None else f"forward is {forward}"
            raise ArgumentError(
                f"{given} and the file {path}, expected a format with a direction that is up: "
                f"{', '.join(ending for ending, one in MOTION_FORMATS.items() if not one.keeps_axes)}"
            )
        if neutral is not None and not form.keeps_axes:
            raise ArgumentError(
                f"neutral is {neutral} and the file {path}, expected .csv with the ISB's angles"
            )
        take = poses_for(form, self, rate)
        if forward is not None:
            check_choice(forward, FORWARD, noun="axis that points forward")
            take = take.turned(facing(up, forward))
        shown = {} if guesses else {side: self.shown_joints(side) for side in take.sides}
        form.write(path, posed_motion(take, neutral, shown), up)

    def save(self, path: str | Path) -> None:
        """Write the take as an .npz file, whole or not at all, which `load_take` reads.

        The file also holds `keypoints`, for programs that have no model of the hand.

        Raises:
            ArgumentError: The name does not end in .npz, or an array was changed to what no take has.
            OSError: The file cannot be written.
        """
        check_type("path", path, (str, os.PathLike), "the path of a .npz file")
        check_ending(Path(path), ".npz", option="path")
        dataclasses.replace(self)  # checks its arrays, which may have been changed
        points, num_columns = self.point_list.stored()
        arrays = {column.name: getattr(self, column.name) for column in (*FRAMES, *self._known())} | points
        arrays |= {KEYPOINTS.name: self.keypoints(), **worn_arrays(self.hands, self.bodies)}
        if self.former:
            arrays[FORMER] = former_array(self.former, [hand.layout for hand in self.hands])
        header = take_header(self.hands, self.bodies, self.rate, self.settings)
        header["num_columns"] = num_columns
        write_archive(Path(path), header, arrays)

    def _known(self) -> tuple[Column, ...]:
        """The optional columns of this take."""
        return tuple(column for column in OPTIONAL if getattr(self, column.name) is not None)


def _mean_rotation(turns: Float[np.ndarray, "K 3 3"]) -> Float[np.ndarray, "3 3"]:
    """The mean of the known rotations; NaN if none is known."""
    from scipy.spatial.transform import Rotation

    known = turns[np.isfinite(turns[:, 0, 0])]
    return Rotation.from_matrix(known).mean().as_matrix() if len(known) else np.full((3, 3), np.nan)


def poses_for(form: MotionFormat, take: Take, rate: float | None) -> Take:
    """The poses of a take that a format writes, at a rate if given."""
    poses = take.poses_alone(rate)
    return poses.poses_alone(poses.rate) if form.steady and not is_steady(poses.times, poses.rate) else poses


def posed_motion(
    take: Take,
    neutral: tuple[float, float] | Take | None = None,
    shown: Mapping[Side, Bool[np.ndarray, "20"]] = MappingProxyType({}),
) -> Motion:
    """The hands and bodies of a take for writers of motion files; each has a pose in some frame."""
    zeros = [None if neutral is None else take.mean_pose(side, neutral) for side in take.sides]
    hands = [
        PosedHand.of(
            hand.model, take.qpos[:, n], zeros[n], [(one.stop, one.hands[n].model) for one in take.former]
        )._replace(shown=shown.get(hand.side), wrist=take.wrist_angles(hand.side, neutral))
        for n, hand in enumerate(take.hands)
    ]
    bodies = [PosedBody.of(one.name, one.shape, take.body_poses[:, n]) for n, one in enumerate(take.bodies)]
    for number, body in enumerate(take.bodies):
        if body.has_axes and body.forearm in take.sides:
            bodies[number] = bodies[number].as_forearm(hands[take.hand_index(body.forearm)], body.markers)
    return Motion(take.rate, take.times, hands, bodies)


def load_take(path: str | Path) -> Take:
    """Read a take that `handsim simulate`, `handsim track` or `Take.save` wrote; nothing is unpickled.

    The `.npz.part` of a live recording that was cut off, or is still running, is read up to its last whole
    half second; a `CutOffWarning` says so.

    Args:
        path: The file.

    Returns:
        Times (T,) [s], poses (T, H, 27) [m, rad], points (T, N, 3) [m] and their labels (T, N).

    Raises:
        ArgumentError: `path` is not a path.
        CaptureError: The file is missing, damaged, or of another kind or schema.
    """
    check_type("path", path, (str, Path), "the path of a take")
    return read_archive(path, unpack_take)


def label_names(hands: Sequence[GloveFit], bodies: Sequence[RigidBody]) -> tuple[str, ...]:
    """Name of each label of these hands and bodies: `right:ThumbTip`, `pen:Pen1`."""
    worn = [f"{hand.side}:{name}" for hand in hands for name in hand.layout.names]
    return (*worn, *(f"{body.name}:{name}" for body in bodies for name in body.marker_names))


def keypoints_of(
    hands: Sequence[GloveFit], qpos: Float[np.ndarray, "T H 27"]
) -> Float[np.ndarray, "T H 21 3"]:
    """Keypoints in the world [m] of poses of each hand; NaN where a pose is NaN."""
    keypoints = np.full((*qpos.shape[:2], NUM_KEYPOINTS, 3), np.nan)
    for index, hand in enumerate(hands):
        there = np.isfinite(qpos[:, index, 0])
        keypoints[there, index] = hand_keypoints(hand.model, qpos[there, index])
    return keypoints


def usual_rate(times: Float[np.ndarray, "T"], numbers: Int[np.ndarray, "T"]) -> float:
    """Median rate of the first frames of a stream [Hz], missing ones included, to seven digits."""
    spans, steps = np.diff(times[:RATED_FRAMES]), np.diff(numbers[:RATED_FRAMES])
    steps[steps <= 0] = 1  # the server began to count anew
    steps //= np.gcd.reduce(steps)  # some servers number every n-th frame
    return float(f"{np.median(steps / spans):.7g}")


def take_header(
    hands: Sequence[GloveFit], bodies: Sequence[RigidBody], rate: float | None, settings: Mapping[str, Any]
) -> dict[str, Any]:
    """The header of a file, as JSON; a growing recording has no rate yet."""
    return {
        "kind": "take",
        "schema": SCHEMA,
        "handsim": full_version(),
        "units": "metres, radians, seconds, wxyz, world frame",
        "rate": rate,
        "layouts": [hand.layout.record() for hand in hands],
        "statuses": STATUSES,
        "keypoint_names": KEYPOINT_NAMES,
        "bodies": [body.record() for body in bodies],
        "settings": settings,
    }


def worn_arrays(hands: Sequence[GloveFit], bodies: Sequence[RigidBody]) -> dict[str, NDArray[Any]]:
    """The arrays of a file that have no frames: hands, gloves and the bodies' markers."""
    return hand_arrays(hands) | body_arrays(bodies)


def unpack_take(header: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Take:
    """Build a take from the header and the arrays of a file; any exception means that the file is damaged."""
    if tuple(header["statuses"]) != STATUSES:
        raise ValueError("other statuses")
    layouts = [stored_layout(layout) for layout in header["layouts"]]
    named = header["bodies"]
    counts = [layout.num_markers for layout in layouts], [len(one["marker_names"]) for one in named]
    if POINT_COUNTS.name not in arrays:  # until schema 3 points were tables
        tables = {column.name: arrays[column.name] for column in POINTS}
        listed, header["num_columns"] = PointList.of_tables(**tables).stored()
        arrays.update(listed)
    sizes = {"T": len(arrays["times"]), "P": len(arrays["ids"]), "H": len(layouts), "B": len(named)}
    check_stored(arrays, sizes | {"M": sum(counts[0]), "Q": sum(counts[1])})
    bodies = tuple(
        stored_body(number, one, span, arrays)
        for number, (one, span) in enumerate(zip(named, spans(counts[1]), strict=True))
    )
    counted, entries = arrays[POINT_COUNTS.name], {column.name: arrays[column.name] for column in POINTS}
    if header.get("num_columns") is None:  # a stream
        points = PointList.in_order(counted, **entries)
    else:
        columns, num_columns = arrays[POINT_COLUMNS.name], int(header["num_columns"])
        points = PointList(counted, **entries, columns=columns, num_columns=num_columns)
    return Take(
        rate=float(header["rate"] or usual_rate(arrays["times"], arrays[NUMBERS.name])),
        hands=unpack_hands(arrays, layouts),
        former=unpack_former(arrays[FORMER], layouts) if FORMER in arrays else (),
        bodies=bodies,
        settings=settings_of(header),
        point_list=points,
        **{column.name: arrays[column.name] for column in FRAMES},
        **{column.name: arrays[column.name] for column in OPTIONAL if column.name in arrays},
    )


def _true_status(poses: NDArray[np.float64]) -> NDArray[np.int8]:
    """Status of true poses: tracked where there is a pose, else lost."""
    return np.where(np.isfinite(poses[..., 0]), TRACKED, LOST).astype(np.int8)


def _check_take(take: Take) -> None:
    """Raise a `ValueError` unless the arrays of a take fit together and are within their ranges."""
    frames = take.num_frames
    if not frames or not take.hands or len(set(take.sides)) < len(take.hands):
        raise ValueError(
            f"{frames} frames of the hands {take.sides}, expected at least one frame and one hand per side"
        )
    if not np.isfinite(take.times).all() or (np.diff(take.times) <= 0).any():
        raise ValueError("times do not increase")
    for status, poses in ((take.status, take.qpos), (take.body_status, take.body_poses)):
        is_lost = (status == LOST)[..., None]
        if not _are_within(status, 0, len(STATUSES) - 1) or (np.isnan(poses) != is_lost).any():
            raise ValueError("a status is unknown, or does not fit its pose")
        _check_range(poses, -_MAX_LENGTH, _MAX_LENGTH)
        if (np.abs(np.linalg.norm(poses[..., 3:7], axis=-1) - 1.0) > _QUATERNION_TOLERANCE).any():
            raise ValueError("an orientation is not a quaternion of unit length")
    check_former(take.former, take.hands, frames)
    points = take.point_list
    if len(points.counts) != frames:
        raise ValueError(f"points of {len(points.counts)} frames, expected {frames}")
    for body in take.bodies:
        _check_range(body.positions, -_MAX_LENGTH, _MAX_LENGTH)
        if body.surface is not None:
            _check_range(body.surface.vertices, -_MAX_LENGTH, _MAX_LENGTH)
    for distances in (take.rms, take.body_rms, take.angle_spread, take.keypoint_spread, take.wrist_spread):
        if distances is not None:
            _check_range(distances, 0.0, _MAX_LENGTH)
    _check_range(take.times, -_MAX_TIME, _MAX_TIME)
    _check_range(np.nan_to_num(take.rate), 1.0 / _MAX_TIME, _MAX_TIME)
    if not _are_within(points.points, -_MAX_LENGTH, _MAX_LENGTH):
        raise ValueError(f"a position is not from {-_MAX_LENGTH:g} to {_MAX_LENGTH:g}")
    _check_range(points.confidence, 0.0, 1.0)
    if not _are_within(points.labels, -1, len(take.label_names) - 1):
        raise ValueError("a label names no marker")


def _check_range(values: NDArray[np.float64], low: float, high: float) -> None:
    """Raise a `ValueError` unless all numbers that are not NaN are within a range."""
    if not (
        np.fmin.reduce(values, axis=None, initial=low) >= low
        and np.fmax.reduce(values, axis=None, initial=high) <= high
    ):
        raise ValueError(f"a number is not from {low:g} to {high:g}")


def _are_within(values: NDArray[Any], low: float, high: float) -> bool:
    return bool(((values >= low) & (values <= high)).all())
