"""Rigid bodies with markers, tracked beside the hands: labels of their points, and their poses.

IDs carry labels from frame to frame. A point with a new ID is assigned if it is where the pose predicts a
missing marker. A lost body is searched among all points by the distances between its markers. A body with
more than three markers is initialized with four or more, and tracked with three or more; near its last pose
three suffice for both.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple, cast

import numpy as np
from jaxtyping import Float, Int

from gloves.captures.capture import Capture, check_unit, select_markers
from gloves.takes.bodies import RigidBody
from gloves.takes.points import Status
from handsim._checks import check_array, check_type
from handsim.arrays import Doubles, Integers
from handsim.errors import ArgumentError, CalibrationError, HandSimError, choices, errors_of
from handsim.files.inputs import check_keys, numbers, read_toml, tables_of, text_of, toml_number, toml_string
from handsim.files.outputs import write_text, writing
from handsim.hand.shape import SIDES, Side
from handsim.kernels import move, velocity_of, write_quaternion_matrix
from handsim.space.objects import RigidObject, named_object, object_names
from handsim.space.transforms import quaternion_matrix
from track.bodies.constellation import (
    FEWEST,
    assign_remaining,
    fit_inliers,
    search_constellation,
    track_by_ids,
    transform_markers,
)
from track.frames import StreamedFrame, capture_frames

_LEAST_WIDTH: Final = 0.005  # [m] least RMS distance of the markers from their best line
_LONGEST_COAST: Final = 0.026  # [s] longest prediction (three frames at 120 Hz) without three markers
_VELOCITY_FITS: Final = 5  # The velocity is known after this many consecutive fits.
_VELOCITY_SMOOTHING: Final = 0.4  # weight of the newest velocity; fits to three markers are noisy
_LONGEST_PREDICTION: Final = 0.25  # [s] A body without a fit for longer may be anywhere.
_FIRST_SEARCH_RADIUS, _MOST_SPEED = 0.005, 1.5  # [m], [m/s] search radius and its growth at unknown velocity
# [m], [m/s^2] search radius and its growth at known velocity
_SEARCH_RADIUS, _MOST_ACCELERATION = 0.002, 30.0
_CONFIDENT_RADIUS: Final = 0.03  # [m] largest search radius in which three markers suffice
_WRIST_RADIUS: Final = 0.06
"""A forearm ends this near to its hand's wrist [m]; landmarks may be on a bar across it."""
LEAST_ALIKE: Final = 0.3
"""Least cosine of the angle between the thumb's sides of a hand and its forearm."""
_MOST_CANDIDATE_MOTION: Final = 0.02  # [m] largest motion per frame of an unconfirmed candidate
_MOST_SEARCHED_POINTS: Final = 250  # largest number of points in a search: 30 ms, cubic in it
BODY_SUFFIX: Final = ".toml"
_LimbSides = tuple[Side | None, Side | None]
"""The hands whose forearm and whose elbow a body is."""
_ANY_BODY: Final = "RigidTemplates, names of handsim's objects, or paths of .toml files"
_OPTIONAL: Final = ("description", "forearm", "forearm_axes", "elbow", "marker")
_BODY_KEYS: Final = ("name", *_OPTIONAL)
_MARKER_KEYS: Final = ("name", "place_mm")
_MOST_LEARNED_MARKERS: Final = 20
_COUNT_QUANTILE: Final = 0.9  # This quantile of the frames' numbers of points is the number of markers.
_TEMPLATE_CANDIDATES: Final = 5  # number of frames tried as first template
_AVERAGING_ROUNDS: Final = 3  # rounds of averaging the markers over all frames
_LEAST_SEEN_SHARE: Final = 0.5  # A marker must be seen in this share of the body's frames.
_LEAST_LABELED_SHARE: Final = 0.8  # This share of all points must be the body's.


class _Tolerances(NamedTuple):
    """Largest distances of points from a body's markers [m]."""

    gate: float  # of labeled points
    tight: float  # of the points that a pose is fitted to
    search: float  # in a search
    tightest: float  # in a search that matches three points, maybe by chance
    kept: float  # of points that keep their IDs, from their place or from each other's distances


