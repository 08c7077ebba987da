"""Figures of the hands of a take, for its report page and its tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gloves.captures.capture import runs_of
from gloves.takes.take import INITIALIZED, LOST, Take
from handsim.hand.shape import JOINTS, Side
from track.kinematics.pose_spread import CHANGING, DETECTABLE, SOURCES, measurement_error
from track.takes.take_faults import AT_LIMIT_DEG
from track.takes.trials import Cycles, cycles_of
from track.user import hand_origin

CONSTANT: Final = [SOURCES.index("gluing"), SOURCES.index("person")]
"""Sources whose error is equal in all frames of a session."""
RANGE: Final = {"least": 0.0, "5th": 5.0, "median": 50.0, "95th": 95.0, "largest": 100.0}
"""Columns of a range of motion, and the percentile of each."""
_FRAMES_PER_CALL: Final = 4096  # frames per call of forward kinematics


@dataclass(frozen=True, slots=True, eq=False)
class PageSettings:
    """What a page and its tables show of a take."""

    person: str = ""
    session: str = ""
    neutral: tuple[float, float] | Take | None = None
    """The pose in which the angles of a study are zero, see `Take.angles`."""
    decimal: str = "."
    """The decimal mark of the tables; with a comma their cells are separated by semicolons."""
    guesses: bool = False
    """Whether curves and frames have angles of joints that nothing shows, see `Take.shown_joints`."""
    cycles: str | None = None
    """The joint, as in `JOINT_NAMES`, between whose least angles are the cycles of a movement."""


@dataclass(frozen=True, slots=True, eq=False)
class HandFigures:
    """Figures of one hand over the T frames of a take, with its M markers."""

    side: Side
    marker_names: tuple[str, ...]
    status: Int[np.ndarray, "T"]
    """Indices into `STATUSES`."""
    angles: Float[np.ndarray, "T 20"]
    """Joint angles in the order of `JOINT_NAMES` [deg]; NaN where lost, or where nothing shows a joint."""
    angle_spread: Float[np.ndarray, "T 20"] | None
    """Standard deviation of each angle [deg]; None if the take has none."""
    residuals: Float[np.ndarray, "T M"]
    """Distance of each labeled point from the pose's marker [m]; NaN without a point or a pose."""
    confidence: Float[np.ndarray, "T M"]
    """Confidence in each marker's label; NaN where the marker has no point."""
    beyond: Bool[np.ndarray, "20 M"]
    """Which markers each joint moves; none for a joint that nothing shows."""

    @property
    def seen(self) -> Bool[np.ndarray, "T M"]:
        """Which markers have a point."""
        return np.asarray(np.isfinite(self.confidence))

    @property
    def fitted(self) -> Bool[np.ndarray, "T"]:
        """Whether the pose of each frame was fitted to points; other poses are predicted."""
        return self.status >= INITIALIZED

    @property
    def rms(self) -> Float[np.ndarray, "T"]:
        """RMS of the residuals of each frame [m], also of simulated takes; NaN where there are none."""
        known = np.isfinite(self.residuals)
        total = np.sum(np.square(self.residuals), axis=1, where=known)
        count = np.where(known.any(axis=1), known.sum(axis=1), np.nan)
        return np.asarray(np.sqrt(total / count))

    @property
    def measured(self) -> Bool[np.ndarray, "T 20"]:
        """Fitted frames with a seen marker beyond the joint; in all others the angle is predicted."""
        return np.asarray(self.fitted[:, None] & (self.seen @ self.beyond.T))

    def gaps(self, seen: Bool[np.ndarray, "T K"]) -> list[list[int]]:
        """Lengths of the gaps of each column, from the hand's first pose to its last [frames]."""
        there = np.flatnonzero(self.status != LOST)
        hidden = ~seen[there[0] : there[-1] + 1] if len(there) else seen[:0]
        return [[last - first + 1 for first, last in runs_of(column)] for column in hidden.T]

    def joints(self) -> Float[np.ndarray, "20 9"]:
        """Each angle's measured `RANGE`, median SD [deg], shares at a limit and measured, longest gap."""
        found, measured = np.full((len(JOINTS), len(RANGE) + 4), np.nan), self.measured
        for row, angles, frames in zip(found, self.angles.T, measured.T, strict=True):
            if frames.any():
                row[: len(RANGE)] = np.percentile(angles[frames], list(RANGE.values()))
        if self.fitted.any():
            if self.angle_spread is not None:
                found[:, -4] = np.median(self.angle_spread[self.fitted], axis=0)
            low, high = np.array([(joint.low_deg, joint.high_deg) for joint in JOINTS]).T
            angles = self.angles[self.fitted]
            found[:, -3] = ((angles < low + AT_LIMIT_DEG) | (angles > high - AT_LIMIT_DEG)).mean(axis=0)
        found[:, -2] = measured.mean(axis=0)
        found[:, -1] = [max(gaps, default=0) for gaps in self.gaps(measured)]
        return found

    def markers(self) -> Iterator[MarkerFigures]:
        """Figures of each marker, in the glove's order."""
        seen = self.seen
        for marker, (name, gaps) in enumerate(zip(self.marker_names, self.gaps(seen), strict=True)):
            frames = np.flatnonzero(seen[:, marker])
            residuals = self.residuals[:, marker]
            known = residuals[np.isfinite(residuals)]
            median, high = np.percentile(known, (50.0, 95.0)).tolist() if len(known) else (np.nan, np.nan)
            confidence = float(np.median(self.confidence[frames, marker])) if len(frames) else np.nan
            share, longest = float(seen[:, marker].mean()), max(gaps, default=0)
            yield MarkerFigures(name, share, len(gaps), longest, median, high, confidence)


