"""Summary of a take in lines of text, signs of mistakes in its setup, and doubtful frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gloves.captures.capture import AT_ORIGIN, all_at_origin, runs_of, unit_fault
from gloves.fit import Attachment
from gloves.takes.take import COASTING, LOST, STATUSES, Take
from handsim.hand.shape import DIGITS, JOINT_NAMES, Side
from track.association.initialization import distances_to_nearest
from track.hand_size import AT_HAND
from track.takes.label_confidence import evidence_of, label_confidence
from track.takes.take_faults import SuspectSpan, find_faults

_LEAST_POSE_SHARE: Final = 0.1  # A hand should have a pose in this share of the frames.
_MOST_FILLED_SHARE: Final = 0.35  # share of filled-in markers; two hands that hide each other reach 0.31
_MOST_RMS: Final = 0.005  # [m]; hands of the nearest size reach 0.004
_MOST_UNLABELED_SHARE: Final = 0.25  # share of the points at the hands
_FAR_SHARE: Final = 0.05  # Unlabeled points away from the hands are mentioned from this share on.
# Frames whose points all have at least this confidence are not listed. A limit of 0.87 would list a third
# more frames and find hardly more errors. A limit of 0.7, or leaving out short spans, would miss more errors.
_CERTAIN_CONFIDENCE: Final = 0.8
_JOINING_GAP: Final = 0.05  # [s] Spans closer together are joined.
_MOST_SPANS: Final = 12  # number of listed spans, few enough to read at a glance
# A bound of the wrong frames among those not listed is this factor times the sum of their mean doubt and a
# minimum. Two of 44 takes of other people, rigs, gloves and noise exceeded it, so it holds for the next take
# with 95 % (split conformal prediction). With few markers, many listed frames or many unlabeled points it is
# useless.
_WRONG_FACTOR: Final = 2.8
_LEAST_DOUBT: Final = 0.002
_MOST_LISTED: Final = 0.25  # largest share of listed frames
_FEWEST_MARKERS: Final = 12  # least number of the glove's markers
_MOST_VOUCHED_UNLABELED: Final = 0.15  # largest share of unlabeled points at the hands


class Vouch(NamedTuple):
    """How many of a take's frames have every label right, with 95 % confidence."""

    listed: float
    """Share of the frames listed as doubtful."""
    right: float
    """Lower bound of the share of right frames among the others; 0 if there is none."""
    after: tuple[float, ...]
    """Expected share of right frames after looking at the first 0, 1, 2, ... listed spans."""

    def looks(self, share: float) -> int | None:
        """Number of first spans to look at for a share of right frames; None if looking at all is too few."""
        return next((count for count, one in enumerate(self.after) if one >= share), None)

    def __str__(self) -> str:
        """The result as one sentence."""
        if self.right <= 0.0:
            return (
                f"labels: {100 * self.listed:.1f} % of the frames are listed as doubtful; how many of the "
                "others are right is not known"
            )
        return (
            f"labels: of the {100 * (1.0 - self.listed):.1f} % of frames that are not listed as doubtful at "
            f"least {100 * self.right:.1f} % have every label right (95 % confidence)"
        )


def summarize(take: Take) -> list[str]:
    """One line per hand and body, one on confidence, and one on unlabeled points."""
    lines = []
    for number, side in enumerate(take.sides):
        status, rms = take.status[:, number], take.rms[:, number]
        line = f"{side} hand: {_status_shares(status)}"
        if (status != LOST).any():
            missing = take.filled(side)[status != LOST].mean()
            line += f"; {', '.join([*_median_rms(rms), f'{100 * missing:.1f} % of markers filled in'])}"
        else:
            line = f"{side} hand: not there"
        lines.append(line)
        guesses = "; ".join(_guesses(take.hands[number].attachment, take.shown_joints(side)))
        if guesses:
            lines.append(f"{side} hand: {guesses}")
    for number, body in enumerate(take.bodies):
        status, rms = take.body_status[:, number], take.body_rms[:, number]
        never = [] if (status != LOST).any() else ["it was never found: are these its markers?"]
        lines.append("; ".join([f"{body.name}: {_status_shares(status)}", *_median_rms(rms), *never]))
    if take.made_by_tracker and (take.status != LOST).any():
        lines.append(str(vouch(take)))
    count, foreign = len(take.point_list.labels), int((take.point_list.labels < 0).sum())
    line = f"{foreign} of {count} points are not markers"
    near = _unlabeled_at_hands(take)
    if foreign - near > _FAR_SHARE * count:
        line += f", {near} of them at the hands"
    return [*lines, line]