_RIGID_TOLERANCES: Final = _Tolerances(0.003, 0.001, 0.001, 0.0005, 0.003)
"""Tolerances of objects: ten times the noise of a good system."""
_SKIN_TOLERANCES: Final = _Tolerances(0.005, 0.004, 0.002, 0.001, 0.02)
"""Tolerances of forearms and elbows, whose skin moves markers by 1 to 2 mm, and over muscles by up to 20 mm.
Five markers of a recorded arm, two of them at the epicondyles, are labeled in all frames; with 2 mm as
`tight` and 3 mm as `gate` in 57 % of them. Four markers, one of them over a muscle, are labeled in all
frames; in 75 % if no point is `kept`."""
_LEAST_MARKER_DISTANCE: Final = 2.0 * _RIGID_TOLERANCES.gate  # [m] Closer markers could exchange labels.


@dataclass(frozen=True, slots=True, eq=False)
class RigidTemplate(RigidBody):
    """A rigid body whose markers, in its own frame, determine its pose.

    Raises:
        ArgumentError: `positions` have another shape, or do not determine the pose.
    """

    def __post_init__(self) -> None:
        positions = np.array(check_array("positions", self.positions, (len(self.marker_names), 3)), order="C")
        object.__setattr__(self, "positions", positions)
        RigidBody.__post_init__(self)
        fault = self._fault()
        if fault is not None:
            raise ArgumentError(f"{self.name}: {fault}")

    @classmethod
    def of(cls, thing: RigidObject) -> RigidTemplate:
        """A template with the markers of an object.

        Raises:
            ArgumentError: They do not make a trackable rigid body; most objects carry too few.
        """
        return cls(thing.name, thing.marker_names, thing.markers)

    @property
    def distances(self) -> Float[np.ndarray, "Q Q"]:
        """Distances between markers [m]."""
        return np.asarray(np.linalg.norm(self.positions[:, None] - self.positions, axis=2))

    def _fault(self) -> str | None:
        """Why these markers cannot be tracked as a rigid body; None if they can."""
        positions, marker_names = self.positions, self.marker_names
        if len(positions) < FEWEST:
            return f"{len(positions)} markers, expected at least {FEWEST}, which determine a pose"
        if len(set(marker_names)) < len(marker_names):
            return f"a marker name is there twice: {', '.join(marker_names)}"
        distances = self.distances
        apart = distances + np.where(np.eye(len(positions), dtype=bool), np.inf, 0.0)
        if apart.min() < _LEAST_MARKER_DISTANCE:
            first, second = (marker_names[i] for i in np.unravel_index(apart.argmin(), apart.shape))
            return (
                f"{first} and {second} are {1e3 * apart.min():.1f} mm apart, expected at least "
                f"{1e3 * _LEAST_MARKER_DISTANCE:.0f} mm"
            )
        off_line = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)[1]
        if off_line < _LEAST_WIDTH * np.sqrt(len(positions)):
            return "its markers lie on one line, expected three that do not"
        order = _symmetry(positions, distances)
        if order is not None:
            moved = [f"{marker_names[i]} at {marker_names[k]}" for i, k in enumerate(order) if i != k]
            return (
                f"its markers look the same from two sides ({', '.join(moved)}), expected positions "
                "whose distances differ by some millimeters"
            )
        return None


def _symmetry(positions: Doubles, distances: Doubles) -> tuple[int, ...] | None:
    """Another order of all markers that fits the body after a rotation; None if there is none."""
    count = len(positions)
    orders: list[tuple[int, ...]] = [()]
    for marker in range(count):  # Keep the orders that preserve all distances so far.
        orders = [
            (*order, to)
            for order in orders
            for to in range(count)
            if to not in order
            and all(
                abs(distances[marker, k] - distances[to, order[k]]) < 2.0 * _RIGID_TOLERANCES.tight
                for k in range(marker)
            )
        ]
    for order in orders:
        if order != tuple(range(count)):
            tight = _RIGID_TOLERANCES.tight
            agree, _ = fit_inliers(positions, positions, np.array(order), np.empty(7), tight, tight)
            if agree == count:  # a rotation, not a reflection
                return order
    return None


@dataclass(frozen=True, slots=True, eq=False)
class BodyFrame:
    """Status, pose and labels of a body in one frame."""

    status: Status
    """`found` in the first frame after being lost, then `tracked`; `coasting` for a few frames with fewer
    than three seen markers and a predicted pose; `lost`, where two points may still have labels."""
    T_world_body: Float[np.ndarray, "4 4"] | None  # None when lost; translation in [m]
    labels: Int[np.ndarray, "N"]  # index of each point's marker in the template, -1 for all others
    rms: float  # RMS distance of the labeled points from their markers [m]; NaN without labeled points


