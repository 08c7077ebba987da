"""Rigid bodies with markers of their own, tracked beside the hands: which points are theirs, and their pose.

IDs carry labels from frame to frame; points with new IDs are taken where the pose puts a marker that is
missing; a body that is lost is looked for among all points, by the distances between its markers. A body of
more than three markers is found by four or more, and followed by three or more; near where it was a moment
ago three find it again.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from handsim._checks import check_array
from handsim.errors import ArgumentError
from handsim.space.objects import RigidObject
from track.bodies.constellation import (
    FEWEST,
    advance,
    carry,
    complete,
    follow,
    lean_on,
    put,
    search,
    settle,
    velocity_between,
    write_labels,
    write_transform,
)
from track.tracked_frame import Status

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy.typing import NDArray

GATE: Final = 0.003
"""How far a labeled point may be from its marker [m], ten times the noise of a good system."""
_TIGHT: Final = 0.001  # [m], the same for those that make the pose, and for a body that is looked for
_TIGHTEST: Final = 0.0005  # and for three that are looked for, where chance is at work
_THINNEST: Final = 0.005  # [m] RMS off the line that runs best through the markers
_CLOSEST: Final = 2.0 * GATE  # markers nearer to each other than this change labels unseen
_COASTING: Final = 0.026  # [s] without three markers, three frames at 120 Hz, before a body is lost
_FITS: Final = 5  # in a row that tell how fast it moves
_EASE: Final = 0.4  # weight of the newest velocity: a fit to three markers wobbles
_NEARBY: Final = 0.25  # [s] after which it may be anywhere
_SPREAD, _PACE = 0.005, 1.5  # [m], [m/s]: how far off a marker may be when it is not known how fast it moves
_ERROR, _HASTE = 0.002, 30.0  # [m], [m/s^2]: and when it is
_NEAR: Final = 0.03  # [m]: so near to where it was, three markers are believed at once
_STILL: Final = 0.02  # [m] a frame that a candidate may move while it waits to be believed
_MOST_POINTS: Final = 250  # among which it is looked for: some 30 ms, and it grows with their third power
_FARTHEST: Final = 1e3  # [m]: beyond it there is no room


@dataclass(frozen=True, slots=True, eq=False)
class RigidTemplate:
    """The markers of a rigid body in its own frame.

    Raises:
        ArgumentError: There are fewer than three, names and places do not fit, two are too close together,
            all
            lie on one line, or the body looks the same from two sides.
    """

    name: str
    marker_names: tuple[str, ...]
    places: Float[np.ndarray, "Q 3"]
    """[m] in the body's frame."""

    def __post_init__(self) -> None:
        places = np.array(check_array("places", self.places, (len(self.marker_names), 3)), order="C")
        object.__setattr__(self, "places", places)
        if places.ndim != 2 or len(places) < FEWEST:
            raise ArgumentError(
                f"{self.name}: {places.shape[-2]} markers, expected at least {FEWEST} to tell a pose"
            )
        if len(set(self.marker_names)) < len(self.marker_names):
            raise ArgumentError(f"{self.name}: a marker name is there twice: {', '.join(self.marker_names)}")
        apart = self.sides + np.where(np.eye(len(places), dtype=bool), np.inf, 0.0)
        if apart.min() < _CLOSEST:
            first, second = (self.marker_names[i] for i in np.unravel_index(apart.argmin(), apart.shape))
            raise ArgumentError(
                f"{self.name}: {first} and {second} are {1e3 * apart.min():.1f} mm apart, expected at least "
                f"{1e3 * _CLOSEST:.0f} mm"
            )
        off_line = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1]
        if off_line < _THINNEST * np.sqrt(len(places)):
            raise ArgumentError(f"{self.name}: its markers lie on one line, expected three that do not")
        order = _look_alike(places, self.sides)
        if order is not None:
            moved = [
                f"{self.marker_names[i]} at {self.marker_names[k]}" for i, k in enumerate(order) if i != k
            ]
            raise ArgumentError(
                f"{self.name}: its markers look the same from two sides ({', '.join(moved)}), "
                "expected a place "
                "for each that tells them apart by some millimeters"
            )

    @classmethod
    def of(cls, thing: RigidObject) -> RigidTemplate:
        """The markers of an object.

        Raises:
            ArgumentError: They do not make a rigid body; most objects carry too few.
        """
        return cls(thing.name, thing.marker_names, thing.markers)

    @property
    def sides(self) -> Float[np.ndarray, "Q Q"]:
        """Distances between markers [m]."""
        sides: np.ndarray = np.linalg.norm(self.places[:, None] - self.places, axis=2)
        return sides


