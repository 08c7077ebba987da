"""Whether hands fit the points of a capture, and what fits better: another side, glove or unit of length.

Where the hands that are asked for fit a sample of frames badly, those of other gloves, sides and scales are
measured and tracked in the same frames; the likeliest are named if they are clearly likelier.
"""

from __future__ import annotations

import contextlib
import dataclasses
import warnings
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float

from gloves.captures.capture import spacing
from gloves.fit import GloveFit
from gloves.layout import MarkerLayout, list_layouts, load_layout
from gloves.takes.points import Status
from handsim.errors import ArgumentError, HandSimError, HandSimWarning
from handsim.hand.shape import Side
from track.association.hand_state import HandState
from track.association.initialization import FEWEST_POINTS, HandInitializer, distances_to_nearest
from track.hand_size import fit_size
from track.inputs import designed_glove
from track.streams.frame_source import StreamedFrame
from track.tracker import Tracker
from train.labelers.protocol import Labeler, Labeling
from train.labelers.storage import labeler_at_once

_WINDOW: Final = 30  # frames of each of two parts in which hands are compared
_LEAST_FRAMES: Final = 10  # that tell anything
_NEAR: Final = 0.04  # [m] from a hand's points, where a point without a label counts against it
_PENALTY: Final = 3.0  # log-odds of such a point, and of a marker that is not seen
_FOUND: Final = 0.6  # share of the frames in which hands are found that fit
_MOST_MISSING, _MOST_NEAR = 0.15, 0.2  # of such hands, for each of their markers
_MOST_HIDDEN: Final = 0.35  # of hands all of whose markers are seen at times, as where they hide each other
_FEW_NEAR: Final = 2.5  # points near hands that ghosts are
_MOST_RMS: Final = 0.004  # [m] of such hands
_LEAST_FOUND: Final = 0.5  # share of the frames in which what is named is found
_BETTER: Final = 1.15  # as large must its log-odds be
_MUCH_BETTER: Final = 2.0  # and where the scale is another
_UNITS: Final = {"millimeters": 1e-3, "centimeters": 1e-2, "meters": 1.0, "inches": 0.0254, "feet": 0.3048}
_READ: Final = ("millimeters", "centimeters", "meters")  # units that files state
_WANDS: Final = (2.0, 0.5)  # scales of a system whose calibration wand had another length than it was told
_FAR_OFF: Final = 4.0  # times the distance between a glove's neighbors, on a flat hand, which no hand has
_LEAST_SPACING: Final = 1e-9  # [m] between points, so that nothing is divided by zero
_MOST_OWN: Final = 16  # gloves of the working folder that are tried


class _Fit(NamedTuple):
    """How well hands fit some frames."""

    log_odds: float = 0.0
    """Mean over the frames of that of hands, less what speaks against them."""
    found: dict[Side, int] = {}  # noqa: RUF012
    """Number of frames in which each hand is found."""
    shown: int = 0
    """Number of frames in which any is."""
    is_good: bool = False
    """Whether nothing tells of a mistake."""
    is_whole: bool = False
    """Whether each marker is seen at times: a glove fits the points of another one that has fewer markers."""


class _Other(NamedTuple):
    """What may fit better."""

    name: str
    """Of its glove, or the path of the glove's file."""
    layout: MarkerLayout
    scale: float
    """Factor that makes the points ones in meters."""
    fit: _Fit


class _AtOnce:
    """`labeler_at_once`, made when it is first asked: bodies alone have no points like a hand's."""

    def __init__(self, layout: MarkerLayout) -> None:
        self._layout, self.marker_names = layout, layout.names

    def label_frames(self, frames: Sequence[Float[np.ndarray, "N 3"]]) -> list[Labeling]:
        """See `train.labelers.protocol.Labeler`."""
        return labeler_at_once(self._layout).label_frames(frames)