class _Match(NamedTuple):
    """Points matched to a body's markers."""

    num_points: int  # 0 if there is no unique match
    rms: float  # their RMS distance from the markers [m]
    pose: Doubles  # pose of the body (7,)
    assignment: Integers  # index of each marker's point, -1 for none


class _Cloud(NamedTuple):
    """The points of a frame."""

    points: Doubles  # positions (N, 3) [m]
    ids: Integers  # the IDs of the camera system (N,)
    time: float  # [s]
    elapsed: float  # time since the last fit [s]


class BodyTracker:
    """Tracks one rigid body through a stream of points."""

    def __init__(self, template: RigidTemplate) -> None:
        self.template = template
        self._positions, self._distances = template.positions, template.distances
        self._tolerances = _SKIN_TOLERANCES if template.forearm or template.elbow else _RIGID_TOLERANCES
        self._reset()
        for number in range(18):  # Compile or load all kernels before the stream's first frame.
            there = self._positions if number < 17 else self._positions[:0]
            self.step(there, np.arange(len(there)), number / 120.0)
        self._reset()

    def step(
        self,
        points: Float[np.ndarray, "N 3"],
        ids: Int[np.ndarray, "N"],
        time: float,
        wrist: Float[np.ndarray, "7"] | None = None,
    ) -> BodyFrame:
        """Track the body among the finite points of the next frame; `wrist` is that of a forearm's hand."""
        # Copy, because read-only or non-contiguous arrays would compile a kernel anew.
        points, ids = np.array(points, dtype=np.float64, order="C"), np.array(ids, dtype=np.int64)
        cloud = _Cloud(points, ids, time, time - self._time)
        if self._status != Status.LOST:
            frame = self._track(cloud) or self._coast(cloud)
            if frame is not None:
                return frame
            self._lose()
        return self._initialize(cloud, self._carried(cloud), wrist)

    def _reset(self) -> None:
        self._pose, self._velocity, self._time = np.full(7, np.nan), np.zeros(6), -np.inf  # of the last fit
        # largest number of markers in a fit, and of fits, since the start
        self._most_markers, self._fits = 0, 0
        self._last_ids = np.full(len(self._positions), -1)  # IDs of the markers' points in the last frame
        self._places = self._positions.copy()  # where each marker was when last kept [m]
        self._lose()

    def _lose(self) -> None:
        self._status: Status = Status.LOST
        self._candidate, self._confirmed = np.full(7, np.nan), 0

    def _track(self, cloud: _Cloud) -> BodyFrame | None:
        """Track the body by the IDs of its points, or near its predicted pose; None if that fails."""
        (points, ids, _, elapsed), (gate, tight, *_) = cloud, self._tolerances
        pose, assignment = self._no_match
        count, rms = track_by_ids(self._positions, points, ids, self._last_ids, pose, tight, gate, assignment)
        match = _Match(count, rms, pose, assignment)
        if count < FEWEST and 0.0 < elapsed <= _LONGEST_PREDICTION:
            match = self._match(points, self._predict(elapsed), self._search_radius(elapsed))
        if match.num_points < FEWEST:
            return None
        if max(self._most_markers, match.num_points) <= FEWEST < len(self._positions):
            # Three points may match three markers by chance: a larger match elsewhere is right.
            other = self._match(points)
            if other.num_points > FEWEST:
                return self._accept(Status.INITIALIZED, other, cloud)
        return self._accept(Status.TRACKED, match, cloud)

    def _coast(self, cloud: _Cloud) -> BodyFrame | None:
        """Predict the body's pose, for at most `_LONGEST_COAST` seconds; None after that."""
        if not 0.0 < cloud.elapsed <= _LONGEST_COAST or self._fits < _VELOCITY_FITS:
            return None
        pose, assignment, rms = self._predict(cloud.elapsed), self._last_points(cloud.ids), np.nan
        seen = np.flatnonzero(assignment >= 0)
        if len(seen):  # One or two points shift the body if they agree with its pose.
            off = cloud.points[assignment[seen]] - transform_markers(self._positions, pose)[seen]
            shift = off.mean(axis=0)
            distances = np.linalg.norm(off - shift, axis=1)
            if max(distances.max(), np.linalg.norm(shift)) <= self._tolerances.gate:
                pose[:3] += shift
                rms = float(np.sqrt((distances**2).mean()))
            else:
                assignment[:] = -1
        self._status = Status.COASTING
        return self._result(_Match(len(seen), rms, pose, assignment), cloud)

    def _last_points(self, ids: Integers) -> Integers:
        """For each marker the index (Q,) of the point with the ID of its last one; -1 where there is none."""
        there = (self._last_ids[:, None] == ids) & (ids >= 0)
        return np.where(there.any(axis=1), there.argmax(axis=1) if len(ids) else -1, -1)

    def _carried(self, cloud: _Cloud) -> Integers:
        """`_last_points` if two or more of them keep their distances, otherwise -1 for all."""
        assignment = self._last_points(cloud.ids)
        seen = np.flatnonzero(assignment >= 0)
        there = cloud.points[assignment[seen]]
        apart = np.linalg.norm(there[:, None] - there, axis=-1) - self._distances[np.ix_(seen, seen)]
        is_kept = len(seen) > 1 and np.abs(apart).max() <= self._tolerances.kept
        return assignment if is_kept else np.full(len(assignment), -1)

    def _initialize(self, cloud: _Cloud, carried: Integers, wrist: Doubles | None) -> BodyFrame:
        """Search the body near its predicted pose, then anywhere.

        `carried` points need no confirmation, and neither does a forearm that ends at its hand's `wrist`.
        """
        if 0.0 < cloud.elapsed <= _LONGEST_PREDICTION:
            radius = self._search_radius(cloud.elapsed)
            match = self._match(cloud.points, self._predict(cloud.elapsed), radius)
            if match.num_points > FEWEST or (match.num_points == FEWEST and radius <= _CONFIDENT_RADIUS):
                return self._accept(Status.INITIALIZED, match, cloud)
        match = self._match(cloud.points)
        if match.num_points >= FEWEST:
            is_known = ((match.assignment == carried) & (carried >= 0)).sum() > 1
            if is_known or (wrist is not None and self._ends_at(wrist, match.pose)):
                return self._accept(Status.INITIALIZED, match, cloud)
            there = transform_markers(self._positions, match.pose)
            before = transform_markers(self._positions, self._candidate)
            moved = np.linalg.norm(there - before, axis=1).max()
            self._confirmed = self._confirmed + 1 if moved < _MOST_CANDIDATE_MOTION else 1
            self._candidate = match.pose
            if self._confirmed >= _frames_to_confirm(match.num_points, len(self._positions)):
                return self._accept(Status.INITIALIZED, match, cloud)
        else:
            self._confirmed = 0
        return BodyFrame(Status.LOST, None, self._labels(carried, cloud.ids), np.nan)

    def _ends_at(self, wrist: Doubles, pose: Doubles) -> bool:
        """Whether the body at a pose is a forearm that ends at a hand's wrist, thumbs' sides alike."""
        if self.template.forearm is None or not self.template.has_axes:
            return False
        thumbs = quaternion_matrix(np.stack([wrist[3:], pose[3:]]))[:, :, 1]
        is_near = np.linalg.norm(wrist[:3] - pose[:3]) < _WRIST_RADIUS
        return bool(is_near and thumbs[0] @ thumbs[1] > LEAST_ALIKE)

    def _predict(self, elapsed: float) -> Doubles:
        """Predict the pose after some time [s] with constant velocity."""
        return move(self._pose[None], elapsed * self._velocity[None])[0]  # type: ignore[no-any-return]

    def _search_radius(self, elapsed: float) -> float:
        """Largest expected distance of a marker from its predicted position [m]."""
        if self._fits < _VELOCITY_FITS:
            return _FIRST_SEARCH_RADIUS + _MOST_SPEED * elapsed
        return _SEARCH_RADIUS + 0.5 * _MOST_ACCELERATION * elapsed**2

    def _match(self, points: Doubles, near: Doubles | None = None, radius: float = np.inf) -> _Match:
        """The unique match of the markers, within a radius [m] of a pose or anywhere."""
        gate, tight, search, tightest, _ = self._tolerances
        pose, assignment = self._no_match
        expected = self._positions if near is None else transform_markers(self._positions, near)
        if len(points) > _MOST_SEARCHED_POINTS:
            return _Match(0, np.nan, pose, assignment)
        count, _, rival = search_constellation(
            self._positions, self._distances, points, expected, radius, search, assignment, pose
        )
        if count == FEWEST > rival:
            count, _ = fit_inliers(self._positions, points, assignment, pose, tightest, tightest)
        if count < FEWEST or rival >= count:
            return _Match(0, np.nan, pose, assignment)
        fit = assign_remaining(self._positions, points, assignment, pose, tight, gate)
        return _Match(*fit, pose, assignment)

    @property
    def _no_match(self) -> tuple[Doubles, Integers]:
        """Buffers for a pose and an assignment."""
        return np.empty(7), np.full(len(self._positions), -1)

    def _accept(self, status: Status, match: _Match, cloud: _Cloud) -> BodyFrame:
        """Update pose and velocity from a fit."""
        if status == Status.INITIALIZED:
            self._velocity, self._most_markers, self._fits = np.zeros(6), 0, 0
        elif 0.0 < cloud.elapsed <= _LONGEST_PREDICTION:
            weight = _VELOCITY_SMOOTHING if self._fits > 1 else 1.0
            self._velocity += weight * (velocity_of(self._pose, match.pose, cloud.elapsed) - self._velocity)
        self._fits += 1
        self._pose, self._time, self._status = match.pose, cloud.time, status
        self._most_markers = max(self._most_markers, int((match.assignment >= 0).sum()))
        return self._result(match, cloud)

    def _result(self, match: _Match, cloud: _Cloud) -> BodyFrame:
        """The result of a fit, with the labels of further points that `_keep` finds."""
        transform = np.eye(4)
        write_quaternion_matrix(transform, *match.pose[3:])
        transform[:3, 3] = match.pose[:3]
        self._keep(match, transform, cloud)
        return BodyFrame(self._status, transform, self._labels(match.assignment, cloud.ids), match.rms)

    def _keep(self, match: _Match, transform: Doubles, cloud: _Cloud) -> None:
        """Add to a match markers that the fit left out.

        The point of such a marker has the ID of its last one, or is where the marker was when last kept.
        """
        points = cloud.points
        if (match.assignment >= 0).all() or not len(points):
            return
        there, last = transform_markers(self._positions, match.pose), self._last_points(cloud.ids)
        before = transform_markers(self._places, match.pose)
        for marker in np.flatnonzero(match.assignment < 0):
            point = last[marker]
            if point < 0 and (self._places[marker] != self._positions[marker]).any():
                off = np.linalg.norm(points - before[marker], axis=1)
                point = off.argmin() if off.min() <= self._tolerances.gate else -1
            is_near = np.linalg.norm(points[point] - there[marker]) <= self._tolerances.kept
            if point >= 0 and is_near and point not in match.assignment:
                match.assignment[marker] = point
                self._places[marker] = (points[point] - transform[:3, 3]) @ transform[:3, :3]

    def _labels(self, assignment: Integers, ids: Integers) -> Integers:
        """The marker (N,) of each point, -1 for none; stores the IDs for the next frame."""
        seen, labels = np.flatnonzero(assignment >= 0), np.full(len(ids), -1)
        labels[assignment[seen]] = seen
        self._last_ids[:] = -1
        self._last_ids[seen] = ids[assignment[seen]]
        return labels