def _guesses(worn: Attachment, shown: Bool[np.ndarray, "20"]) -> Iterator[str]:
    """One sentence for each digit with joints beyond which the glove has no marker, or none was seen."""
    worn_beyond, lacking = (each.reshape(len(DIGITS), -1) for each in (worn.beyond.any(axis=1), ~shown))
    for number, (digit, has, lacks) in enumerate(zip(DIGITS, worn_beyond, lacking, strict=True)):
        owner = digit if digit == "thumb" else f"{digit} finger"
        verb = "was seen" if has[lacks].any() else "is"
        if lacks.all():
            yield f"no marker {verb} on the {owner}: its angles are guesses"
        elif lacks.any():
            joint = JOINT_NAMES[number * len(lacks) + int(lacks.argmax())].split("_")[1]
            yield f"no marker {verb} beyond the {joint} of the {owner}: its angles from there on are guesses"


def no_points(take: Take) -> str:
    """The sentence on a take without any point."""
    return f"no point is in any of the {take.num_frames} frames; does the camera system see markers?"


def suspicions(take: Take) -> list[str]:
    """Signs of a wrong setup, one sentence each with its remedy."""
    points = take.point_list
    if not len(points.points):
        return [no_points(take)]
    clouds = np.split(points.points, points.starts[1:-1])
    if all_at_origin(clouds):
        return [AT_ORIGIN]
    fault = unit_fault(clouds, only_wide=True)
    if fault is not None:
        return [f"{fault.found}, expected meters; set the unit of the stream to meters{fault.hint}"]
    faults = find_faults(take)
    lasting = [f"{fault.words}; {fault.remedy}" for fault in faults if fault.last == take.num_frames - 1]
    if others := len(faults) - len(lasting):
        lasting.append(f"faults of the hands of earlier frames, which the report lists as doubtful: {others}")
    return misfits(take) + lasting


def misfits(take: Take, *, calibrates: bool = False) -> list[str]:
    """Find signs that the tracked hands or their glove are not those of the capture."""
    found = [sentence for side in take.sides for sentence in _misfits_of(take, side, calibrates)]
    share = _unlabeled_share(take)
    if share > _MOST_UNLABELED_SHARE:
        found.append(
            f"{100 * share:.1f} % of the points at the hands are not markers of what was tracked; name the "
            f"glove worn (--glove){'' if calibrates else ', rigid bodies (--body)'} and the hands (--hands) "
            "that are in the capture"
        )
    return found


def _unlabeled_share(take: Take) -> float:
    """Share of unlabeled points among those at the hands or with a label."""
    near = _unlabeled_at_hands(take)
    return near / max(1, near + int((take.point_list.labels >= 0).sum()))


@lru_cache(maxsize=1)  # A summary and its warnings need the same number.
def _unlabeled_at_hands(take: Take) -> int:
    """Number of unlabeled points at the hands; points elsewhere do not indicate a mistake."""
    markers = np.concatenate([take.markers(side) for side in take.sides], axis=1)
    points, near = take.point_list.without(take.point_list.labels >= 0), 0
    for frame in np.flatnonzero(points.counts):
        seen = markers[frame, np.isfinite(markers[frame, :, 0])]
        if len(seen):
            distances = distances_to_nearest(points.points[points.of(frame)], seen)
            near += int((distances < AT_HAND).sum())
    return near


def _misfits_of(take: Take, side: Side, calibrates: bool) -> list[str]:
    """Signs that one hand or its glove is not that of the capture."""
    hand = take.hand_index(side)
    shown = take.status[:, hand] != LOST
    if shown.mean() < _LEAST_POSE_SHARE:
        if ((take.status != LOST).mean(axis=0) >= _LEAST_POSE_SHARE).any():
            return []  # the other hand is there
        return [
            f"the {side} hand was seen in {100 * shown.mean():.1f} % of the frames; name the glove worn "
            "(--glove) and the hands (--hands)"
        ]
    found = []
    filled, rms = float(take.filled(side)[shown].mean()), float(np.nanmedian(take.rms[:, hand]))
    if filled > _MOST_FILLED_SHARE:
        found.append(
            f"{100 * filled:.1f} % of the {side} hand's markers were not seen and are filled in from its "
            "pose; name the glove worn (--glove) and the hands that are in the capture (--hands)"
        )
    if rms > _MOST_RMS and not calibrates:
        found.append(
            f"the {side} hand's markers are {1e3 * rms:.1f} mm off its pose; name the glove worn (--glove), "
            "try another --size, or calibrate the hands (handsim calibrate, then --shape)"
        )
    return found


def _status_shares(status: Int[np.ndarray, "T"]) -> str:
    """Share of the frames with each status."""
    return ", ".join(
        f"{STATUSES[number]} {100 * np.mean(status == number):.1f} %"
        for number in reversed(range(len(STATUSES)))
    )


def _median_rms(rms: Float[np.ndarray, "T"]) -> list[str]:
    """The median RMS for a line; empty if no pose was fitted, as in simulated takes."""
    return [f"median RMS {1e3 * np.nanmedian(rms):.2f} mm"] if np.isfinite(rms).any() else []


