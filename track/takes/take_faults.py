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

from gloves.fit import GloveFit
from gloves.takes.take import HARDLY_SEEN, TRACKED, Take
from handsim.hand.angles import wrist_cardan
from handsim.hand.shape import JOINTS, Side
from track.alternatives.alternatives import Doubt, doubts_of
from track.alternatives.hands import other_hands_of
from track.hand_size import glove_shifts
from track.kinematics.pose_solver import FEWEST_MARKERS
from track.kinematics.pose_spread import are_still
from track.settings import USUAL_SIZE

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
_LAST_GAP: Final = 1.9  # [s] least time without a marker at the end, and least time before
_LONGER: Final = 3.0  # A last gap is reported if it is this many times the longest earlier gap.
_SEEN: Final = 0.5  # share of the earlier frames in which it was seen
AT_LIMIT: Final = 0.5
"""Tolerance within which a joint counts as being at its limit [deg]."""
_OFTEN_AT_LIMIT: Final = 0.4  # share of the frames at the limit
_OPEN: Final = 8.0  # [deg] standard deviation from which on the angle of a still joint is told
_LONG: Final = 5.0  # [s] A capture that is shorter shows little of what a hand does.
_RESTS: Final = 0.3  # A hand rests as a whole if this share of its joints hardly moves.
_MIDDLE: Final = float(np.deg2rad(80.0))  # [rad] of the pronation of forearms, whose range is 160 degrees
_FITTED_FRAMES: Final = 120  # number of frames in which a slip of the glove is fitted


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


@lru_cache(maxsize=1)  # A summary, its warnings and a report of a take ask one after the other.
def find_faults(take: Take) -> tuple[SuspectSpan, ...]:
    """Find the faults of a tracked take, each from the frame in which it begins."""
    found = [*_limbs(take)] if take.made_by_tracker else []
    every = [span for span, _ in take.worn()]
    longest = max(every, key=lambda span: np.count_nonzero(take.status[span] == TRACKED))
    for span in every:  # Other hands, or another size of them, have faults of their own.
        first = span.start
        part = take.cut(first, span.stop) if take.former else take
        # All wear the same glove: to compare its labels with others takes seconds, and is done once.
        faults = _faults_of_hands(part, is_last=span.stop == take.num_frames, judges=span is longest)
        found += (
            one._replace(first=first + one.first, last=first + one.last, worst=first + one.worst)
            for one in faults
        )
    return tuple(found)


def _limbs(take: Take) -> Iterator[SuspectSpan]:
    """Forearms and elbows of hands that are not there, or whose landmarks were exchanged."""

    def fault(name: str, why: str, remedy: str) -> SuspectSpan:
        return SuspectSpan(0, take.num_frames - 1, 0, f"the body '{name}'", why, remedy, of_labels=False)

    for body in take.bodies:
        for part, side in body.limb.items():
            if side not in take.sides:
                why = f"is the {part} of a {side} hand, which the take does not have"
                yield fault(body.name, why, "name the side of the hand in its file")
    for side in take.sides:
        forearm = take.forearm_index(side)
        if forearm is None or not take.bodies[forearm].has_axes:
            continue
        hands, forearms = take.arm_turns(side)
        for index, turns, middle, landmarks in (
            (forearm, hands, 0.0, "radial and ulnar styloid"),
            (take.elbow_index(side), forearms, _MIDDLE, "lateral and medial epicondyle"),
        ):
            turn = wrist_cardan(side, turns)[:, 2]
            turn = turn[np.isfinite(turn)]
            if index is not None and len(turn) and np.median(np.cos(turn - middle)) < 0.0:
                why = f"is turned by half a turn, as if {landmarks} were exchanged"
                yield fault(take.bodies[index].name, why, "give handsim body its --landmarks in their order")
                break