def _frames_to_confirm(count: int, markers: int) -> float:
    """Number of frames in which a match of `count` markers must persist before it is accepted."""
    # Three markers of a larger body are never accepted: markers on the back of a hand keep their distances
    # for minutes, and in up to 5 % of the frames some three markers of two hands match three of an object.
    # Four markers match in 0.1 %.
    if count == FEWEST:
        return 10 if markers == FEWEST else np.inf
    return 2 if count == FEWEST + 1 < markers else 1


AnyBody = RigidTemplate | str | Path
"""A rigid body, the name of one of handsim's objects, or the path of a .toml file."""


class BodyError(HandSimError):
    """A body's file cannot be read or written."""


def load_body(name_or_path: AnyBody) -> RigidTemplate:
    """Return a body as it is, or load handsim's object or the `.toml` file of this name."""
    check_type("body", name_or_path, (RigidTemplate, str, Path), _ANY_BODY)
    if isinstance(name_or_path, RigidTemplate):
        return name_or_path
    path = Path(name_or_path)
    if str(name_or_path) in object_names():
        return RigidTemplate.of(named_object(str(name_or_path)))
    if path.suffix.lower() != BODY_SUFFIX:
        ours = [name for name in object_names() if len(named_object(name).markers) >= FEWEST]
        unknown = choices(str(name_or_path), ours, noun="body")
        raise ArgumentError(f"{unknown}, or the path of a .toml file")
    table = read_toml(path, error=BodyError)
    with errors_of(path, BodyError):
        return _parse_body(table)


