"""Measures the optical system of a lab in its captures: noise, gaps, ghosts, merging and IDs.

Captures may be labeled or not. Points are followed by their columns and, over gaps, by the points around
them. A track that is present most of the time is a marker.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from gloves.captures.capture import Capture, check_unit, run_lengths, unlabeled_frames
from gloves.captures.formats import read_capture
from gloves.captures.pieces import shared_columns
from gloves.optics.ghosts import GHOST_REACH
from gloves.takes.take import Take, load_take
from handsim._checks import check_type
from handsim.errors import CaptureError
from handsim.space.transforms import rigid_fit

AnyTrial = Capture | Take | str | Path
"""A capture; a take, of which only the points are used; or the path of one."""
_A_TRIAL: Final = "a Capture, a Take or the path of a file"
_FASTEST_POINT: Final = 4.0  # [m/s] A column whose point moves faster has changed to another point.
_RETURN_DISTANCE: Final = 0.02  # [m] largest distance of a returning point from its prediction
_LONG_TRACK: Final = 1.0  # [s] shortest duration of a track that is no ghost
_LEAST_PRESENCE: Final = 0.75  # least share of its duration in which such a track has a point
_BRIEF_GAP: Final = 0.1  # [s] gap that any track may have
_ANCHORS: Final = 5  # number of neighbors that predict a returning point
_LEAST_MARKER_SHARE: Final = 0.5  # least share of the frames in which a marker is present
_NAMELESS: Final = ("*", "unlabel")
"""Prefixes of the names of columns that hold various points."""
_LEAST_LASTING_SHARE: Final = 0.75  # least share of returns into the old column if IDs last over gaps
_FEWEST_EVENTS: Final = 10  # least number of gaps, or ghosts, whose mean length is a figure
_RARE_SHARE: Final = 0.002  # share of the frames in which nearer pairs are intersections of rays by chance
_CAPTURE_TO_GAP_RATIO: Final = 10.0  # least duration of a capture over that of gaps that it can show
# Fifth differences remove steady motion; the variance of noise in them is multiplied by the sum of squares.
_DIFFERENCE: Final = np.array([1.0, -5.0, 10.0, -10.0, 5.0, -1.0])


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredRoom:
    """Figures of an optical system that were measured in captures; None where captures do not show them."""

    num_frames: int
    """Number of frames that hold points."""
    num_markers: int
    """Number of markers, those of other things too; the most of all captures."""
    rate: float
    """Frames per second [Hz]."""
    noise: float | None
    """Standard deviation per axis of what changes from frame to frame, the median of all markers [m]."""
    missing: float
    """Share of the markers that have no point, over all frames with points."""
    gaps: tuple[float, ...] = field(repr=False)
    """Lengths of the gaps that begin and end in a capture [s]."""
    ghosts: float | None
    """Mean number of points in a frame that are no markers, within 100 mm of a marker."""
    ghost_time: float | None
    """Mean time that such a point stays without a break [s]."""
    nearest_pairs: Float[np.ndarray, "T"] = field(repr=False)
    """Distance of the nearest two points of each frame with two or more [m]."""
    id_time: float
    """Mean time that a marker's point stays in its column without a break [s]."""
    lasting_ids: bool | None
    """Whether a marker that returns has its old column."""
    untold: tuple[str, ...] = ()
    """Sentences on what the captures do not show."""

    @property
    def nearest(self) -> float:
        """Distance of the nearest two points in a frame, except in rare frames [m]."""
        return float(np.quantile(self.nearest_pairs, _RARE_SHARE))

    @property
    def is_labeled(self) -> bool:
        """Whether a column is a marker, also after gaps."""
        return bool(self.lasting_ids) or self.ghosts is None

    @property
    def shows_losses(self) -> bool:
        """Whether gaps are those of the optics: in a labeled capture with few gaps, others may be filled."""
        return not self.is_labeled or len(self.gaps) >= _FEWEST_EVENTS

    @property
    def gap_time(self) -> float | None:
        """Mean length of a gap [s]; None if there are too few."""
        return float(np.mean(self.gaps)) if len(self.gaps) >= _FEWEST_EVENTS else None