def check_scale(frames: Sequence[StreamedFrame], hands: Sequence[GloveFit], labeler: Labeler) -> None:
    """Refuse points that fit hands at another scale, which distances between neighbors tell.

    `check_hands` finds that too, after all else that may be wrong.

    Args:
        frames: Frames of unlabeled points [m], as `sample_frames` gives.

    Raises:
        ArgumentError: The points fit hands at another scale alone.
    """
    some = _compared(frames)
    if not some:
        return
    found = float(np.median([spacing(frame.points) for frame in some]))
    factor = spacing(hands[0].attachment.points) / max(found, _LEAST_SPACING)
    if 1.0 / _FAR_OFF < factor < _FAR_OFF:
        return
    scale = min(_scales(), key=lambda one: abs(np.log(one / factor)))
    scaled = [dataclasses.replace(frame, points=scale * frame.points) for frame in some]
    fit = _measured_fit(scaled, designed_glove(hands[0].layout), labeler)
    if fit.is_good and fit.log_odds > _MUCH_BETTER * _fit(some, hands, labeler).log_odds:
        raise ArgumentError(_of_scale(1.0 / scale))


def check_hands(
    frames: Sequence[StreamedFrame],
    hands: Sequence[GloveFit],
    labeler: Labeler,
    *,
    options: Collection[str] = ("--hands", "--glove"),
) -> None:
    """Tell of hands that do not fit, where another side, glove or unit fits clearly better.

    That takes seconds, where something is wrong; the shipped gloves are tried, and those of .toml files in
    the working folder.

    Args:
        frames: Frames of unlabeled points [m], as `sample_frames` gives.
        options: Those by which the user can name what fits better.

    Raises:
        ArgumentError: The points fit hands at another scale alone.

    Warns:
        HandSimWarning: They fit another hand or glove clearly better.
    """
    some = _compared(frames)
    if not some:
        return
    asked = _fit(some, hands, labeler)
    if asked.is_good:
        return
    glove = designed_glove(hands[0].layout)
    others = _others(some, glove, labeler)  # of these a glove of few markers fits anything somehow
    likely = [other for other in others if other.layout == glove or other.fit.is_good]
    best = max(likely, key=lambda other: other.fit.log_odds)
    fit, factor = best.fit, _BETTER if best.scale == 1.0 else _MUCH_BETTER
    if fit.shown < _LEAST_FOUND * len(some) or fit.log_odds <= factor * asked.log_odds:
        return
    if best.scale != 1.0:
        raise ArgumentError(_of_scale(1.0 / best.scale))
    there = [side for side, count in fit.found.items() if count >= _LEAST_FOUND * fit.shown]
    remedy = [] if set(there) <= {hand.side for hand in hands} else [f"--hands {' '.join(there)}"]
    named = "two hands" if len(there) == 2 else f"a {there[0]} hand"
    if best.layout != glove:
        named += f" in glove '{best.name}'"
        remedy.append(f"--glove {best.name}")
    if remedy:
        shares = f"{fit.shown} of {len(some)} frames, what is asked for {asked.shown}"
        known = [one for one in remedy if one.split()[0] in options]
        how = f"; name it ({' '.join(known)})" if known else ""
        warnings.warn(f"the points fit {named} better ({shares}){how}", HandSimWarning, stacklevel=3)