def load_bodies(names_or_paths: AnyBody | Iterable[AnyBody]) -> tuple[RigidTemplate, ...]:
    """Load one or several bodies with different names."""
    if isinstance(names_or_paths, AnyBody):
        names_or_paths = (names_or_paths,)
    check_type("bodies", names_or_paths, Iterable, _ANY_BODY)
    bodies: list[RigidTemplate] = []
    for name_or_path in names_or_paths:
        body = load_body(name_or_path)
        taken = (*SIDES, *(other.name for other in bodies))
        if body.name in taken:
            owner = "" if body is name_or_path else f"{name_or_path}: "
            raise ArgumentError(
                f"{owner}a body is named '{body.name}', expected a name of its own; taken are "
                f"{', '.join(taken)}"
            )
        for part, side in body.limb.items():
            if any(other.limb == body.limb for other in bodies):
                raise ArgumentError(f"'{body.name}' is a second {side} {part}, expected one at most")
        bodies.append(body)
    return tuple(bodies)


def save_body(path: str | Path, body: RigidTemplate) -> None:
    """Write a body as TOML with nine decimals; `load_body` reads the same body again."""
    lines = [f"name = {toml_string(body.name)}"]
    lines += [f"{part} = {toml_string(side)}" for part, side in body.limb.items()]
    if body.forearm is not None:
        lines.append(f"forearm_axes = {str(body.has_axes).lower()}")
    for name, position in zip(body.marker_names, 1e3 * body.positions, strict=True):
        numbers_mm = ", ".join(toml_number(value) for value in position.tolist())
        lines += ["", "[[marker]]", f"name = {toml_string(name)}", f"place_mm = [{numbers_mm}]"]
    with writing(path, BodyError):
        write_text(path, "\n".join(lines) + "\n")