def find_suspect_spans(take: Take, most: int | None = _MOST_SPANS) -> tuple[SuspectSpan, ...]:
    """Faults of the take, then spans with probably wrong or missing labels, the most doubtful first.

    Args:
        take: A tracked take; a simulated one has no doubtful spans.
        most: Largest number of spans besides the faults; all if None.

    Returns:
        Spans of frames `first` to `last`, with the `worst` frame, what they concern, and why.
    """
    evidence = evidence_of(take) if np.isfinite(take.qpos).any() and not _is_certain(take) else None
    points = take.point_list
    confidence, markers = _known_confidence(take), points.labels.astype(np.int64)
    if evidence is not None:
        markers[evidence.points] = evidence.markers
    least = np.fmin(_least_in_frames(take, confidence), 1.0)
    found: list[tuple[float, SuspectSpan]] = []
    for first, last in _join_runs(runs_of(least < _CERTAIN_CONFIDENCE), _JOINING_GAP * take.rate):
        worst = first + int(least[first : last + 1].argmin())
        point = points.of(worst).start + int(np.nanargmin(confidence[points.of(worst)]))
        of, why = _reason_for_doubt(take, worst, int(points.labels[point]), int(markers[point]))
        why += f", {100 * least[worst]:.0f} %"
        found.append((float((1.0 - least[first : last + 1]).sum()), SuspectSpan(first, last, worst, of, why)))
    found.sort(key=lambda entry: (-entry[0], entry[1].first))
    return (*(() if evidence is None else find_faults(take)), *(doubt for _, doubt in found[:most]))


def vouch(take: Take, spans: Sequence[SuspectSpan] | None = None) -> Vouch:
    """Bound the wrong frames of a take by the confidences in its labels, and by its doubtful spans."""
    doubt = 1.0 - np.nan_to_num(frame_confidence(take), nan=1.0)
    listed, masses = np.zeros(take.num_frames, dtype=np.bool_), list[float]()
    for span in find_suspect_spans(take, most=None) if spans is None else spans:
        part = slice(span.first, span.last + 1 if span.of_labels else span.first)
        masses.append(float(doubt[part][~listed[part]].sum()))
        listed[part] = True
    few = take.hands[0].layout.num_markers < _FEWEST_MARKERS
    if few or listed.mean() > _MOST_LISTED or _unlabeled_share(take) > _MOST_VOUCHED_UNLABELED:
        return Vouch(float(listed.mean()), 0.0, ())
    wrong = min(1.0, _WRONG_FACTOR * (float(doubt[~listed].mean()) + _LEAST_DOUBT))
    left = wrong * (~listed).sum() + sum(masses) - np.cumsum([0.0, *masses])
    return Vouch(float(listed.mean()), 1.0 - wrong, tuple((1.0 - left / take.num_frames).tolist()))


def _join_runs(runs: Sequence[tuple[int, int]], apart: float) -> list[tuple[int, int]]:
    """Join runs of frames that are less than `apart` frames from each other."""
    joined: list[tuple[int, int]] = []
    for first, last in runs:
        if joined and first - joined[-1][1] < apart:
            joined[-1] = joined[-1][0], last
        else:
            joined.append((first, last))
    return joined


def _reason_for_doubt(take: Take, frame: int, label: int, marker: int) -> tuple[str, str]:
    """Subject of a doubt (a label, a marker that may lack it, or its hand), and the reason."""
    if marker < 0:
        return "a point", "without a label"
    if label >= 0:
        return take.label_names[marker], "labeled"
    hand = next(number for number, part in enumerate(take.hand_labels) if marker in part)
    status = take.status[frame, hand]
    if status in (LOST, COASTING):
        return take.sides[hand], STATUSES[status]
    return take.label_names[marker], "without a label"


def frame_confidence(take: Take) -> Float[np.ndarray, "T"]:
    """The least confidence of each frame's points, labeled or not; NaN in frames without points."""
    return _least_in_frames(take, _known_confidence(take))


def _least_in_frames(take: Take, confidence: Float[np.ndarray, "P"]) -> Float[np.ndarray, "T"]:
    """The least confidence of each frame's points; NaN in frames without points."""
    least = np.full(take.num_frames, np.nan)
    np.fmin.at(least, take.point_list.frames, confidence)
    return least


def _known_confidence(take: Take) -> Float[np.ndarray, "P"]:
    """Confidence by the whole take's evidence; a confidence of 1, as of a corrected label, stays."""
    confidence = take.point_list.confidence
    if _is_certain(take):
        return confidence
    return np.where(confidence == 1.0, 1.0, label_confidence(take))


def _is_certain(take: Take) -> bool:
    """Whether every label is certain, as in a simulated take."""
    return bool((take.point_list.confidence == 1.0).all())
