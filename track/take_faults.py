"""Faults of a tracked take beyond single labels: in its glove, and in the sides of its hands.

The layout may not fit, a glove may slip, a marker may fall off, or a symmetric glove may leave the side of a
hand open. Each fault is a span of frames with a sentence that names marker or hand, and the time.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from gloves.fit import GloveFit
from gloves.takes.take import TRACKED, Take
from handsim.hand.shape import JOINTS, PALM, Side
from handsim.space.transforms import rigid_fit
from track.hand_size import glove_shifts, glued_offsets
from track.kinematics.pose_solver import FEWEST_MARKERS, PoseSolver
from train.labelers.matching import assign

_FEWEST: Final = 60  # Faults are looked for from this many tracked frames of a hand on.
_MOST_FRAMES: Final = 2000  # largest number of examined frames of a hand
_FARTHEST: Final = 0.02  # [m] offsets of markers are clipped here
_PART: Final = 60  # least number of a marker's frames before and after a slip
# A slip shifts a marker for good; shifts by flesh and posture, of up to 3 mm, are temporary.
_SLIP: Final = 0.0035  # [m] least reported shift of a marker
_SLIP_SHARE: Final = 0.55  # least share of the variance of its offsets that the shift explains
_SMALL_SLIP: Final = 0.0008  # [m] the same for a steady marker: the pose absorbs most of a slip
_SMALL_SHARE: Final = 0.85  # least explained share for such a small shift
_GLOVE_SLIP: Final = 0.0025  # [m] smallest slip of a whole glove that is reported
_SURE: Final = 2.75  # smallest such slip in standard deviations
_SLIP_PART: Final = 1.9  # [s] least time before and after a slip
_LEAST_VARIANCE: Final = 1e-8  # [m^2] noise of optical systems
_OFTEN_MISSING: Final = 0.3  # A marker missing in this share of the frames is looked for elsewhere.
_ELSEWHERE: Final = 0.028  # [m] largest distance of a misplaced marker from its place
_MISPLACED: Final = 0.008  # [m] least reported distance from its place
_STEADY: Final = 0.006  # [m] radius within which a point fixed to a bone stays in the bone's frame
_OFTEN: Final = 0.5  # share of the frames without the marker that show such a point
_TRIED: Final = 100  # number of unlabeled points tried as its center
_OFF_DESIGN: Final = 0.012  # [m] least reported distance of a fitted place from the layout's
_LAST_GAP: Final = 1.9  # [s] least time without a marker at the end, and least time before
_LONGER: Final = 3.0  # A last gap is reported if it is this many times the longest earlier gap.
_SEEN: Final = 0.5  # share of the earlier frames in which it was seen
AT_LIMIT: Final = 0.5
"""Tolerance within which a joint counts as being at its limit [deg]."""
_OFTEN_AT_LIMIT: Final = 0.4  # share of the frames at the limit
_FITTED_FRAMES: Final = 120  # number of frames in which a slip of the glove is fitted
_FEWER: Final = 3  # The layout, and the mirror image of a hand, are fitted in every third of them.
_FITS: Final = 1.5  # largest ratio of the mirror image's RMS distance to that of the hand
_FITS_WELL: Final = 0.0012  # [m] the mirror image fits if its RMS distance is below this


class SuspectSpan(NamedTuple):
    """Frames that deserve a look, and the reason."""

    first: int
    last: int
    """The last frame, inclusive."""
    worst: int
    """The frame to look at first."""
    of: str
    """The side of a hand, or the name of a label."""
    why: str
    """The reason, as a predicate for `of`."""
    remedy: str = ""
    """Remedy of a fault of the whole take; empty for a doubtful label."""
    of_labels: bool = True
    """Whether labels are in doubt in these frames, not only angles."""

    @property
    def words(self) -> str:
        """The whole sentence: `of` and `why`."""
        return f"{self.of} {self.why}"


class _Hand(NamedTuple):
    """A tracked hand of a take, in some of its frames (F)."""

    take: Take
    side: Side
    worn: GloveFit
    frames: Int[np.ndarray, "F"]
    offsets: Float[np.ndarray, "F M 3"]  # [m] of seen markers from their places, in the bones' frames
    some: Int[np.ndarray, "S"]  # those of these frames that show enough markers for a pose, at most 120
    seen: Float[np.ndarray, "S M 3"]  # markers in these [m]

    def span(self, first: int, name: str, why: str, remedy: str, *, of_labels: bool = True) -> SuspectSpan:
        """A fault from frame `first` to the end, of a marker or joint; of the whole hand without `name`."""
        of = f"{self.side}:{name}" if name else f"the {self.side} hand"
        return SuspectSpan(first, self.take.num_frames - 1, first, of, why, remedy, of_labels)

    def off_place(self, name: str, off: float, first: int) -> SuspectSpan:
        """The fault of a marker that is `off` [m] from its place in the layout."""
        why = f"is {1e3 * off:.0f} mm from where the layout has it, from {self.take.times[first]:.2f} s on"
        return self.span(first, name, why, "correct its place in the layout's file")


@lru_cache(maxsize=1)  # A summary, its warnings and a report of a take ask one after the other.
def find_faults(take: Take) -> tuple[SuspectSpan, ...]:
    """Find the faults of a tracked take, each from the frame in which it begins."""
    found: list[SuspectSpan] = []
    for number, side in enumerate(take.sides) if take.made_by_tracker else ():
        frames = np.flatnonzero(take.status[:, number] == TRACKED)
        frames = frames[frames >= _first_of_size(take)]
        if len(frames) < _FEWEST:
            continue
        frames = frames[:: -(-len(frames) // _MOST_FRAMES)]
        some = frames[:: -(-len(frames) // _FITTED_FRAMES)]
        seen = take.point_list.labeled(take.hand_labels[number], some)
        enough = np.isfinite(seen[..., 0]).sum(axis=1) >= FEWEST_MARKERS
        offsets = take.marker_offsets(side, frames)
        hand = _Hand(take, side, take.hands[number], frames, offsets, some[enough], seen[enough])
        for faults in (_unsure_side, _misplaced, _off_design, _slips, _fallen, _at_limits):
            found += faults(hand)
    return tuple({one.of: one for one in reversed(found)}.values())[::-1]


def _first_of_size(take: Take) -> int:
    """The first frame with the final size of the hands, which a live tracker measures on the way."""
    match take.settings.get("sizes"):
        case [*_, [int(first), *_]]:
            return first
    return 0


def _slips(hand: _Hand) -> Iterator[SuspectSpan]:
    """The slip of the marker with the clearest lasting shift, or that of the whole glove if there is none."""
    known = np.isfinite(hand.offsets[..., 0])
    values = np.where(known[..., None], hand.offsets.clip(-_FARTHEST, _FARTHEST), 0.0)
    before, sums = np.cumsum(known, axis=0), np.cumsum(values, axis=0)
    total, whole = np.maximum(before[-1], 1), sums[-1]
    after = before[-1] - before
    early, late = sums / np.maximum(before, 1)[..., None], (whole - sums) / np.maximum(after, 1)[..., None]
    steps = np.where(np.minimum(before, after) < _PART, 0.0, np.linalg.norm(late - early, axis=-1))
    variance = np.square(values).sum(axis=(0, 2)) - np.square(whole).sum(axis=1) / total
    explained = before * after / total * steps**2
    share = explained / np.maximum(variance, _LEAST_VARIANCE * total)
    share *= ((steps > _SLIP) & (share > _SLIP_SHARE)) | ((steps > _SMALL_SLIP) & (share > _SMALL_SHARE))
    share *= _is_amid(hand.take.times[hand.frames])[:, None]
    when, marker = np.unravel_index(int(share.argmax()), share.shape)
    remedy = "track the frames before and after apart, each with a calibration of its own"
    if share[when, marker] > 0.0:
        frame, name = int(hand.frames[when]), hand.worn.layout.names[marker]
        why = f"slips by {1e3 * steps[when, marker]:.1f} mm or more at {hand.take.times[frame]:.2f} s"
        yield hand.span(frame, name, why, remedy, of_labels=False)
    elif (amid := _is_amid(hand.take.times[hand.some])).any():
        shifts, sure = glove_shifts(hand.seen, hand.worn)
        at = int(np.where(amid, np.abs(sure), 0.0).argmax())
        if abs(sure[at]) > _SURE and abs(shifts[at]) > _GLOVE_SLIP:
            frame = int(hand.some[at])
            why = f"slips by {1e3 * abs(shifts[at]):.1f} mm or more at about {hand.take.times[frame]:.1f} s"
            fault = hand.span(frame, "", why, remedy, of_labels=False)
            yield fault._replace(of=f"the {hand.side} glove")


def _is_amid(times: Float[np.ndarray, "F"]) -> Bool[np.ndarray, "F"]:
    """Whether each time [s] is long enough after the first and before the last for a slip."""
    return np.asarray(np.minimum(times - times[:1], times[-1:] - times) >= _SLIP_PART)


def _fallen(hand: _Hand) -> Iterator[SuspectSpan]:
    """Markers that are not seen from some time on, although their hand is."""
    take = hand.take
    seen = np.isfinite(take.observed(hand.side)[..., 0])
    shown = take.is_tracked(hand.side)
    gaps = [np.diff(np.flatnonzero(seen[:, marker])).max(initial=1) - 1 for marker in range(seen.shape[1])]
    for name, row, longest in zip(hand.worn.layout.names, seen.T, gaps, strict=True):
        if not row.any():
            if shown.sum() >= _LAST_GAP * take.rate:
                remedy = "compare the layout with the glove"
                yield hand.span(0, name, "is never seen", remedy, of_labels=False)
            continue
        begin = take.num_frames - int(row[::-1].argmax())
        gap = float(shown[begin:].sum()) / take.rate
        least = max(_LAST_GAP, _LONGER * longest / take.rate, max(gaps) / take.rate)
        is_usual = begin >= _LAST_GAP * take.rate and row[:begin][shown[:begin]].mean() >= _SEEN
        if gap >= least and is_usual:
            why = f"is not seen after {take.times[begin - 1]:.2f} s, for {gap:.1f} s to the end"
            yield hand.span(begin, name, why, "look for the marker that fell off", of_labels=False)


def _at_limits(hand: _Hand) -> Iterator[SuspectSpan]:
    """Joints at the limit of the model's range in many frames, which may have gone beyond."""
    angles = np.rad2deg(hand.take.qpos[hand.frames, hand.take.hand_index(hand.side), 7:])
    for joint, values in zip(JOINTS, angles.T, strict=True):
        low, high = values < joint.low + AT_LIMIT, values > joint.high - AT_LIMIT
        for limit, there in ((joint.low, low), (joint.high, high)):
            if there.mean() > _OFTEN_AT_LIMIT:
                first = int(hand.frames[there.argmax()])
                share, start = 100 * there.mean(), hand.take.times[first]
                why = f"is at the model's limit, {limit:g} deg, in {share:.0f} % of frames from {start:.2f} s"
                remedy = "calibrate the hand, or do not use this angle"
                yield hand.span(first, joint.name, why, remedy, of_labels=False)