class MarkerFigures(NamedTuple):
    """Figures of one marker; NaN if it was never seen or there is no pose."""

    name: str
    seen: float
    """Share of all frames in which it has a point."""
    num_gaps: int
    """Number of gaps between the hand's first and last pose."""
    longest_gap: int
    """Length of the longest gap [frames]."""
    median_residual: float
    """Median distance from the pose's marker [m]."""
    high_residual: float
    """95th percentile of that distance [m]."""
    median_confidence: float
    """Median confidence in its labels."""


def hand_figures(take: Take, *, guesses: bool = False) -> tuple[HandFigures, ...]:
    """The figures of each hand of a simulated or tracked take; with guesses for joints that nothing shows."""
    found = []
    for number, (hand, labels) in enumerate(zip(take.hands, take.hand_labels, strict=True)):
        there = take.status[:, number] != LOST
        shown = take.shown_joints(hand.side)
        known = there[:, None] & (shown | guesses)
        angles = np.where(known, np.rad2deg(take.qpos[:, number, 7:]), np.nan)
        confidence = np.full((take.num_frames, len(labels)), np.nan)
        points = take.point_list
        own = (points.labels >= labels.start) & (points.labels < labels.stop)
        confidence[points.frames[own], points.labels[own] - labels.start] = points.confidence[own]
        residuals = np.full((take.num_frames, len(labels)), np.nan)
        observed = take.observed(hand.side)
        for span, worn in take.worn():
            posed = span.start + np.flatnonzero(there[span])
            for first in range(0, len(posed), _FRAMES_PER_CALL):
                part = posed[first : first + _FRAMES_PER_CALL]
                expected, _ = worn[number].markers(take.qpos[part, number])
                residuals[part] = np.linalg.norm(observed[part] - expected, axis=2)
        spread = None if take.angle_spread is None else np.rad2deg(take.angle_spread[:, number])
        status, names = take.status[:, number], hand.layout.names
        beyond = hand.attachment.beyond & shown[:, None]
        found.append(HandFigures(hand.side, names, status, angles, spread, residuals, confidence, beyond))
    return tuple(found)