class _CaptureFigures(NamedTuple):
    """Figures of one capture, to be averaged over several."""

    rate: float
    markers: Bool[np.ndarray, "T M"]
    """Which markers have a point."""
    noise: list[float]
    """Noise of each marker [m]."""
    ghosts: Bool[np.ndarray, "T N"]
    """Which points are ghosts near a marker."""
    nearest_pairs: list[float]
    """Smallest distance of two points of each frame [m]."""
    stretches: int
    """Number of unbroken stretches of columns that hold markers."""
    old_columns: list[bool]
    """Whether each marker that returned had its old column."""


def measure_room(captures: AnyTrial | Sequence[AnyTrial]) -> MeasuredRoom:
    """Measure the optics of captures, for `handsim simulate --like`.

    Args:
        captures: Captures, takes or their paths, labeled or not: of one optical system and one glove.

    Returns:
        Figures of all captures together, lengths in [m] and times in [s].

    Raises:
        CaptureError: A capture cannot be read, or has fewer than two markers.
        ArgumentError: A capture has another type, or positions are not in meters.
    """
    given = [captures] if isinstance(captures, Capture | Take | str | Path) else captures
    check_type("captures", given, (list, tuple), f"{_A_TRIAL}, or a list of them")
    for trial in given:
        check_type("a capture", trial, (Capture, Take, str, Path), _A_TRIAL)
    if not given:
        raise CaptureError("no capture was given, expected one or more")
    return _combine([_figures_of_capture(one) for one in given])


def measure_simulated(take: Take) -> MeasuredRoom:
    """Measure the same figures of a simulated take by its true labels."""
    labels, ids = take.labels.astype(np.int64), take.ids.astype(np.int64)
    count = len(take.label_names)
    tracks = np.where(labels >= 0, labels, np.where(ids >= 0, ids + count, -1))
    changed = [False] * _FEWEST_EVENTS
    return _combine([_figures_of_tracks(take.points, tracks, np.arange(count), take.rate, changed)])


def _combine(seen: Sequence[_CaptureFigures]) -> MeasuredRoom:
    """Figures of several captures together."""
    num_frames = sum(len(one.markers) for one in seen)
    gaps = np.concatenate([run_lengths(~one.markers, inside=True) / one.rate for one in seen])
    flashes = np.concatenate([run_lengths(one.ghosts) / one.rate for one in seen])
    slots, points = sum(one.markers.size for one in seen), sum(int(one.markers.sum()) for one in seen)
    old_columns = [old for one in seen for old in one.old_columns]
    enough_gaps, enough_ghosts = (len(one) >= _FEWEST_EVENTS for one in (gaps, flashes))
    known = len(old_columns) >= _FEWEST_EVENTS
    lasting = bool(np.mean(old_columns) >= _LEAST_LASTING_SHARE) if known else None
    noise = [value for one in seen for value in one.noise]
    has_ghosts = len(flashes) > 0 or lasting is False
    longest = max(len(one.markers) / one.rate for one in seen) / _CAPTURE_TO_GAP_RATIO
    untold = {
        "ghosts: every point is a marker's, as where a capture was labeled": not has_ghosts,
        f"how long ghosts stay: only {len(flashes)} were seen": has_ghosts and not enough_ghosts,
        f"how long gaps last, or whether they were filled: only {len(gaps)} were seen": not enough_gaps,
        f"gaps of more than {longest:.2g} s: the captures are short": longest < _LONG_TRACK,
        "whether IDs last over gaps: few markers returned": lasting is None,
        "noise: no marker is seen in six frames in a row": not noise,
    }
    return MeasuredRoom(
        num_frames=num_frames,
        num_markers=max(one.markers.shape[1] for one in seen),
        rate=float(np.median([one.rate for one in seen])),
        noise=float(np.median(noise)) if noise else None,
        missing=float(1.0 - points / slots),
        gaps=tuple(gaps.tolist()),
        ghosts=sum(int(one.ghosts.sum()) for one in seen) / num_frames if has_ghosts else None,
        ghost_time=float(flashes.mean()) if enough_ghosts else None,
        nearest_pairs=np.concatenate([one.nearest_pairs for one in seen]),
        id_time=sum(one.markers.sum() / one.rate for one in seen) / sum(one.stretches for one in seen),
        lasting_ids=lasting,
        untold=tuple(sentence for sentence, holds in untold.items() if holds),
    )


