"""Cleaning of captures: measured points stay; missing, held and doubled points and model outputs are dropped.

Programs write more than was measured: zeros or the last position in gaps, a marker once for each of two
subjects, model outputs among the markers, and a column for each piece of an unlabeled path. `settled` cleans
a capture of any format. `findings_sentence` describes what was dropped.
"""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from gloves.captures.capture import Capture, column_runs
from handsim.errors import CaptureError

OUTPUTS: Final = "model_outputs"
UNMARKED: Final = "marked_as_missing"
LEFT_OUT: Final = "left_out_by_mark"
PIECES: Final = "columns_of_pieces"
_ZEROS: Final = "zeros"
_STAND_INS: Final = "stand_ins"
_DOUBLED: Final = "doubled"
_HELD: Final = "held"
_STRAIGHT: Final = "interpolated"
_REPEATED: Final = "repeated_frames"
_SENTENCES: Final = {
    OUTPUTS: "{} columns are outputs of models, such as angles and forces, and are left out",
    UNMARKED: "all points are marked as missing (residual -1), and the {} with coordinates are read",
    LEFT_OUT: "{} points have coordinates and are marked as missing (residual -1), and are left out",
    PIECES: "{} columns hold pieces of unlabeled paths and are read as a few columns",
    _ZEROS: "{} points at exactly (0, 0, 0) are read as missing; if they are points, move the origin",
    _STAND_INS: "{} points stand for none, as (-1, -1, -1) or (0, 0, -1) do, and are read as missing",
    _DOUBLED: "{} points repeat another within 1 mm, as a marker of two subjects does, and are left out",
    _HELD: "{} points repeat their position while others move, as in gaps filled with the last one, and are "
    "read as missing",
    _STRAIGHT: "{} points move by equal steps, as in gaps that were interpolated, and are read as missing",
    _REPEATED: "{} frames repeat the one before, as where frames were lost or the rate was raised; motion "
    "jumps after them",
}
"""The kinds of findings, the keys of `Capture.findings`, in the order of `findings_sentence`."""
_OUTPUT_NAME: Final = re.compile(
    r".(?:Angle|Force|Moment|Power|Scalar)s?$|[_. -](?:angle|force|moment|power|scalar)s?$|"
    r"[_. -](?:ANGLE|FORCE|MOMENT|POWER|SCALAR)S?$"
)
"""Names that models give their outputs: RThumbAngles, LWristMoment, R_WRIST_ANGLE."""
_SAME_PLACE: Final = 1e-3  # distance within which two points are one [m]; the smallest markers are 1.5 mm
_SAME_PLACE_SHARE: Final = 5e-3
"""The same limit as a share of the extent of all points, for files that state a wrong unit."""
_JUMP_LENGTH: Final = 0.02
"""Least motion in a frame that counts as a jump [m]; three jumps to one place show a stand-in."""
_NEIGHBORS: Final = 8  # number of following points along a line that a point is compared with
_MIN_FRAMES: Final = 10  # Repetitions in fewer frames may be chance.
_MOVING_STEP: Final = 2e-5  # A marker that moves farther in a frame [m] was not at rest before it.
_MAX_BEND: Final = 3e-7  # Steps that differ by less than this [m] are equal up to rounding.
_FINE_GRID: Final = 1e-7  # [m] grid of coordinates below which measured steps are never equal
_COARSE_GRID: Final = 5e-6  # [m] grid of coordinates above which markers at rest repeat their positions
_GRID_STEPS: Final = 20.0  # A marker at rest moves by fewer grid steps in a frame.
_GRID_COUNT: Final = 10  # number of equal smallest steps that show a grid
_REST_RATIO: Final = 0.4
"""A marker starts abruptly if its first step is longer than this share of the second one."""


def findings_sentence(findings: Mapping[str, int]) -> str:
    """A sentence on the findings in a file; empty if there are none."""
    return "; ".join(text.format(findings[kind]) for kind, text in _SENTENCES.items() if findings.get(kind))


def settled(capture: Capture) -> Capture:
    """The measured points of a capture; its findings count the others, by kind."""
    capture = without_outputs(capture)
    counts = {}
    capture, counts[_ZEROS], counts[_STAND_INS] = _without_stand_ins(capture)
    if capture.num_frames >= _MIN_FRAMES:
        capture, counts[_DOUBLED] = _without_doubles(capture)
        for kind, found in ((_HELD, _held_points), (_STRAIGHT, _interpolated_points)):
            filled = found(capture.positions)
            counts[kind] = int(filled.sum())
            if filled.any():
                positions = np.where(filled[..., None], np.nan, capture.positions)
                capture = dataclasses.replace(capture, positions=positions)
        counts[_REPEATED] = _repeated_frames(capture.positions)
    findings = Counter(capture.findings) + Counter(counts)  # the sum drops counts of zero
    return dataclasses.replace(capture, findings=dict(findings))