def _compared(frames: Sequence[StreamedFrame]) -> list[StreamedFrame]:
    """The frames in which hands are compared; none where there are too few to tell anything."""
    shown = [frame for frame in frames if len(frame.points) >= FEWEST_POINTS]
    half = max(_WINDOW, len(shown) // (2 * _WINDOW) * _WINDOW)
    some = [*shown[:_WINDOW], *shown[half : half + _WINDOW]]
    return some if len(some) >= _LEAST_FRAMES else []


def _others(frames: Sequence[StreamedFrame], glove: MarkerLayout, labeler: Labeler) -> list[_Other]:
    """Hands of both sides in the glove that is asked for, in other gloves, and at other scales."""
    others = [_Other(glove.name, glove, 1.0, _measured_fit(frames, glove, labeler))]
    if others[0].fit.is_good:
        return others
    for name, layout in _gloves():
        if layout != glove:
            others.append(_Other(name, layout, 1.0, _measured_fit(frames, layout, _AtOnce(layout))))
        if others[-1].fit.is_good and others[-1].fit.is_whole:
            return others
    if max(other.fit.shown for other in others) < _LEAST_FOUND * len(frames):
        for scale in _scales():
            scaled = [dataclasses.replace(frame, points=scale * frame.points) for frame in frames]
            others.append(_Other(glove.name, glove, scale, _measured_fit(scaled, glove, labeler)))
    return others


def _measured_fit(frames: Sequence[StreamedFrame], layout: MarkerLayout, labeler: Labeler) -> _Fit:
    """How well the hands of a glove fit some frames that they are measured in."""
    size = fit_size(frames, layout, layout.sides, labeler, is_quick=True)
    return _Fit() if size is None else _fit(frames, size.hands(layout.sides), labeler)


def _fit(frames: Sequence[StreamedFrame], hands: Sequence[GloveFit], labeler: Labeler) -> _Fit:
    """How well hands fit some frames."""
    tracker, markers = Tracker(hands, labeler), hands[0].layout.num_markers
    score = HandInitializer([HandState(hands[0])], labeler).score
    found = {hand.side: 0 for hand in hands}
    rms, missing, near, count, log_odds = [], [], [], 0, 0.0
    unseen = {hand.side: set(range(markers)) for hand in hands}
    for frame in frames:
        tracked = tracker.step(frame.points, frame.ids, frame.time)
        there = [one for one in tracked.hands if one.status in (Status.TRACKED, Status.INITIALIZED)]
        count += bool(there)
        free = frame.points[tracked.labels < 0]
        for hand in there:
            found[hand.side] += 1
            rms.append(hand.rms)
            missing.append(len(hand.filled))
            unseen[hand.side] &= {int(marker) for marker in hand.filled}
            near.append(int((distances_to_nearest(free, hand.markers) < _NEAR).sum()))
            odds = score(markers - missing[-1], hand.rms)
            log_odds += max(0.0, odds - _PENALTY * (missing[-1] + near[-1]))
    is_whole = not any(unseen[side] for side, times in found.items() if times)
    is_good = (
        count >= _FOUND * len(frames)
        and float(np.median(rms)) <= _MOST_RMS
        and float(np.mean(missing)) <= (_MOST_HIDDEN if is_whole else _MOST_MISSING) * markers
        and float(np.mean(near)) <= max(_MOST_NEAR * markers, _FEW_NEAR)
    )
    return _Fit(log_odds / len(frames), found, count, is_good, is_whole)


def _gloves() -> list[tuple[str, MarkerLayout]]:
    """The shipped gloves and those in the working folder, by name or path; those with more markers first."""
    found = [(name, load_layout(name)) for name in list_layouts()]
    for path in sorted(Path().glob("*.toml"))[:_MOST_OWN]:
        with contextlib.suppress(HandSimError):  # a file of another kind
            found.append((str(path), load_layout(path)))
    return sorted(found, key=lambda one: -one[1].num_markers)


def _scales() -> list[float]:
    """Factors that correct a unit of length that was mistaken for another, or a wand's length."""
    pairs = {_UNITS[true] / _UNITS[read] for read in _READ for true in _UNITS if true != read}
    return [*sorted(pairs), *_WANDS]


def _of_scale(times: float) -> str:
    """The sentence about points that fit hands at so many times their size."""
    units = [
        f"in {true}, read as {read}"
        for read in _READ
        for true in _UNITS
        if np.isclose(_UNITS[true] / _UNITS[read] * times, 1.0)
    ]
    cause = f"the file is probably {' or '.join(units)}" if units else "had the calibration wand its length?"
    return (
        f"the points fit hands at {times:.3g} of their size: {cause}; correct the unit that the file states, "
        f"or multiply its positions by {1.0 / times:.4g}"
    )