def _figures_of_capture(source: AnyTrial) -> _CaptureFigures:
    """Figures of one capture."""
    name = f"{source}: " if isinstance(source, str | Path) else ""
    if isinstance(source, str | Path):
        is_take = str(source).lower().endswith((".npz", ".npz.part"))
        source = load_take(source) if is_take else read_capture(source)
    capture = source.capture() if isinstance(source, Take) else source
    check_unit(unlabeled_frames(capture))
    points = capture.positions[np.isfinite(capture.positions[..., 0]).any(axis=1)]
    tracks, old_columns = _follow_points(points, capture.rate)
    present, labeled = tracks >= 0, np.empty(0, dtype=np.int64)
    if len(old_columns) < _FEWEST_EVENTS or np.mean(old_columns) >= _LEAST_LASTING_SHARE:
        names = [name.rpartition(":")[2].strip().lower() for name in capture.names]
        whole = np.array([not name.startswith(_NAMELESS) for name in names])
        tracks[present] += len(whole)
        tracks[:, whole] = np.where(present[:, whole], np.flatnonzero(whole), -1)
        labeled = np.flatnonzero(whole & (present.sum(axis=0) > 0))
    lasts = np.flatnonzero(np.bincount(tracks[present]) >= _LEAST_MARKER_SHARE * len(points))
    markers = np.union1d(labeled, lasts)
    if len(markers) < 2:
        count = "only one marker stays" if len(markers) else "no marker stays"
        raise CaptureError(f"{name}{count} for half of the frames, expected the markers of a hand")
    return _figures_of_tracks(points, tracks, markers, capture.rate, old_columns)


def _figures_of_tracks(
    points: Float[np.ndarray, "T N 3"],
    tracks: Int[np.ndarray, "T N"],
    markers: Int[np.ndarray, "M"],
    rate: float,
    old_columns: list[bool],
) -> _CaptureFigures:
    """Figures of points whose tracks are known, and which of these are markers."""
    paths = np.full((len(points), len(markers), 3), np.nan)
    for number, marker in enumerate(markers):
        frame, column = np.nonzero(tracks == marker)
        paths[frame, number] = points[frame, column]
    present, is_marker = tracks >= 0, np.isin(tracks, markers)
    noise = [_noise(paths[:, number]) for number in range(len(markers))]
    return _CaptureFigures(
        rate,
        np.isfinite(paths[..., 0]),
        [one for one in noise if np.isfinite(one)],
        _near_markers(points, present & ~is_marker, is_marker),
        [_nearest_pair(one[seen]) for one, seen in zip(points, present, strict=True) if seen.sum() > 1],
        len(run_lengths(is_marker)),
        old_columns,
    )


def _follow_points(
    points: Float[np.ndarray, "T N 3"], rate: float
) -> tuple[Int[np.ndarray, "T N"], list[bool]]:
    """The track of each point, -1 without a point; and of each return, whether it was into the old column."""
    present = np.isfinite(points[..., 0])
    goes_on = np.zeros_like(present)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=2)  # NaN where one is missing
    goes_on[1:] = steps < _FASTEST_POINT / rate
    tracks, begun, old_columns = np.full(present.shape, -1), list[int](), list[bool]()
    lost = dict[int, tuple[int, int]]()  # last frame and column of each track that may return
    for t, now in enumerate(tracks):
        now[goes_on[t]] = tracks[t - 1, goes_on[t]]
        if t:
            ended = np.flatnonzero(present[t - 1] & ~goes_on[t])
            lost |= {int(tracks[t - 1, column]): (t - 1, int(column)) for column in ended}
        # A point may be missing for as long as it was there.
        patience = {one: max(end[0] - begun[one], _BRIEF_GAP * rate) for one, end in lost.items()}
        lost = {one: end for one, end in lost.items() if t - 1 - end[0] <= patience[one]}
        new = np.flatnonzero(present[t] & ~goes_on[t])
        while found := _match_lost_tracks(points, tracks, t, new[now[new] < 0], lost):
            for column, track in found.items():  # those that returned predict others better
                end, old = lost.pop(track)
                now[column] = track
                if t - end > 1:
                    old_columns.append(column == old)
        for column in new[now[new] < 0]:
            now[column] = len(begun)
            begun.append(t)
    return _join_tracks(tracks, rate), old_columns