def _look_alike(places: NDArray[np.float64], sides: NDArray[np.float64]) -> tuple[int, ...] | None:
    """Another order of all markers that a turned body cannot be told from, if there is one.

    Some of the markers may still look like others; then the body is not found while only those are seen.
    """
    count = len(places)
    orders: list[tuple[int, ...]] = [()]
    for marker in range(count):  # orders that keep all distances so far
        orders = [
            (*order, to)
            for order in orders
            for to in range(count)
            if to not in order
            and all(abs(sides[marker, k] - sides[to, order[k]]) < 2.0 * _TIGHT for k in range(marker))
        ]
    for order in orders:
        if order != tuple(range(count)):
            agree, _ = settle(places, places, np.array(order), np.empty(7), _TIGHT, _TIGHT)
            if agree == count:  # turned, not mirrored
                return order
    return None


@dataclass(frozen=True, slots=True, eq=False)
class BodyFrame:
    """What is known of a body in a frame."""

    status: Status
    """`found` after it was lost, `tracked` from then on, `coasting` for a few frames where fewer than three
    markers are seen and the pose is a prediction, `lost`."""
    T_world_body: Float[np.ndarray, "4 4"] | None
    """The body's frame seen from the world [m]; None when lost."""
    labels: Int[np.ndarray, "N"]
    """Place of each point's marker in the template, -1 for all others."""
    rms: float
    """RMS distance of the labeled points from their markers [m]; NaN without any."""