def _parse_body(table: Mapping[str, object]) -> RigidTemplate:
    check_keys(table, "the file", _BODY_KEYS, optional=_OPTIONAL)
    text_of(table, "description", default="")
    name = _printable("the body's name", text_of(table, "name"))
    markers = [_parse_marker(entry, number) for number, entry in enumerate(tables_of(table, "marker"), 1)]
    positions = np.array([position for _, position in markers]).reshape(-1, 3)
    parts = ("forearm", "elbow")
    forearm, elbow = (cast("Side", text_of(table, part)) if part in table else None for part in parts)
    axes, names = table.get("forearm_axes", False), tuple(marker for marker, _ in markers)
    check_type("forearm_axes", axes, bool, "true or false")
    return RigidTemplate(name, names, 1e-3 * positions, None, forearm, bool(axes), elbow)


def _parse_marker(table: Mapping[str, object], number: int) -> tuple[str, list[float]]:
    name = table.get("name")
    owner = f"marker '{name}'" if isinstance(name, str) else f"marker number {number}"
    check_keys(table, owner, _MARKER_KEYS)
    name = _printable("marker name", text_of(table, "name", f"{owner}: "))
    expected = "three numbers [x, y, z] in millimeters"
    return name, numbers(f"{owner}: place_mm", table["place_mm"], (3,), expected).tolist()


def _printable(what: str, name: str) -> str:
    """Check that marker files can hold a name."""
    if not name or name != name.strip() or not name.isprintable():
        raise ArgumentError(f"{what} {name!r}: expected printable characters without outer blanks")
    return name


