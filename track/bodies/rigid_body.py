"""Rigid bodies with markers, tracked beside the hands: labels of their points, and their pose.

Labels go from frame to frame by ID. A point with a new ID is assigned where the pose predicts a missing
marker. A lost body is searched among all points by the distances between its markers. A body of more than
three markers is initialized from four or more, and tracked by three or more; near its last pose three are
enough.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves.takes.points import Status
from gloves.takes.take import RigidBody
from handsim._checks import check_array
from handsim.errors import ArgumentError
from handsim.space.objects import RigidObject
from track.bodies.constellation import (
    FEWEST,
    assign_by_id,
    assign_remaining,
    fit_inliers,
    predict_pose,
    shift_to_points,
    track_by_ids,
    transform_markers,
    velocity_between,
    write_labels,
    write_transform,
)
from track.bodies.constellation_search import search_constellation

GATE: Final = 0.003
"""Largest distance of a labeled point from its marker [m]: ten times the noise of a good system."""
_TIGHT: Final = 0.001  # [m], the same for points that determine the pose, and in a search
_TIGHTEST: Final = 0.0005  # [m], the same in a search that finds three points, which may fit by chance
_THINNEST: Final = 0.005  # [m] RMS distance of the markers from their best line, at least
_CLOSEST: Final = 2.0 * GATE  # [m]: markers nearer to each other than this could exchange labels
_LONGEST_COAST: Final = 0.026  # [s] without three markers (three frames at 120 Hz), before a body is lost
_VELOCITY_FITS: Final = 5  # consecutive fits from which the velocity is known
_SMOOTHING: Final = 0.4  # weight of the newest velocity; fits to three markers are noisy
_LONGEST_PREDICTION: Final = 0.25  # [s] without a fit, after which the body may be anywhere
_FIRST_RADIUS, _MOST_SPEED = 0.005, 1.5  # [m], [m/s]: search radius without a known velocity
_RADIUS, _MOST_ACCELERATION = 0.002, 30.0  # [m], [m/s^2]: search radius with one
_CONFIDENT_RADIUS: Final = 0.03  # [m]: search radius within which three markers are accepted at once
_MOST_CANDIDATE_MOTION: Final = 0.02  # [m] per frame that a candidate may move before it is accepted
_MOST_POINTS: Final = 250  # in a search: some 30 ms, which grows with their third power
_FARTHEST: Final = 1e3  # [m] from the origin; points beyond are ignored


@dataclass(frozen=True, slots=True, eq=False)
class RigidTemplate(RigidBody):
    """A rigid body whose markers determine its pose: the markers in its own frame.

    Raises:
        ArgumentError: `positions` have another shape, or `template_fault` finds a fault.
    """

    def __post_init__(self) -> None:
        positions = np.array(check_array("positions", self.positions, (len(self.marker_names), 3)), order="C")
        object.__setattr__(self, "positions", positions)
        fault = template_fault(self.name, self.marker_names, positions)
        if fault is not None:
            raise ArgumentError(fault)

    @classmethod
    def of(cls, thing: RigidObject) -> RigidTemplate:
        """The markers of an object.

        Raises:
            ArgumentError: They do not make a rigid body; most objects carry too few.
        """
        return cls(thing.name, thing.marker_names, thing.markers)

    @property
    def distances(self) -> Float[np.ndarray, "Q Q"]:
        """Distances between markers [m]."""
        return _distances_between(self.positions)


def template_fault(
    name: str, marker_names: tuple[str, ...], positions: Float[np.ndarray, "Q 3"]
) -> str | None:
    """Why these markers are not a body that can be tracked, as a sentence; None if they are.

    Args:
        marker_names: Names of its Q markers.
        positions: Markers in the body's frame [m].
    """
    if positions.ndim != 2 or len(positions) < FEWEST:
        return f"{name}: {positions.shape[-2]} markers, expected at least {FEWEST}, which determine a pose"
    if len(set(marker_names)) < len(marker_names):
        return f"{name}: a marker name is there twice: {', '.join(marker_names)}"
    distances = _distances_between(positions)
    apart = distances + np.where(np.eye(len(positions), dtype=bool), np.inf, 0.0)
    if apart.min() < _CLOSEST:
        first, second = (marker_names[i] for i in np.unravel_index(apart.argmin(), apart.shape))
        return (
            f"{name}: {first} and {second} are {1e3 * apart.min():.1f} mm apart, expected at least "
            f"{1e3 * _CLOSEST:.0f} mm"
        )
    off_line = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)[1]
    if off_line < _THINNEST * np.sqrt(len(positions)):
        return f"{name}: its markers lie on one line, expected three that do not"
    order = _symmetry(positions, distances)
    if order is not None:
        moved = [f"{marker_names[i]} at {marker_names[k]}" for i, k in enumerate(order) if i != k]
        return (
            f"{name}: its markers look the same from two sides ({', '.join(moved)}), expected positions "
            "whose distances differ by some millimeters"
        )
    return None


def _distances_between(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    distances: NDArray[np.float64] = np.linalg.norm(positions[:, None] - positions, axis=2)
    return distances


def _symmetry(positions: NDArray[np.float64], distances: NDArray[np.float64]) -> tuple[int, ...] | None:
    """Another order of all markers that fits the body after a rotation, if there is one.

    A part of the markers may still be symmetric; then the body is not found while only these are seen.
    """
    count = len(positions)
    orders: list[tuple[int, ...]] = [()]
    for marker in range(count):  # orders that keep all distances so far
        orders = [
            (*order, to)
            for order in orders
            for to in range(count)
            if to not in order
            and all(abs(distances[marker, k] - distances[to, order[k]]) < 2.0 * _TIGHT for k in range(marker))
        ]
    for order in orders:
        if order != tuple(range(count)):
            agree, _ = fit_inliers(positions, positions, np.array(order), np.empty(7), _TIGHT, _TIGHT)
            if agree == count:  # rotated, not mirrored
                return order
    return None


@dataclass(frozen=True, slots=True, eq=False)
class BodyFrame:
    """Status, pose and labels of a body in one frame."""

    status: Status
    """`found` in the first frame after it was lost, `tracked` from then on, `coasting` for a few frames where
    fewer than three markers are seen and the pose is a prediction, `lost`."""
    T_world_body: Float[np.ndarray, "4 4"] | None
    """The body's frame in the world [m]; None when lost."""
    labels: Int[np.ndarray, "N"]
    """Index of each point's marker in the template, -1 for all others."""
    rms: float
    """RMS distance of the labeled points from their markers [m]; NaN without any."""


