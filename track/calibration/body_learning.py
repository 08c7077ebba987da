"""The markers of a rigid body from a capture in which nothing else is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from gloves.captures.capture import Capture
from handsim.errors import ArgumentError
from track.bodies.rigid_body import BodyFrame, BodyTracker, RigidTemplate
from track.capture_tracking import capture_frames
from track.streams.point_stream import StreamedFrame
from train.labelers.protocol import check_unit

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MOST_MARKERS: Final = 20
_OFTEN: Final = 0.9  # of the frames, that have no more points than the body has markers
_BEGINNINGS: Final = 5  # frames that are tried as what the body looks like
_ROUNDS: Final = 3  # of putting every marker where the frames have it
_SEEN: Final = 0.5  # of the body's frames that a marker must be in
_ITS_OWN: Final = 0.8  # of all points that must be the body's


def learn_body(capture: Capture, name: str) -> RigidTemplate:
    """A body as a capture shows it: its own frame is in the middle of its markers.

    What it looks like is taken from one frame, and followed through all; then each marker is put where the
    frames have it.

    Args:
        capture: A capture of the body in motion, with gaps and some false points if need be. Names are not
            used.
        name: What the body shall be called.

    Raises:
        ArgumentError: Most of the points are no rigid body's, or the body is none that can be tracked.
    """
    frames = list(capture_frames(capture))
    check_unit([frame.points for frame in frames])
    counts = np.array([len(frame.points) for frame in frames])
    count = int(np.quantile(counts, _OFTEN, method="lower"))
    if not 3 <= count <= _MOST_MARKERS:
        raise ArgumentError(
            f"a capture of {count} points a frame, expected 3 to {_MOST_MARKERS}: one body and nothing else"
        )
    chosen = np.flatnonzero(counts == count)
    chosen = chosen[np.linspace(0, len(chosen) - 1, _BEGINNINGS).round().astype(int)]
    found, said = [], ArgumentError(f"{name}: no body")
    for number in np.unique(chosen):
        try:
            body = _body(name, frames[number].points)
        except ArgumentError as error:
            said = error
            continue
        tracked = _follow(body, frames)
        found.append((sum(int((frame.labels >= 0).sum()) for frame in tracked), body, tracked))
    if not found:
        raise said
    named, body, tracked = max(found, key=lambda one: one[0])
    if named < _ITS_OWN * counts.sum():
        raise ArgumentError(
            f"{100.0 * named / counts.sum():.0f} % of the points keep their places on one rigid body, "
            "expected "
            "a capture with nothing else in it"
        )
    for _ in range(_ROUNDS):
        body = _body(name, _places(body, frames, tracked))
        tracked = _follow(body, frames)
    return body


def _body(name: str, places: NDArray[np.float64]) -> RigidTemplate:
    """A body of markers at these places, moved to its own frame."""
    names = tuple(f"Marker{number + 1}" for number in range(len(places)))
    return RigidTemplate(name, names, places - places.mean(axis=0))


def _follow(body: RigidTemplate, frames: Sequence[StreamedFrame]) -> list[BodyFrame]:
    tracker = BodyTracker(body)
    return [tracker.step(frame.points, frame.ids, frame.time) for frame in frames]


def _places(
    body: RigidTemplate, frames: Sequence[StreamedFrame], tracked: Sequence[BodyFrame]
) -> NDArray[np.float64]:
    """Where the frames have the markers in the body's frame (Q, 3); those hardly seen are left out."""
    seen = np.full((len(frames), len(body.places), 3), np.nan)
    for number, (frame, one) in enumerate(zip(frames, tracked, strict=True)):
        if one.T_world_body is not None:
            mine = one.labels >= 0
            rotation, place = one.T_world_body[:3, :3], one.T_world_body[:3, 3]
            seen[number, one.labels[mine]] = (frame.points[mine] - place) @ rotation
    there = np.isfinite(seen[..., 0])
    kept = there.sum(axis=0) >= _SEEN * there.any(axis=1).sum()
    middle: NDArray[np.float64] = np.nanmedian(seen[:, kept], axis=0)
    return middle