def learn_body(
    capture: Capture,
    name: str,
    markers: Sequence[str] = (),
    *,
    forearm: Side | None = None,
    elbow: Side | None = None,
) -> RigidTemplate:
    """Learn the markers of a body from a capture of it alone; its origin is the mean of its markers.

    Args:
        capture: The capture.
        name: The body's name.
        markers: Columns of a labeled capture that are the body's; its markers have their names.
        forearm: The hand whose forearm it is.
        elbow: The hand whose elbow it is.

    Raises:
        ArgumentError: The points have a wrong unit.
        CalibrationError: They are not those of one rigid body.
        CaptureError: A column is missing.
    """
    if markers:
        if len(markers) < FEWEST:
            count = f"{len(markers)} marker{'s' * (len(markers) > 1)}"
            raise CalibrationError(f"{count} of a body, expected at least {FEWEST}, which determine a pose")
        capture = Capture(tuple(markers), select_markers(capture, markers), capture.rate)
        body = learn_body(capture, name, forearm=forearm, elbow=elbow)
        if len(body.positions) < len(markers):
            raise CalibrationError(
                f"{len(body.positions)} of the markers {', '.join(markers)} are mostly seen and keep their "
                "distances, expected all"
            )
        return dataclasses.replace(body, marker_names=tuple(markers))
    frames = list(capture_frames(capture))
    check_unit([frame.points for frame in frames])
    counts = np.array([len(frame.points) for frame in frames])
    body, tracked = _best_template(name, (forearm, elbow), frames, counts)
    labeled = _count_labeled(tracked)
    if labeled < _LEAST_LABELED_SHARE * counts.sum():
        raise CalibrationError(
            f"{100.0 * labeled / counts.sum():.0f} % of the points keep their positions on one rigid body, "
            "expected a capture with nothing else in it"
        )
    for _ in range(_AVERAGING_ROUNDS):
        positions = _median_positions(body, frames, tracked)
        body = _template(name, (forearm, elbow), positions)
        tracked = track_body(body, frames)
    return body


def _best_template(
    name: str, limb: _LimbSides, frames: Sequence[StreamedFrame], counts: Integers
) -> tuple[RigidTemplate, list[BodyFrame]]:
    """The template, among those of several frames, that labels most points, and its track."""
    count = int(np.quantile(counts, _COUNT_QUANTILE, method="lower"))
    if not 3 <= count <= _MOST_LEARNED_MARKERS:
        raise CalibrationError(
            f"a capture of {count} points per frame, expected 3 to {_MOST_LEARNED_MARKERS}: one body and "
            "nothing else"
        )
    chosen = np.flatnonzero(counts == count)
    chosen = chosen[np.linspace(0, len(chosen) - 1, _TEMPLATE_CANDIDATES).round().astype(int)]
    candidates, faults = [], []
    for number in np.unique(chosen):
        try:
            body = _template(name, limb, frames[number].points)
        except CalibrationError as error:
            faults.append(error)
        else:
            candidates.append((body, track_body(body, frames)))
    if not candidates:
        raise faults[-1]
    return max(candidates, key=lambda candidate: _count_labeled(candidate[1]))


def _template(name: str, limb: _LimbSides, positions: Doubles) -> RigidTemplate:
    """A body with markers at these positions (Q, 3) [m], its origin moved to their mean."""
    forearm, elbow = limb
    names = tuple(f"Marker{number + 1}" for number in range(len(positions)))
    try:
        return RigidTemplate(name, names, positions - positions.mean(axis=0), None, forearm, elbow=elbow)
    except ArgumentError as error:
        raise CalibrationError(str(error)) from error


def track_body(body: RigidTemplate, frames: Iterable[StreamedFrame]) -> list[BodyFrame]:
    """Track a body through some frames."""
    tracker = BodyTracker(body)
    return [tracker.step(frame.points, frame.ids, frame.time) for frame in frames]


def _count_labeled(tracked: Sequence[BodyFrame]) -> int:
    return sum(int((frame.labels >= 0).sum()) for frame in tracked)


def _median_positions(
    body: RigidTemplate, frames: Sequence[StreamedFrame], tracked: Sequence[BodyFrame]
) -> Doubles:
    """Median position (Q, 3) of each marker in the body's frame [m]; rarely seen markers are dropped."""
    seen = np.full((len(frames), len(body.positions), 3), np.nan)
    for number, (frame, one) in enumerate(zip(frames, tracked, strict=True)):
        if one.T_world_body is not None:
            labeled = one.labels >= 0
            rotation, translation = one.T_world_body[:3, :3], one.T_world_body[:3, 3]
            seen[number, one.labels[labeled]] = (frame.points[labeled] - translation) @ rotation
    present = np.isfinite(seen[..., 0])
    kept = present.sum(axis=0) >= _LEAST_SEEN_SHARE * present.any(axis=1).sum()
    return np.asarray(np.nanmedian(seen[:, kept], axis=0))
