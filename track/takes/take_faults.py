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

_FEWEST_FRAMES: Final = 60  # A hand is examined if it has this many tracked frames.
_MOST_FRAMES: Final = 2000  # largest number of examined frames of a hand
_MOST_OFFSET: Final = 0.02  # [m] Offsets of markers are clipped to this.
_FEWEST_BESIDE: Final = 60  # least number of a marker's frames before and after a slip
# A slip shifts a marker for good; flesh and posture shift it by up to 3 mm for a while.
_BIG_SLIP: Final = 0.0035  # [m] least reported shift of a marker
_BIG_SHARE: Final = 0.55  # least share of the variance of its offsets that the shift explains
_SMALL_SLIP: Final = 0.0008  # [m] least shift of a steady marker, as the pose absorbs most of a slip
_SMALL_SHARE: Final = 0.85  # least explained share for such a small shift
_LEAST_GLOVE_SLIP: Final = 0.0025  # [m] smallest slip of a whole glove that is reported
_LEAST_GLOVE_RATIO: Final = 2.75  # smallest reported slip of a glove, in standard deviations
_TIME_BESIDE_SLIP: Final = 1.9  # [s] least time before and after a slip
_LEAST_VARIANCE: Final = 1e-8  # [m^2] noise of optical systems
_LAST_GAP: Final = 1.9  # [s] least time without a marker at the end, and least time before
_LAST_GAP_RATIO: Final = 3.0  # A reported last gap is this many times the longest earlier gap.
_LEAST_SEEN_SHARE: Final = 0.5  # The marker was seen in this share of the earlier frames.
AT_LIMIT_DEG: Final = 0.5
"""Tolerance within which a joint counts as being at its limit [deg]."""
_LIMIT_SHARE: Final = 0.4  # share of the frames at the limit
# [deg] A still joint is reported if its angle has a larger standard deviation.
_LEAST_SPREAD_DEG: Final = 8.0
_LEAST_DURATION: Final = 5.0  # [s] A shorter capture shows too little motion to call joints still.
_MOST_STILL_SHARE: Final = 0.3  # If a larger share of the joints is still, the whole hand rests.
_MIDDLE_PRONATION: Final = float(np.deg2rad(80.0))  # [rad] middle of the range of a forearm's pronation
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
    some: Int[np.ndarray, "S"]  # at most 120 of these frames, with enough markers for a pose
    seen: Float[np.ndarray, "S M 3"]  # markers in frames `some` [m]

    def span(self, first: int, name: str, why: str, remedy: str, *, of_labels: bool = True) -> SuspectSpan:
        """A fault from frame `first` to the end, of the marker or joint `name`; if empty, of the hand."""
        of = f"{self.side}:{name}" if name else f"the {self.side} hand"
        return SuspectSpan(first, self.take.num_frames - 1, first, of, why, remedy, of_labels)


@lru_cache(maxsize=1)  # A summary, its warnings and a report of a take ask one after the other.
def find_faults(take: Take) -> tuple[SuspectSpan, ...]:
    """Find the faults of a tracked take, each from the frame in which it begins."""
    found = [*_limb_faults(take)] if take.made_by_tracker else []
    every = [span for span, _ in take.worn()]
    longest = max(every, key=lambda span: np.count_nonzero(take.status[span] == TRACKED))
    for span in every:  # Each person's or size's hands have their own faults.
        first = span.start
        part = take.cut(first, span.stop) if take.former else take
        # Comparing the glove's labels with others takes seconds, and is done once, as all wear the same
        # glove.
        faults = _faults_of_hands(part, is_last=span.stop == take.num_frames, judges=span is longest)
        found += (
            one._replace(first=first + one.first, last=first + one.last, worst=first + one.worst)
            for one in faults
        )
    return tuple(found)


def _limb_faults(take: Take) -> Iterator[SuspectSpan]:
    """Faults of forearms and elbows: their hand is missing, or their landmarks were exchanged."""

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
            (take.elbow_index(side), forearms, _MIDDLE_PRONATION, "lateral and medial epicondyle"),
        ):
            turn = wrist_cardan(side, turns)[:, 2]
            turn = turn[np.isfinite(turn)]
            if index is not None and len(turn) and np.median(np.cos(turn - middle)) < 0.0:
                why = f"is turned by half a turn, as if {landmarks} were exchanged"
                yield fault(take.bodies[index].name, why, "give handsim body its --landmarks in their order")
                break


