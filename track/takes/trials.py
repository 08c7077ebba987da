"""Figures that papers give of trials: cycles of a movement, and how near the thumb comes to the fingers.

Angles are in degrees, times in seconds, gaps in millimeters.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.signal import find_peaks

from gloves.captures.capture import runs_of
from gloves.takes.take import Take
from handsim.hand.capsules import Capsules, overlap_between
from handsim.hand.shape import DIGITS, JOINT_NAMES, Side, bones_of
from handsim.pages import joint_words

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PERCENTS: Final = np.arange(101.0)
"""Times of a cycle at which its curves have values [%]."""
FIGURES: Final = (
    *("duration [s]", "least [deg]", "largest [deg]", "range [deg]"),
    *("least velocity [deg/s]", "largest velocity [deg/s]"),
)
"""Figures of a joint in a cycle. Velocities are signed, so the least is the quickest extension."""
_RISE_SHARE, _LOWEST_SHARE = 0.5, 0.2
"""A cycle begins in the lowest share of the joint's range, and rises and falls by at least a share of it."""
_LEAST_RANGE_DEG: Final = 10.0  # [deg] A joint that moves less has no cycles.
_MEASURED_SHARE: Final = 0.9  # A cycle counts for a joint that is measured in this share of its frames.
_TARGETS: Final = {
    "1, index proximal phalanx": ("index", 0, 0.0, 1.0),
    "2, index middle phalanx": ("index", 1, 0.0, 1.0),
    "3, index tip": ("index", 2, 0.0, 1.0),
    "4, middle tip": ("middle", 2, 0.0, 1.0),
    "5, ring tip": ("ring", 2, 0.0, 1.0),
    "6, little tip": ("little", 2, 0.0, 1.0),
    "7, little DIP": ("little", 1, 1.0, 1.0),
    "8, little PIP": ("little", 0, 1.0, 1.0),
    "9, base of the little finger": ("little", 0, 0.5, 0.5),
    "10, palm below the little finger": ("little", 0, 0.0, 0.0),
}
"""Targets of the thumb's tip (Kapandji 1986, Annales de chirurgie de la main 5:67): digit, phalanx, and the
part of its length. The creases of the skin lie at these joints, within some millimeters."""


class Cycles(NamedTuple):
    """The C cycles of a movement: what each joint does in them."""

    spans: list[tuple[int, int]]
    """First frame of each, and the first of the next."""
    figures: Float[np.ndarray, "C 20 6"]
    """What `FIGURES` names, of each joint in each cycle; NaN where the joint was not measured."""
    curves: Float[np.ndarray, "C 20 101"]
    """Angles at `PERCENTS` of the cycle [deg]; NaN where the joint was not measured."""


def find_cycles(angles: Float[np.ndarray, "T"]) -> list[tuple[int, int]]:
    """Cycles of a movement, from one least angle of a joint to the next [deg]; NaN where it is not known."""
    known = np.isfinite(angles)
    low, high = np.percentile(angles[known], (5.0, 95.0)) if known.any() else (0.0, 0.0)
    if high - low < _LEAST_RANGE_DEG:
        return []
    spans, moved = list[tuple[int, int]](), high - low
    for first, last in runs_of(known):
        # A movement may begin and end at rest, so the angle counts as large beyond its ends.
        run = np.concatenate([[high], angles[first : last + 1], [high]])
        lowest, _ = find_peaks(-run, height=-low - _LOWEST_SHARE * moved, prominence=_RISE_SHARE * moved)
        spans += pairwise((first + lowest - 1).tolist())
    return spans


def cycles_of(
    angles: Float[np.ndarray, "T 20"], measured: Bool[np.ndarray, "T 20"], joint: str, rate: float
) -> Cycles:
    """The cycles of a movement that a joint sets.

    Args:
        angles: Joint angles [deg].
        measured: Frames in which each angle is measured.
        joint: The joint between whose least angles a cycle is.
        rate: Frames a second [Hz].
    """
    shown = np.where(measured, angles, np.nan)
    spans = find_cycles(shown[:, JOINT_NAMES.index(joint)])
    figures = np.full((len(spans), len(JOINT_NAMES), len(FIGURES)), np.nan)
    curves = np.full((len(spans), len(JOINT_NAMES), len(PERCENTS)), np.nan)
    speeds = np.gradient(shown, axis=0) * rate if len(shown) > 1 else np.zeros_like(shown)
    for number, (first, last) in enumerate(spans):
        part = slice(first, last + 1)
        for column in np.flatnonzero(measured[part].mean(axis=0) >= _MEASURED_SHARE).tolist():
            known = np.isfinite(shown[part, column])
            places = np.linspace(0.0, 100.0, last + 1 - first)[known]
            values = shown[part, column][known]
            curves[number, column] = np.interp(PERCENTS, places, values)
            low, high, speed = values.min(), values.max(), speeds[part, column]
            figures[number, column] = [(last - first) / rate, low, high, high - low, *_extremes(speed)]
    return Cycles(spans, figures, curves)