class WristFigures(NamedTuple):
    """The angles `WRIST_NAMES` of one arm in all frames of a take."""

    angles: Float[np.ndarray, "T 3"]
    """Angles [deg]; NaN where one of two bodies has no pose, or axes are unknown."""
    spread: Float[np.ndarray, "T 3"]
    """Their standard deviations [deg]; NaN where unknown."""
    measured: Bool[np.ndarray, "T 3"]
    """Frames in which the poses of both bodies were fitted to points."""
    constant: Float[np.ndarray, "3"]
    """The part of each standard deviation [deg] whose error stays the same in all frames."""

    def median_spreads(self) -> Float[np.ndarray, "3"]:
        """The median standard deviation [deg] of each angle over its measured frames; NaN without any."""
        spreads = zip(self.spread.T, self.measured.T, strict=True)
        return np.concatenate([medians(spread[measured, None]) for spread, measured in spreads])


def wrist_figures(take: Take, hand: HandFigures, settings: PageSettings) -> WristFigures:
    """The figures of a wrist whose forearm is among the bodies."""
    angles, number = take.wrist_angles(hand.side, settings.neutral), take.hand_index(hand.side)
    assert angles is not None
    bodies = take.forearm_index(hand.side), take.elbow_index(hand.side)
    status = [np.full(len(angles), LOST) if body is None else take.body_status[:, body] for body in bodies]
    forearm, elbow = (one >= INITIALIZED for one in status)
    fitted = np.column_stack([hand.fitted & forearm, hand.fitted & forearm, elbow & forearm])
    spread = np.full(angles.shape, np.nan) if take.wrist_spread is None else take.wrist_spread[:, number]
    budget = np.full((angles.shape[1], len(SOURCES)), np.nan)
    for row, known in zip(budget, take.settings.get("wrist_budget", {}).get(hand.side, ()), strict=False):
        row[:] = known
    constant = np.linalg.norm(budget[:, CONSTANT], axis=1)
    return WristFigures(np.rad2deg(angles), np.rad2deg(spread), fitted & np.isfinite(angles), constant)


def joint_errors(settings: Mapping[str, Any], hand: HandFigures) -> Float[np.ndarray, "20 E"]:
    """Each angle's SD, its `SOURCES`, SEM, MDD by measure [deg], cut-off [Hz]; NaN if it is not smoothed."""
    cutoffs, budget = (settings.get(name, {}).get(hand.side) for name in ("filter", "budget"))
    if cutoffs is None or budget is None:
        return np.full((len(JOINTS), len(SOURCES) + len(CHANGING) + 3), np.nan)
    origin = hand_origin(str(settings.get("user", "")), hand.side)
    budget = np.pad(budget, ((0, 0), (0, len(SOURCES) - len(budget[0]))))  # Older takes have no palm.
    errors = np.transpose([measurement_error(budget, origin, measure) for measure in CHANGING])
    spreads = np.linalg.norm(budget, axis=1)
    return np.column_stack([spreads, budget, errors[:, 0], DETECTABLE * errors, cutoffs])


def cycles_of_hands(take: Take, hands: Sequence[HandFigures], settings: PageSettings) -> list[Cycles]:
    """The cycles of each hand; none if the settings ask for none."""
    joint = settings.cycles
    if joint is None:
        return []
    found = []
    for hand in hands:
        angles = take.angles(hand.side, neutral=settings.neutral).values()
        found.append(cycles_of(np.rad2deg(np.transpose([*angles])), hand.measured, joint, take.rate))
    return found


def medians(values: Float[np.ndarray, "F K"]) -> Float[np.ndarray, "K"]:
    """Medians of the columns, over the rows that are known; NaN if none is."""
    known = np.isfinite(values).all(axis=1)
    return np.median(values[known], axis=0) if known.any() else np.full(values.shape[1], np.nan)
