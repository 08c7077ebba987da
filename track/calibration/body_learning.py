"""Calibration of a rigid body: its markers from a capture that has nothing else in it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gloves.captures.capture import Capture, check_unit
from track.bodies.rigid_body import BodyFrame, BodyTracker, RigidTemplate, template_fault
from track.calibration.frames import CalibrationError
from track.streams.frame_source import StreamedFrame, capture_frames

_MOST_MARKERS: Final = 20
_COUNT_QUANTILE: Final = 0.9  # of the frames' numbers of points: the body's number of markers
_CANDIDATES: Final = 5  # frames that are tried as the first template
_ROUNDS: Final = 3  # of averaging the markers over all frames
_SEEN_SHARE: Final = 0.5  # of the body's frames that a marker must be in
_LABELED_SHARE: Final = 0.8  # of all points that must be the body's


def learn_body(capture: Capture, name: str) -> RigidTemplate:
    """The markers of a body from a capture of it; the origin of its frame is the mean of its markers.

    A first template is taken from one frame and tracked through all frames. Then each marker moves to its
    median over the frames.

    Args:
        capture: A capture of the body in motion; gaps and a few false points are allowed. Marker names are
            not used.

    Raises:
        ArgumentError: The capture is not in meters.
        CalibrationError: Most of the points are not of one rigid body, or the body cannot be tracked.
    """
    frames = list(capture_frames(capture))
    check_unit([frame.points for frame in frames])
    counts = np.array([len(frame.points) for frame in frames])
    body, tracked = _best_template(name, frames, counts)
    labeled = _num_labeled(tracked)
    if labeled < _LABELED_SHARE * counts.sum():
        raise CalibrationError(
            f"{100.0 * labeled / counts.sum():.0f} % of the points keep their positions on one rigid body, "
            "expected a capture with nothing else in it"
        )
    for _ in range(_ROUNDS):
        positions = _median_positions(body, frames, tracked)
        fault = _fault(name, positions)
        if fault is not None:
            raise CalibrationError(fault)
        body = _template(name, positions)
        tracked = _track(body, frames)
    return body


def _best_template(
    name: str, frames: Sequence[StreamedFrame], counts: NDArray[np.int64]
) -> tuple[RigidTemplate, list[BodyFrame]]:
    """Of several frames' points the template that labels most points, and its track through all frames."""
    count = int(np.quantile(counts, _COUNT_QUANTILE, method="lower"))
    if not 3 <= count <= _MOST_MARKERS:
        raise CalibrationError(
            f"a capture of {count} points per frame, expected 3 to {_MOST_MARKERS}: one body and nothing else"
        )
    chosen = np.flatnonzero(counts == count)
    chosen = chosen[np.linspace(0, len(chosen) - 1, _CANDIDATES).round().astype(int)]
    candidates = []
    faults = {number: _fault(name, frames[number].points) for number in np.unique(chosen)}
    for number, fault in faults.items():
        if fault is None:
            body = _template(name, frames[number].points)
            candidates.append((body, _track(body, frames)))
    if not candidates:
        raise CalibrationError(f"{list(faults.values())[-1]}")
    return max(candidates, key=lambda candidate: _num_labeled(candidate[1]))


def _marker_names(positions: NDArray[np.float64]) -> tuple[str, ...]:
    return tuple(f"Marker{number + 1}" for number in range(len(positions)))


def _fault(name: str, positions: NDArray[np.float64]) -> str | None:
    """What is wrong with a body of markers at these positions (Q, 3), if anything."""
    return template_fault(name, _marker_names(positions), positions - positions.mean(axis=0))


def _template(name: str, positions: NDArray[np.float64]) -> RigidTemplate:
    """A body of markers at these positions (Q, 3), moved to its own frame."""
    return RigidTemplate(name, _marker_names(positions), positions - positions.mean(axis=0))


def _track(body: RigidTemplate, frames: Sequence[StreamedFrame]) -> list[BodyFrame]:
    tracker = BodyTracker(body)
    return [tracker.step(frame.points, frame.ids, frame.time) for frame in frames]


def _num_labeled(tracked: Sequence[BodyFrame]) -> int:
    return sum(int((frame.labels >= 0).sum()) for frame in tracked)


def _median_positions(
    body: RigidTemplate, frames: Sequence[StreamedFrame], tracked: Sequence[BodyFrame]
) -> NDArray[np.float64]:
    """Median position (Q, 3) of each marker in the body's frame [m]; rarely seen markers are dropped."""
    seen = np.full((len(frames), len(body.positions), 3), np.nan)
    for number, (frame, one) in enumerate(zip(frames, tracked, strict=True)):
        if one.T_world_body is not None:
            labeled = one.labels >= 0
            rotation, translation = one.T_world_body[:3, :3], one.T_world_body[:3, 3]
            seen[number, one.labels[labeled]] = (frame.points[labeled] - translation) @ rotation
    present = np.isfinite(seen[..., 0])
    kept = present.sum(axis=0) >= _SEEN_SHARE * present.any(axis=1).sum()
    median: NDArray[np.float64] = np.nanmedian(seen[:, kept], axis=0)
    return median