def without_outputs(capture: Capture, listed: Sequence[str] = ()) -> Capture:
    """The capture without columns that are listed as outputs of a model, or named as such.

    The list or the columns may lack a subject's prefix ("Anna:RThumbAngles").
    """
    whole, bare = set(listed), {name.rpartition(":")[2] for name in listed}
    kept = [
        column
        for column, name in enumerate(capture.names)
        if not (
            name in whole
            or (name in bare if ":" not in name else name.rpartition(":")[2] in whole)
            or _OUTPUT_NAME.search(name)
        )
    ]
    count = len(capture.names) - len(kept)
    if not count:
        return capture
    if not kept:
        raise CaptureError(
            f"no markers: all {count} columns are outputs of models, such as angles and forces"
        )
    return dataclasses.replace(
        capture,
        names=tuple(capture.names[column] for column in kept),
        positions=capture.positions[:, kept],
        findings={**capture.findings, OUTPUTS: count + capture.findings.get(OUTPUTS, 0)},
    )


def _without_stand_ins(capture: Capture) -> tuple[Capture, int, int]:
    """Drop stand-ins for missing points; also count those at (0, 0, 0), and those elsewhere.

    Some programs write (0, 0, 0), (-1, -1, -1), (9999, 9999, 9999) or (0, 0, -1) for a missing point. A
    measured point never repeats a position with three equal coordinates, and markers do not jump again and
    again to a place that none moves to. A capture in which nothing moves stays unchanged, unless two points
    of a frame are equal.
    """
    positions = capture.positions
    equal = (positions == positions[..., :1]).all(axis=-1)
    values, counts = np.unique(positions[equal, 0], return_counts=True)
    repeats = (counts > 1) & ((values == 0.0) | (capture.num_frames >= _MIN_FRAMES))
    keys = (positions * [1.0, np.pi, np.e]).sum(axis=-1)  # different positions have different ones
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=-1)
    near = keys[1:][(steps > 0.0) & (steps <= _JUMP_LENGTH)]
    frames, columns = np.nonzero(steps > _JUMP_LENGTH)
    aims = np.unique(np.stack([keys[frames + 1, columns], frames]), axis=1)
    aims, counts = np.unique(aims[0], return_counts=True)
    equal &= np.isin(positions[..., 0], values[repeats])
    places = aims[(counts > 2) & ~np.isin(aims, near)]
    stands = equal | (np.isin(keys, places) & (capture.num_frames >= _MIN_FRAMES))
    there = np.isfinite(positions[..., 0]) & ~stands
    tracks = (positions[there[:, column], column] for column in range(positions.shape[1]))
    # two markers are never at one place; a file of nothing else is refused elsewhere
    alike = bool(there.any()) and int(equal.sum(axis=1).max(initial=0)) > 1
    moves = any((track != track[:1]).any() for track in tracks)
    if not stands.any() or not (alike or moves):
        return capture, 0, 0
    zeros = int((equal & (positions[..., 0] == 0.0)).sum())
    missing = np.where(stands[..., None], np.nan, positions)
    return dataclasses.replace(capture, positions=missing), zeros, int(stands.sum()) - zeros


def _without_doubles(capture: Capture) -> tuple[Capture, int]:
    """Drop points that repeat another point of their frame, and count them.

    Two columns that agree in every frame in which both have a point are merged.
    """
    positions = capture.positions
    there = np.isfinite(positions[..., 0]) & (positions != 0.0).any(axis=-1)  # zeros: nothing moves
    key = np.where(there, positions @ np.array([0.48, 0.6, 0.64]), np.nan)  # no farther apart than the points
    order = np.argsort(key, axis=1, kind="stable")
    ranked = np.take_along_axis(key, order, axis=1)
    if not there.any():
        return capture, 0
    near = min(_SAME_PLACE, _SAME_PLACE_SHARE * float(np.ptp(positions[there], axis=0).max(initial=0.0)))
    found = []
    for lag in range(1, min(_NEIGHBORS, len(capture.names) - 1) + 1):
        frames, ranks = np.nonzero(ranked[:, lag:] - ranked[:, :-lag] <= near)
        pair = np.sort(np.stack([order[frames, ranks], order[frames, ranks + lag]]), axis=0)
        apart = np.linalg.norm(positions[frames, pair[0]] - positions[frames, pair[1]], axis=-1)
        found.append(np.stack([frames, *pair])[:, apart <= near])
    frames, first, second = np.concatenate(found, axis=1) if found else np.empty((3, 0), dtype=np.int64)
    if not len(frames):
        return capture, 0
    positions = positions.copy()
    positions[frames, second] = np.nan
    doubled = int((there & np.isnan(positions[..., 0])).sum())
    kept = np.arange(len(capture.names))  # the column that each column's points belong to
    pairs, counts = np.unique(np.stack([first, second], axis=1), axis=0, return_counts=True)
    for (one, other), count in zip(pairs.tolist(), counts.tolist(), strict=True):
        if count >= _MIN_FRAMES and count == int((there[:, one] & there[:, other]).sum()):
            kept[kept == kept[other]] = kept[one]
    for column in np.flatnonzero(kept != np.arange(len(kept))).tolist():
        moved = np.isfinite(positions[:, column, 0]) & np.isnan(positions[:, kept[column], 0])
        positions[moved, kept[column]] = positions[moved, column]
    left = np.unique(kept)
    names = tuple(capture.names[column] for column in left.tolist())
    return dataclasses.replace(capture, names=names, positions=positions[:, left]), doubled