def _extremes(values: Float[np.ndarray, "F"]) -> tuple[float, float]:
    """Least and largest of the finite values."""
    known = values[np.isfinite(values)]
    return (float(known.min()), float(known.max())) if len(known) else (np.nan, np.nan)


def mean_and_spread(rows: Float[np.ndarray, "C *N"]) -> Iterator[tuple[str, Float[np.ndarray, "*N"]]]:
    """Mean and standard deviation over cycles; NaN where fewer than one or two of them are known."""
    count = np.isfinite(rows).sum(axis=0)
    mean = np.nansum(rows, axis=0) / np.where(count > 0, count, np.nan)
    squares = np.nansum((rows - mean) ** 2, axis=0)
    yield "mean", mean
    yield "SD", np.sqrt(squares / np.where(count > 1, count - 1, np.nan))


def draw_cycles(figure: Figure, cycles: Cycles, colors: tuple[str, ...]) -> None:
    """Draw the mean of each angle over the cycles, with a band of one standard deviation to either side."""
    panels = figure.subplots(1, len(DIGITS), sharex=True, sharey=True)
    (_, means), (_, spreads) = mean_and_spread(cycles.curves)
    for number, (digit, panel) in enumerate(zip(DIGITS, panels, strict=True)):
        own = slice(4 * number, 4 * number + 4)
        for mean, spread, name, color in zip(means[own], spreads[own], JOINT_NAMES[own], colors, strict=True):
            panel.plot(PERCENTS, mean, color=color, linewidth=1.3, label=joint_words(name))
            panel.fill_between(PERCENTS, mean - spread, mean + spread, color=color, alpha=0.15, linewidth=0.0)
        panel.set_title(digit, fontsize=9)
        panel.set_xlabel("cycle [%]")
    panels[0].set_ylabel("angle [deg]")
    figure.legend(handles=panels[0].lines, loc="outside lower left", ncols=4, frameon=False, fontsize=7)
    figure.legend(handles=panels[-1].lines, loc="outside lower right", ncols=4, frameon=False, fontsize=7)


def thumb_reach(take: Take, side: Side) -> list[tuple[str, float, float, float]]:
    """How near the thumb's last bone came to each of ten targets, as in a test of opposition.

    Returns:
        By target its name, the least gap between the surfaces [m] (0 and less where flesh touches), the time
        [s], and the gap's standard deviation there [m], from those of the keypoints; NaN if it is unknown.
    """
    number, there = take.hand_index(side), take.is_tracked(side)
    gaps = np.full((len(_TARGETS), take.num_frames), np.nan)
    for span, worn in take.worn():
        frames = span.start + np.flatnonzero(there[span])
        if not len(frames):
            continue
        model = worn[number].model
        bones = model.forward_kinematics(take.qpos[frames, number])
        thumb = _part(model.capsules, "thumb", 2, 0.0, 1.0)
        for row, target in zip(gaps, _TARGETS.values(), strict=True):
            row[frames] = -overlap_between(thumb, bones, _part(model.capsules, *target), bones)
    found = []
    for row, (name, (digit, *_)) in zip(gaps, _TARGETS.items(), strict=True):
        if not np.isfinite(row).any():
            continue
        frame = int(np.nanargmin(row))
        spread = np.nan
        if take.keypoint_spread is not None:
            tips = [4 * DIGITS.index(one) + 4 for one in ("thumb", digit)]
            spread = float(np.linalg.norm(take.keypoint_spread[frame, number, tips]))
        found.append((name, float(row[frame]), float(take.times[frame]), spread))
    return found


def _part(capsules: Capsules, digit: str, phalanx: int, first: float, last: float) -> Capsules:
    """A part of a phalanx, from one share of its length to another."""
    (row,) = np.flatnonzero(capsules.bones == bones_of(digit)[phalanx])
    start, end = capsules.starts[[row]], capsules.ends[[row]]
    near, far = (start + share * (end - start) for share in (first, last))
    return Capsules(capsules.bones[[row]], near, far, capsules.radii[[row]])