def _misplaced(hand: _Hand) -> Iterator[SuspectSpan]:
    """Markers misplaced on their bone: an unlabeled point moves with the bone instead."""
    take, worn = hand.take, hand.worn
    missing = np.isnan(hand.offsets[..., 0])
    bones = worn.model.forward_kinematics(take.qpos[hand.frames, take.hand_index(hand.side)])
    places = worn.attachment.centers(worn.model, bones)
    enough = max(_OFTEN_MISSING, _LAST_GAP * take.rate / take.num_frames)
    for marker in np.flatnonzero(missing.mean(axis=0) > enough):
        rows = np.flatnonzero(missing[:, marker])
        poses = bones[rows, worn.attachment.main_bones[marker]]
        found, owners = list[NDArray[np.float64]](), list[int]()
        for row, pose in zip(rows, poses, strict=True):
            part = take.point_list.of(int(hand.frames[row]))
            free = take.point_list.points[part][take.point_list.labels[part] < 0]
            off = (free - places[row, marker]) @ pose[:3, :3]
            off = off[np.linalg.norm(off, axis=1) < _ELSEWHERE]
            found.append(off)
            owners += [int(row)] * len(off)
        every, frames = np.concatenate(found), np.array(owners)
        tried = every[:: max(1, len(every) // _TRIED)]
        steady = [np.linalg.norm(every - one, axis=1) < _STEADY for one in tried]
        if not steady:
            continue
        best = max(steady, key=lambda near: len(np.unique(frames[near])))
        share, far = len(np.unique(frames[best])) / len(rows), np.linalg.norm(np.median(every[best], axis=0))
        if share > _OFTEN and far > _MISPLACED:
            yield hand.off_place(worn.layout.names[marker], float(far), int(hand.frames[rows[0]]))


def _off_design(hand: _Hand) -> Iterator[SuspectSpan]:
    """Markers on the palm whose places on the moving hand are far from those in the layout.

    On digits the length of a bone explains the same offsets where joints hardly turn.
    """
    on_palm = np.flatnonzero(hand.worn.attachment.main_bones == PALM)
    if not len(hand.seen) or not len(on_palm):
        return
    off = glued_offsets(hand.seen[::_FEWER], hand.worn)
    for marker in on_palm[off[on_palm] > _OFF_DESIGN]:
        yield hand.off_place(hand.worn.layout.names[marker], float(off[marker]), int(hand.frames[0]))


def _unsure_side(hand: _Hand) -> Iterator[SuspectSpan]:
    """A hand in a glove like its mirror image, that a hand of the other side fits as well in motion."""
    worn, seen = hand.worn, hand.seen[::_FEWER]
    if not len(seen):
        return
    other: Side = "left" if hand.side == "right" else "right"
    ours = np.median(PoseSolver(worn).solve(seen).rms)
    mirrored = worn.with_side(other)
    theirs = min(
        np.median(PoseSolver(mirrored).solve(seen[:, order]).rms) for order in _exchanges(worn, mirrored)
    )
    if theirs < max(_FITS * ours, _FITS_WELL):
        why = f"may be the {other} one: that fits the points to {1e3 * theirs:.1f} mm, this {1e3 * ours:.1f}"
        yield hand.span(0, "", why, "make the glove less like its mirror image, or name the hand (--hands)")


def _exchanges(worn: GloveFit, mirrored: GloveFit) -> Iterator[Int[np.ndarray, "M"]]:
    """Orders in which the other hand's markers may be ours: with thumb side, or back and palm, exchanged."""
    ours, theirs = worn.attachment.points, mirrored.attachment.points
    for turn in (np.eye(3), np.diag([1.0, -1.0, -1.0])):
        moved = theirs @ turn
        order = np.arange(len(ours))
        for _ in range(5):
            shift = ours.mean(axis=0) - moved.mean(axis=0)
            costs = np.square(moved[:, None] + shift - ours).sum(axis=2)
            _, order = assign(costs, np.full(len(ours), 1.0))
            rotation, translation = rigid_fit(theirs, ours[order])
            moved = theirs @ rotation.T + translation
        yield order