def _join_tracks(tracks: Int[np.ndarray, "T N"], rate: float) -> NDArray[np.int64]:
    """Join long tracks that follow one another, of any markers: only lengths and gaps are measured."""
    numbers, first = np.unique(tracks.ravel(), return_index=True)
    last = tracks.size - 1 - np.unique(tracks.ravel()[::-1], return_index=True)[1]
    counts = np.bincount(tracks[tracks >= 0])
    begins, ends = (one[numbers >= 0] // tracks.shape[1] for one in (first, last))
    long = np.flatnonzero((counts >= _LONG_TRACK * rate) & (counts >= _LEAST_PRESENCE * (ends - begins + 1)))
    long = long[np.argsort(begins[long], kind="stable")]
    brief = int(_BRIEF_GAP * rate)
    chain = np.arange(len(counts)) + len(long)
    chain[long], _ = shared_columns(begins[long], np.maximum(ends[long] - brief, begins[long]))
    return np.asarray(np.append(chain, -1)[tracks])


def _match_lost_tracks(
    points: Float[np.ndarray, "T N 3"],
    tracks: Int[np.ndarray, "T N"],
    t: int,
    new: Int[np.ndarray, "K"],
    lost: dict[int, tuple[int, int]],
) -> dict[int, int]:
    """The lost track, by its last frame and column, of each new column of a frame that goes on with one."""
    if not len(new) or not lost:
        return {}
    names = list(lost)
    ahead = np.stack([_predict_point(points, tracks, t, *lost[name]) for name in names])
    distance = np.linalg.norm(ahead[:, None] - points[t, new], axis=2)
    pairs = zip(*linear_sum_assignment(np.minimum(distance, _RETURN_DISTANCE)), strict=True)
    return {int(new[column]): names[row] for row, column in pairs if distance[row, column] < _RETURN_DISTANCE}


def _predict_point(
    points: Float[np.ndarray, "T N 3"], tracks: Int[np.ndarray, "T N"], t: int, last: int, column: int
) -> Float[np.ndarray, "3"]:
    """Where the point of a column and of its last frame is at `t` [m], if it moves with those around it."""
    shared, before, now = np.intersect1d(tracks[last], tracks[t], return_indices=True)
    before, now = before[shared >= 0], now[shared >= 0]
    point = points[last, column]
    near = np.argsort(np.linalg.norm(points[last, before] - point, axis=1))[:_ANCHORS]
    source, target = points[last, before[near]], points[t, now[near]]
    if len(near) < 3:
        return np.asarray(point)
    rotation, translation = rigid_fit(source, target)
    return np.asarray(rotation @ point + translation)


def _noise(path: Float[np.ndarray, "T 3"]) -> float:
    """Standard deviation per axis of what changes from frame to frame [m]; motion enters it little."""
    if len(path) < len(_DIFFERENCE):
        return float("nan")
    steps = np.lib.stride_tricks.sliding_window_view(path, len(_DIFFERENCE), axis=0) @ _DIFFERENCE
    steps = steps[np.isfinite(steps)]
    scale = 1.4826 / np.sqrt((_DIFFERENCE**2).sum())  # of a median of normally distributed errors
    return float(scale * np.median(np.abs(steps))) if len(steps) else float("nan")


def _near_markers(
    points: Float[np.ndarray, "T N 3"], others: Bool[np.ndarray, "T N"], markers: Bool[np.ndarray, "T N"]
) -> NDArray[np.bool_]:
    """Which of the other points are near a marker of their frame."""
    near = np.zeros_like(others)
    for t in np.flatnonzero(others.any(axis=1) & markers.any(axis=1)):
        distance, _ = cKDTree(points[t, markers[t]]).query(points[t, others[t]])
        near[t, others[t]] = distance < GHOST_REACH
    return near


def _nearest_pair(cloud: Float[np.ndarray, "N 3"]) -> float:
    """Smallest distance of two points [m]."""
    return float(cKDTree(cloud).query(cloud, k=2)[0][:, 1].min())