def _faults_of_hands(take: Take, *, is_last: bool, judges: bool) -> tuple[SuspectSpan, ...]:
    """The faults of a take with the same hands in all frames; others follow unless it is the last.

    Its labels are compared with others if it `judges`.
    """
    found, last = list[SuspectSpan](), take.num_frames - 1
    hands = [
        SuspectSpan(one.first, last, one.first, f"the {one.side} hand", one.why, one.remedy, of_labels=False)
        for one in other_hands_of(take)
    ]
    doubts = dict[Side, Doubt]()
    for number, side in enumerate(take.sides) if take.made_by_tracker else ():
        frames = np.flatnonzero(take.status[:, number] == TRACKED)
        if len(frames) < _FEWEST:
            continue
        frames = frames[:: -(-len(frames) // _MOST_FRAMES)]
        some = frames[:: -(-len(frames) // _FITTED_FRAMES)]
        seen = take.point_list.labeled(take.hand_labels[number], some)
        enough = np.isfinite(seen[..., 0]).sum(axis=1) >= FEWEST_MARKERS
        offsets = take.marker_offsets(side, frames)
        hand = _Hand(take, side, take.hands[number], frames, offsets, some[enough], seen[enough])
        # Hands that are not measured, or of a user whom another follows, do not fit, which looks like a slip.
        is_usual = (take.settings.get("size"), take.settings.get("user")) == ("auto", USUAL_SIZE)
        slips = () if is_usual or not is_last or take.settings.get("size_state") else (_slips,)
        doubts = doubts or (doubts_of(take) if judges else {})  # of all hands at once
        doubt = doubts.get(side)
        found += _alternatives(hand, doubt)
        angles = () if doubt is not None and doubt.is_wrong else (_at_limits, _still)
        for faults in (*slips, _fallen, *angles):
            found += faults(hand)
    return (*hands, *tuple({one.of: one for one in reversed(found)}.values())[::-1])


def _alternatives(hand: _Hand, doubt: Doubt | None) -> Iterator[SuspectSpan]:
    """Other labels that fit the whole take, and markers that are not where the layout has them."""
    for one in () if doubt is None else doubt.faults(hand.side, hand.worn.layout.names):
        last = hand.take.num_frames - 1
        yield SuspectSpan(0, last, int(hand.frames[0]), *one)


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
    """Markers that are hardly seen, or not from some time on, although their hand is."""
    take = hand.take
    seen = np.isfinite(take.observed(hand.side)[..., 0])
    shown = take.is_tracked(hand.side)
    gaps = [np.diff(np.flatnonzero(seen[:, marker])).max(initial=1) - 1 for marker in range(seen.shape[1])]
    for name, row, longest in zip(hand.worn.layout.names, seen.T, gaps, strict=True):
        share = row[shown].mean()
        if share < HARDLY_SEEN:
            if shown.sum() >= _LAST_GAP * take.rate:
                why = f"is seen in {100 * share:.1f} % of the hand's frames" if row.any() else "is never seen"
                yield hand.span(0, name, why, "compare the layout with the glove", of_labels=False)
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
        low, high = values < joint.low_deg + AT_LIMIT, values > joint.high_deg - AT_LIMIT
        for limit, there in ((joint.low_deg, low), (joint.high_deg, high)):
            if there.mean() > _OFTEN_AT_LIMIT:
                first = int(hand.frames[there.argmax()])
                share, start = 100 * there.mean(), hand.take.times[first]
                why = f"is at the model's limit, {limit:g} deg, in {share:.0f} % of frames from {start:.2f} s"
                remedy = "calibrate the hand, or do not use this angle"
                yield hand.span(first, joint.name, why, remedy, of_labels=False)


def _still(hand: _Hand) -> Iterator[SuspectSpan]:
    """Joints that do not move, so that angle and places of markers cannot be told apart."""
    spread, number = hand.take.angle_spread, hand.take.hand_index(hand.side)
    if spread is None:
        return
    spreads = np.rad2deg(np.median(spread[hand.frames, number], axis=0))
    still = are_still(hand.take.qpos[hand.frames, number, 7:])
    if np.ptp(hand.take.times[hand.frames]) < _LONG or still.mean() > _RESTS:
        return
    for joint in np.flatnonzero(still & (spreads > _OPEN)):
        name = JOINTS[joint].name
        why = f"hardly moves; the places of its markers tell its angle to {spreads[joint]:.0f} deg"
        remedy = f"measure the angle with a goniometer and name it, --known {name}=ANGLE"
        yield hand.span(int(hand.frames[0]), name, why, remedy, of_labels=False)