class BodyTracker:
    """Tracks one rigid body through a stream of points.

    Args:
        template: The body's markers.
    """

    def __init__(self, template: RigidTemplate) -> None:
        self.template = template
        self._positions, self._distances = template.positions, template.distances
        self._reset()
        for number in range(18):  # loads all kernels before the first frame of a stream
            there = self._positions if number < 17 else self._positions[:0]
            self.step(there, np.arange(len(there)), number / 120.0)
        self._reset()

    def step(self, points: Float[np.ndarray, "N 3"], ids: Int[np.ndarray, "N"], time: float) -> BodyFrame:
        """Track the body in the next frame; any content of a stream ends in a status.

        Args:
            points: All points of the frame [m], in any order, with those of hands and ghosts. Points with
                coordinates that are not finite are ignored.
            ids: The system's ID of each point, negative where it gives none.

        Raises:
            ArgumentError: `points` and `ids` do not fit together.
        """
        # Copies, because a kernel is compiled anew for arrays that are read-only or not contiguous.
        points, ids = np.array(points, dtype=np.float64, order="C"), np.array(ids, dtype=np.int64)
        if points.shape != (len(ids), 3):
            raise ArgumentError(
                f"points have shape {points.shape}, expected ({len(ids)}, 3) for {len(ids)} IDs"
            )
        with np.errstate(invalid="ignore"):
            usable = np.abs(points).max(axis=1, initial=0.0) < _FARTHEST  # which NaN is not
        if usable.all():
            return self._step(points, ids, time)
        frame = self._step(points[usable], ids[usable], time)
        labels = np.full(len(points), -1)
        labels[usable] = frame.labels
        return dataclasses.replace(frame, labels=labels)

    def _step(self, points: NDArray[np.float64], ids: NDArray[np.int64], time: float) -> BodyFrame:
        elapsed = time - self._time
        if self._status != Status.LOST:
            frame = self._track(points, ids, time, elapsed) or self._coast(points, ids, elapsed)
            if frame is not None:
                return frame
            self._lose()
        return self._initialize(points, ids, time, elapsed)

    def _reset(self) -> None:
        self._pose, self._velocity, self._time = np.full(7, np.nan), np.zeros(6), -np.inf  # of the last fit
        self._most_markers, self._fits = 0, 0  # since initialization: most markers in one fit, number of fits
        self._lose()

    def _lose(self) -> None:
        self._status: Status = Status.LOST
        self._last_ids = np.full(len(self._positions), -1)  # IDs of the markers' points in the last frame
        self._candidate, self._confirmed = np.full(7, np.nan), 0

    def _track(
        self, points: NDArray[np.float64], ids: NDArray[np.int64], time: float, elapsed: float
    ) -> BodyFrame | None:
        """The body by the IDs of its points, or near its predicted pose."""
        pose, assignment = np.empty(7), np.empty(len(self._positions), dtype=np.int64)
        count, rms = track_by_ids(
            self._positions, points, ids, self._last_ids, pose, _TIGHT, GATE, assignment
        )
        if count < FEWEST and 0.0 < elapsed <= _LONGEST_PREDICTION:
            predicted = predict_pose(self._pose, self._velocity, elapsed)
            count, rms = self._match(points, predicted, self._search_radius(elapsed), assignment, pose)
        if count < FEWEST:
            return None
        if max(self._most_markers, count) <= FEWEST < len(self._positions):
            # Three points may match three markers by chance: a larger match elsewhere is the body.
            other, other_assignment = np.empty(7), np.empty_like(assignment)
            more, spread = self._match(points, None, np.inf, other_assignment, other)
            if more > FEWEST:
                return self._accept(Status.INITIALIZED, other, spread, other_assignment, ids, time)
        return self._accept(Status.TRACKED, pose, rms, assignment, ids, time)

    def _coast(self, points: NDArray[np.float64], ids: NDArray[np.int64], elapsed: float) -> BodyFrame | None:
        """The body at its predicted pose, for `_LONGEST_COAST` seconds at most."""
        if not 0.0 < elapsed <= _LONGEST_COAST or self._fits < _VELOCITY_FITS:
            return None
        pose = predict_pose(self._pose, self._velocity, elapsed)
        assignment = np.empty(len(self._positions), dtype=np.int64)
        assign_by_id(points, ids, self._last_ids, assignment)
        _, rms = shift_to_points(points, assignment, pose, transform_markers(self._positions, pose), GATE)
        self._status = Status.COASTING
        return self._result(pose, rms, assignment, ids)

    def _initialize(
        self, points: NDArray[np.float64], ids: NDArray[np.int64], time: float, elapsed: float
    ) -> BodyFrame:
        """The body near its predicted pose, or anywhere."""
        pose, assignment = np.empty(7), np.empty(len(self._positions), dtype=np.int64)
        if 0.0 < elapsed <= _LONGEST_PREDICTION:
            radius, predicted = (
                self._search_radius(elapsed),
                predict_pose(self._pose, self._velocity, elapsed),
            )
            count, rms = self._match(points, predicted, radius, assignment, pose)
            if count > FEWEST or (count == FEWEST and radius <= _CONFIDENT_RADIUS):
                return self._accept(Status.INITIALIZED, pose, rms, assignment, ids, time)
        count, rms = self._match(points, None, np.inf, assignment, pose)
        if count >= FEWEST:
            there = transform_markers(self._positions, pose)
            before = transform_markers(self._positions, self._candidate)
            moved = np.linalg.norm(there - before, axis=1).max()
            self._confirmed = self._confirmed + 1 if moved < _MOST_CANDIDATE_MOTION else 1
            self._candidate = pose
            if self._confirmed >= _frames_to_confirm(count, len(self._positions)):
                return self._accept(Status.INITIALIZED, pose, rms, assignment, ids, time)
        else:
            self._confirmed = 0
        return BodyFrame(Status.LOST, None, np.full(len(points), -1), np.nan)

    def _search_radius(self, elapsed: float) -> float:
        """Largest distance of a marker from its predicted position [m]."""
        if self._fits < _VELOCITY_FITS:
            return _FIRST_RADIUS + _MOST_SPEED * elapsed
        return _RADIUS + 0.5 * _MOST_ACCELERATION * elapsed**2

    def _match(
        self,
        points: NDArray[np.float64],
        near: NDArray[np.float64] | None,
        radius: float,
        assignment: NDArray[np.int64],
        pose: NDArray[np.float64],
    ) -> tuple[int, float]:
        """The unique match of the markers within a radius of a pose, or anywhere; fills the last two arrays.

        Returns the number of markers that match, 0 if there is no unique match, and their RMS distance [m].
        """
        if len(points) > _MOST_POINTS:
            return 0, np.nan
        expected = self._positions if near is None else transform_markers(self._positions, near)
        count, _, rival = search_constellation(
            self._positions, self._distances, points, expected, radius, _TIGHT, assignment, pose
        )
        if count < FEWEST or rival >= count:
            return 0, np.nan
        if count == FEWEST:
            kept, _ = fit_inliers(self._positions, points, assignment, pose, _TIGHTEST, _TIGHTEST)
            if kept < FEWEST:
                return 0, np.nan
        return assign_remaining(self._positions, points, assignment, pose, _TIGHT, GATE)

    def _accept(
        self,
        status: Status,
        pose: NDArray[np.float64],
        rms: float,
        assignment: NDArray[np.int64],
        ids: NDArray[np.int64],
        time: float,
    ) -> BodyFrame:
        """Update pose and velocity by a fit."""
        elapsed = time - self._time
        if status == Status.INITIALIZED:
            self._velocity, self._most_markers, self._fits = np.zeros(6), 0, 0
        elif 0.0 < elapsed <= _LONGEST_PREDICTION:
            weight = _SMOOTHING if self._fits > 1 else 1.0
            self._velocity += weight * (velocity_between(self._pose, pose, elapsed) - self._velocity)
        self._fits += 1
        self._pose, self._time, self._status = pose, time, status
        self._most_markers = max(self._most_markers, int((assignment >= 0).sum()))
        return self._result(pose, rms, assignment, ids)

    def _result(
        self, pose: NDArray[np.float64], rms: float, assignment: NDArray[np.int64], ids: NDArray[np.int64]
    ) -> BodyFrame:
        """The result of a fit; the IDs are kept for the next frame."""
        labels, transform = np.full(len(ids), -1), np.eye(4)
        write_labels(assignment, ids, labels, self._last_ids)
        write_transform(pose, transform)
        return BodyFrame(self._status, transform, labels, rms)


def _frames_to_confirm(count: int, markers: int) -> float:
    """Frames that a match of `count` of a body's markers must last before it is accepted without a pose.

    Three markers of a larger body are never accepted: markers on the back of a hand keep their distances for
    minutes, and in up to one of twenty frames some three markers of two hands match three of an object. Four
    match in one of a thousand.
    """
    if count == FEWEST:
        return 10 if markers == FEWEST else np.inf
    return 2 if count == FEWEST + 1 < markers else 1