def _faults_of_hands(take: Take, *, is_last: bool, judges: bool) -> tuple[SuspectSpan, ...]:
    """The faults of a take with the same hands in all frames; other hands follow unless `is_last`.

    With `judges` its labels are compared with alternatives.
    """
    found, last = list[SuspectSpan](), take.num_frames - 1
    hands = [
        SuspectSpan(one.first, last, one.first, f"the {one.side} hand", one.why, one.remedy, of_labels=False)
        for one in other_hands_of(take)
    ]
    doubts = dict[Side, Doubt]()
    for number, side in enumerate(take.sides) if take.made_by_tracker else ():
        frames = np.flatnonzero(take.status[:, number] == TRACKED)
        if len(frames) < _FEWEST_FRAMES:
            continue
        frames = frames[:: -(-len(frames) // _MOST_FRAMES)]
        some = frames[:: -(-len(frames) // _FITTED_FRAMES)]
        seen = take.point_list.labeled(take.hand_labels[number], some)
        enough = np.isfinite(seen[..., 0]).sum(axis=1) >= FEWEST_MARKERS
        offsets = take.marker_offsets(side, frames)
        hand = _Hand(take, side, take.hands[number], frames, offsets, some[enough], seen[enough])
        # Unmeasured hands, and hands before a change of user, do not fit, which looks like a slip.
        is_unmeasured = (take.settings.get("size"), take.settings.get("user")) == ("auto", USUAL_SIZE)
        slips = () if is_unmeasured or not is_last or take.settings.get("size_state") else (_slips,)
        doubts = doubts or (doubts_of(take) if judges else {})  # of all hands at once
        doubt = doubts.get(side)
        found += _label_faults(hand, doubt)
        angles = () if doubt is not None and doubt.is_wrong else (_joints_at_limits, _still_joints)
        for faults in (*slips, _fallen_markers, *angles):
            found += faults(hand)
    return (*hands, *tuple({one.of: one for one in reversed(found)}.values())[::-1])


def _label_faults(hand: _Hand, doubt: Doubt | None) -> Iterator[SuspectSpan]:
    """Faults of labels in the whole take, and of markers that are not where the layout has them."""
    for one in () if doubt is None else doubt.faults(hand.side, hand.worn.layout.names):
        last = hand.take.num_frames - 1
        yield SuspectSpan(0, last, int(hand.frames[0]), *one)


def _slips(hand: _Hand) -> Iterator[SuspectSpan]:
    """The slip of the marker with the clearest lasting shift; if there is none, that of the whole glove."""
    known = np.isfinite(hand.offsets[..., 0])
    values = np.where(known[..., None], hand.offsets.clip(-_MOST_OFFSET, _MOST_OFFSET), 0.0)
    before, sums = np.cumsum(known, axis=0), np.cumsum(values, axis=0)
    total, whole = np.maximum(before[-1], 1), sums[-1]
    after = before[-1] - before
    early, late = sums / np.maximum(before, 1)[..., None], (whole - sums) / np.maximum(after, 1)[..., None]
    steps = np.where(np.minimum(before, after) < _FEWEST_BESIDE, 0.0, np.linalg.norm(late - early, axis=-1))
    variance = np.square(values).sum(axis=(0, 2)) - np.square(whole).sum(axis=1) / total
    explained = before * after / total * steps**2
    share = explained / np.maximum(variance, _LEAST_VARIANCE * total)
    share *= ((steps > _BIG_SLIP) & (share > _BIG_SHARE)) | ((steps > _SMALL_SLIP) & (share > _SMALL_SHARE))
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
        if abs(sure[at]) > _LEAST_GLOVE_RATIO and abs(shifts[at]) > _LEAST_GLOVE_SLIP:
            frame = int(hand.some[at])
            why = f"slips by {1e3 * abs(shifts[at]):.1f} mm or more at about {hand.take.times[frame]:.1f} s"
            fault = hand.span(frame, "", why, remedy, of_labels=False)
            yield fault._replace(of=f"the {hand.side} glove")


def _is_amid(times: Float[np.ndarray, "F"]) -> Bool[np.ndarray, "F"]:
    """Whether each time [s] is long enough after the first and before the last for a slip."""
    return np.asarray(np.minimum(times - times[:1], times[-1:] - times) >= _TIME_BESIDE_SLIP)


def _fallen_markers(hand: _Hand) -> Iterator[SuspectSpan]:
    """Markers that are hardly seen although their hand is, or no longer seen from some time on."""
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
        least = max(_LAST_GAP, _LAST_GAP_RATIO * longest / take.rate, max(gaps) / take.rate)
        is_usual = begin >= _LAST_GAP * take.rate and row[:begin][shown[:begin]].mean() >= _LEAST_SEEN_SHARE
        if gap >= least and is_usual:
            why = f"is not seen after {take.times[begin - 1]:.2f} s, for {gap:.1f} s to the end"
            yield hand.span(begin, name, why, "look for the marker that fell off", of_labels=False)


def _joints_at_limits(hand: _Hand) -> Iterator[SuspectSpan]:
    """Joints at a limit of the model in many frames; the person's joint may have gone beyond it."""
    angles = np.rad2deg(hand.take.qpos[hand.frames, hand.take.hand_index(hand.side), 7:])
    for joint, values in zip(JOINTS, angles.T, strict=True):
        low, high = values < joint.low_deg + AT_LIMIT_DEG, values > joint.high_deg - AT_LIMIT_DEG
        for limit, there in ((joint.low_deg, low), (joint.high_deg, high)):
            if there.mean() > _LIMIT_SHARE:
                first = int(hand.frames[there.argmax()])
                share, start = 100 * there.mean(), hand.take.times[first]
                why = f"is at the model's limit, {limit:g} deg, in {share:.0f} % of frames from {start:.2f} s"
                remedy = "calibrate the hand, or do not use this angle"
                yield hand.span(first, joint.name, why, remedy, of_labels=False)


def _still_joints(hand: _Hand) -> Iterator[SuspectSpan]:
    """Joints that do not move, whose angle cannot be separated from the places of their markers."""
    spread, number = hand.take.angle_spread, hand.take.hand_index(hand.side)
    if spread is None:
        return
    spreads = np.rad2deg(np.median(spread[hand.frames, number], axis=0))
    still = are_still(hand.take.qpos[hand.frames, number, 7:])
    if np.ptp(hand.take.times[hand.frames]) < _LEAST_DURATION or still.mean() > _MOST_STILL_SHARE:
        return
    for joint in np.flatnonzero(still & (spreads > _LEAST_SPREAD_DEG)):
        name = JOINTS[joint].name
        why = f"hardly moves; the places of its markers tell its angle to {spreads[joint]:.0f} deg"
        remedy = f"measure the angle with a goniometer and name it, --known {name}=ANGLE"
        yield hand.span(int(hand.frames[0]), name, why, remedy, of_labels=False)