def _held_points(positions: Float[np.ndarray, "T N 3"]) -> Bool[np.ndarray, "T N"]:
    """Points that repeat the last position in a gap, or the first one before the marker appeared.

    Such a marker stops and starts abruptly. One that rests slows down and speeds up, and does not repeat its
    position to the last digit, unless the capture is simulated or its digits are few.
    """
    num_frames, num_columns = positions.shape[:2]
    moves = np.diff(positions, axis=0)
    repeated = (moves == 0.0).all(axis=-1)
    if not repeated.any():
        return np.zeros((num_frames, num_columns), dtype=np.bool_)
    steps = np.full((num_frames + 3, num_columns), np.nan)  # two frames without a step at each end
    steps[2:-2] = np.linalg.norm(moves, axis=-1)
    grid = _grid_step(moves)
    abrupt = max(_MOVING_STEP, _GRID_STEPS * grid)

    columns, first, last = column_runs(repeated)
    last += 1  # the last frame of a run of equal positions
    ends = [
        np.where(step > _REST_RATIO * np.nan_to_num(steps[beyond, columns]), step, 0.0)
        for at, beyond in ((first + 1, first), (last + 2, last + 3))
        for step in (steps[at, columns],)
    ]
    known = [np.isfinite(steps[at, columns]) for at in (first + 1, last + 2)]
    abruptly = [end > abrupt for end in ends]
    if grid > _COARSE_GRID:  # a marker at rest repeats its position, and may be stopped abruptly by an object
        held = (known[0] | known[1]) & (abruptly[0] | ~known[0]) & (abruptly[1] | ~known[1])
        held &= last > first + 1
    else:
        held = abruptly[0] | abruptly[1]
    alive = (steps[2:-2] > 0.0).any(axis=1)
    for _ in range(2):
        others = np.concatenate([[0], np.cumsum(alive)])
        chosen = held & (others[last] > others[first])
        marks = np.zeros((num_frames + 1, num_columns), dtype=np.int32)
        # a run in the first frames is held throughout; in other runs the first point was measured
        marks[(first + (first > 0))[chosen], columns[chosen]] += 1
        marks[last[chosen] + 1, columns[chosen]] -= 1
        missing = np.cumsum(marks, axis=0)[:-1] > 0
        alive |= missing[1:].any(axis=1)  # if one point is held where nothing moves, all others are, too
    return missing


def _repeated_frames(positions: Float[np.ndarray, "T N 3"]) -> int:
    """Number of frames that repeat all points of the one before; 0 if nothing ever moves."""
    before, after = positions[:-1], positions[1:]
    there = np.isfinite(after).any(axis=(1, 2))
    repeats = ((before == after) | (np.isnan(before) & np.isnan(after))).all(axis=(1, 2))
    return int((repeats & there).sum()) if (there & ~repeats).any() else 0


def _interpolated_points(positions: Float[np.ndarray, "T N 3"]) -> Bool[np.ndarray, "T N"]:
    """Points of gaps of three frames or more that were filled along a line, by equal steps.

    Measured steps are never equal, but rounded ones are, and those of simulated motion without noise.
    """
    missing = np.zeros(positions.shape[:2], dtype=np.bool_)
    moves = np.diff(positions, axis=0)
    if _grid_step(moves) > _FINE_GRID:
        return missing
    # differences of the second to the fourth order, NaN beside a gap; only those of noise grow with the order
    bend, third, fourth = (np.linalg.norm(np.diff(moves, order, axis=0), axis=-1) for order in (1, 2, 3))
    measured = bend[2:] > _MAX_BEND
    noisy = (measured & (fourth > third[1:])).sum(axis=0) > (measured & (fourth <= third[1:])).sum(axis=0)
    straight = noisy & (bend < _MAX_BEND) & (np.linalg.norm(moves[1:], axis=-1) > _MOVING_STEP)
    three = straight[2:] & straight[1:-1] & straight[:-2]
    for begin in range(3):
        missing[1 + begin : len(three) + 1 + begin] |= three
    return missing


def _grid_step(moves: Float[np.ndarray, "T-1 N 3"]) -> float:
    """The step [m] of the grid that coordinates are rounded to; 0 if none shows."""
    sizes = np.abs(moves[np.isfinite(moves) & (moves != 0.0)])
    smallest = float(sizes.min(initial=np.inf))
    return smallest if int((sizes < 1.3 * smallest).sum()) >= _GRID_COUNT else 0.0