class BodyTracker:
    """Follows one rigid body through a stream of points.

    Args:
        template: Its markers.
    """

    def __init__(self, template: RigidTemplate) -> None:
        self.template = template
        self._places, self._sides = template.places, template.sides
        self._forget()
        for number in range(18):  # so that no kernel is loaded while somebody waits for a frame
            there = self._places if number < 17 else self._places[:0]
            self.step(there, np.arange(len(there)), number / 120.0)
        self._forget()

    def step(self, points: Float[np.ndarray, "N 3"], ids: Int[np.ndarray, "N"], time: float) -> BodyFrame:
        """One frame; whatever a stream may bring ends in a status.

        Args:
            points: All points of the frame [m], in any order; those of hands and ghosts among them. Points
                that are no finite places are left alone.
            ids: The system's ID of each, negative where it gives none.
            time: Of the frame [s].

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

    def _step(self, points: Any, ids: Any, time: float) -> BodyFrame:
        elapsed = time - self._time
        if self._status != Status.LOST:
            frame = self._follow(points, ids, time, elapsed) or self._coast(points, ids, elapsed)
            if frame is not None:
                return frame
            self._lose()
        return self._find(points, ids, time, elapsed)

    def _forget(self) -> None:
        self._pose, self._velocity, self._time = np.full(7, np.nan), np.zeros(6), -np.inf  # of the last fit
        self._most, self._fits = 0, 0  # since it was found: markers that agreed at once, frames fitted
        self._lose()

    def _lose(self) -> None:
        self._status: Status = Status.LOST
        self._known = np.full(len(self._places), -1)  # IDs of the last frame
        self._candidate, self._waited = np.full(7, np.nan), 0

    def _follow(self, points: Any, ids: Any, time: float, elapsed: float) -> BodyFrame | None:
        """The body where IDs or its motion say that it is."""
        pose, owners = np.empty(7), np.empty(len(self._places), dtype=np.int64)
        count, rms = follow(self._places, points, ids, self._known, pose, _TIGHT, GATE, owners)
        if count < FEWEST and 0.0 < elapsed <= _NEARBY:
            predicted = advance(self._pose, self._velocity, elapsed)
            count, rms = self._search(points, predicted, self._reach(elapsed), owners, pose)
        if count < FEWEST:
            return None
        if max(self._most, count) <= FEWEST < len(self._places):
            # Three points may lie as three markers do by chance: more of them elsewhere are the body.
            other, others = np.empty(7), np.empty_like(owners)
            more, spread = self._search(points, None, np.inf, others, other)
            if more > FEWEST:
                return self._keep(Status.FOUND, other, spread, others, ids, time)
        return self._keep(Status.TRACKED, pose, rms, owners, ids, time)

    def _coast(self, points: Any, ids: Any, elapsed: float) -> BodyFrame | None:
        """The body where its motion says that it is, for as long as that may be trusted."""
        if not 0.0 < elapsed <= _COASTING or self._fits < _FITS:
            return None
        pose = advance(self._pose, self._velocity, elapsed)
        owners = np.empty(len(self._places), dtype=np.int64)
        carry(points, ids, self._known, owners)
        _, rms = lean_on(points, owners, pose, put(self._places, pose), GATE)
        self._status = Status.COASTING
        return self._frame(pose, rms, owners, ids)

    def _find(self, points: Any, ids: Any, time: float, elapsed: float) -> BodyFrame:
        """The body where it was a moment ago, or anywhere."""
        pose, owners = np.empty(7), np.empty(len(self._places), dtype=np.int64)
        if 0.0 < elapsed <= _NEARBY:
            reach, predicted = self._reach(elapsed), advance(self._pose, self._velocity, elapsed)
            count, rms = self._search(points, predicted, reach, owners, pose)
            if count > FEWEST or (count == FEWEST and reach <= _NEAR):
                return self._keep(Status.FOUND, pose, rms, owners, ids, time)
        count, rms = self._search(points, None, np.inf, owners, pose)
        if count >= FEWEST:
            moved = np.linalg.norm(put(self._places, pose) - put(self._places, self._candidate), axis=1).max()
            self._waited = self._waited + 1 if moved < _STILL else 1
            self._candidate = pose
            if self._waited >= _frames_to_wait(count, len(self._places)):
                return self._keep(Status.FOUND, pose, rms, owners, ids, time)
        else:
            self._waited = 0
        return BodyFrame(Status.LOST, None, np.full(len(points), -1), np.nan)

    def _reach(self, elapsed: float) -> float:
        """How far a marker may be from where the last fit and its motion put it [m]."""
        if self._fits < _FITS:
            return _SPREAD + _PACE * elapsed
        return _ERROR + 0.5 * _HASTE * elapsed**2

    def _search(self, points: Any, near: Any, reach: float, owners: Any, pose: Any) -> tuple[int, float]:
        """The one place where the markers fit, within reach of a pose; how many do and their RMS distance."""
        if len(points) > _MOST_POINTS:
            return 0, np.nan
        wanted = self._places if near is None else put(self._places, near)
        count, _, rival = search(self._places, self._sides, points, wanted, reach, _TIGHT, owners, pose)
        if count < FEWEST or rival >= count:
            return 0, np.nan
        if count == FEWEST and settle(self._places, points, owners, pose, _TIGHTEST, _TIGHTEST)[0] < FEWEST:
            return 0, np.nan
        fitted: tuple[int, float] = complete(self._places, points, owners, pose, _TIGHT, GATE)
        return fitted

    def _keep(self, status: Status, pose: Any, rms: float, owners: Any, ids: Any, time: float) -> BodyFrame:
        """Remember a fit."""
        elapsed = time - self._time
        if status == Status.FOUND:
            self._velocity, self._most, self._fits = np.zeros(6), 0, 0
        elif 0.0 < elapsed <= _NEARBY:
            ease = _EASE if self._fits > 1 else 1.0
            self._velocity += ease * (velocity_between(self._pose, pose, elapsed) - self._velocity)
        self._fits += 1
        self._pose, self._time, self._status = pose, time, status
        self._most = max(self._most, int((owners >= 0).sum()))
        return self._frame(pose, rms, owners, ids)

    def _frame(self, pose: Any, rms: float, owners: Any, ids: Any) -> BodyFrame:
        """What a user sees of a fit; the IDs are remembered."""
        labels, transform = np.full(len(ids), -1), np.eye(4)
        write_labels(owners, ids, labels, self._known)
        write_transform(pose, transform)
        return BodyFrame(self._status, transform, labels, rms)


def _frames_to_wait(count: int, markers: int) -> float:
    """Frames that so few markers have to stay together before they are believed anywhere in the room.

    Three of more never are: the back of a hand has markers that keep their distances for minutes, and in up
    to one of twenty frames some three of two hands' lie as three of an object's do. Four do in one of a
    thousand.
    """
    if count == FEWEST:
        return 10 if markers == FEWEST else np.inf
    return 2 if count == FEWEST + 1 < markers else 1
