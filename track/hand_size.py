"""The size and proportions of a user's hands in some frames, and whether hands fit these frames at all.

Length and breadth of hands of mean proportions are searched first; then the proportions and the positions of
the markers follow as far as the frames tell. `calibrate` finds the rest from a longer capture. Where hands
fit badly, those of other gloves, sides and scales are measured in the same frames; the likeliest are named if
they are clearly likelier.
"""

from __future__ import annotations

import contextlib
import dataclasses
import warnings
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from gloves.captures.capture import spacing
from gloves.fit import GloveFit, settle_glove
from gloves.layout import MarkerLayout, list_layouts, load_layout
from gloves.takes.points import Status
from handsim.errors import ArgumentError, HandSimError, HandSimWarning
from handsim.hand.model import HandModel
from handsim.hand.shape import SIZES, HandShape, Side, shape_from_measures
from handsim.space.transforms import MIRROR
from track.association.hand_state import HandState
from track.association.initialization import FEWEST_POINTS, HandInitializer, distances_to_nearest
from track.calibration.energy import first_estimate, levenberg_marquardt, shared_covariance, user_hand
from track.calibration.hand_parameters import LENGTH
from track.config import TrackerConfig
from track.frames import StreamedFrame, TrackedHand
from track.kinematics.pose_solver import PoseSolver
from track.tracker import Tracker
from track.user import MEASURED, User, designed_glove
from train.labelers.protocol import Labeler, Labeling
from train.labelers.storage import labeler_at_once

_LENGTHS: Final = (0.187, 0.205, 0.168, 0.150)  # [m] hands to find the labels with, the likeliest first
_SHORTEST, _LONGEST = (
    0.125,
    0.225,
)  # hand lengths that are tried [m]: 0.6 of an adult's to beyond ANSUR II's longest
_BREADTHS: Final = (0.88, 1.12)  # from the usual breadth of a length; three standard deviations
_FAR: Final = 0.012  # [m] change of length after which the hands are labeled again
_PRECISION: Final = 0.001  # [m] of length
_USUAL_LENGTH, _LENGTH_SPREAD = 0.187, 0.012  # [m] of adults, women and men, ANSUR II
_BREADTH_SPREAD: Final = 0.04  # from the usual breadth of a length
_MARKER_SPREAD: Final = 0.002  # [m] per axis of glued markers around their places
_INDEPENDENT: Final = 4.0  # frames' worth of evidence: what glue and flesh do repeats from frame to frame
_FRAMES: Final = 8  # of each hand with which length and breadth are searched
_PROPORTION_FRAMES: Final = 40  # of each hand that its proportions are fitted to
_MOST_FRAMES: Final = 0.5  # share of the frames in which measured hands must be found
_SOME_FRAMES: Final = 0.1  # the same of hands that fit well; hands that touch seldom begin a track
_FITS_WELL: Final = 0.00175  # [m] median RMS distance; where points that are no hand's are found, it is more
_FEWEST: Final = 3  # fewest frames from which a size is trusted
_MISSING: Final = 0.2  # largest share of missing markers in a frame that shows a hand
_FITTED: Final = (Status.TRACKED, Status.INITIALIZED)
_PATIENCE: Final = 20  # frames with enough points for a hand, but none, after which another size is tried
_WINDOWS: Final = 8  # parts of a capture that are looked at
_WINDOW: Final = 16  # frames of each
_FIT_NOISE: Final = 0.003  # [m] twice that of real gloves: flesh repeats in frames that are much alike
_SURE: Final = 2.0  # standard deviations within which the length is with 95 %
_USUAL: Final = TrackerConfig()
_LENIENT: Final = TrackerConfig(least_evidence=2.0)  # for hands of few markers, before they are measured
_ROBUST_SCALE: Final = 0.015  # [m]
_FIT_STEPS: Final = 15
_SMALL_GAIN, _RELINEARIZE = 1e-3, 0.05  # ten times a calibration's: a size has 0.2 mm to spare
_PART: Final = 30  # frames of each of two parts in which hands are compared
_LEAST_FRAMES: Final = 10  # frames below which hands are not compared
_NEAR: Final = 0.04  # [m] from a hand's points, where a point without a label counts against it
_PENALTY: Final = 3.0  # log-odds of such a point, and of a marker that is not seen
_FOUND: Final = 0.6  # share of the frames in which hands are found that fit
_MOST_MISSING, _MOST_NEAR = 0.15, 0.2  # of the markers: missing ones, and points nearby, of hands that fit
_MOST_HIDDEN: Final = 0.35  # the same for missing markers of a hand whose markers are all seen at times
_FEW_NEAR: Final = 2.5  # points near a hand that may be ghosts
_MOST_RMS: Final = 0.004  # [m] median RMS distance of hands that fit
_LEAST_FOUND: Final = 0.5  # share of the frames in which suggested hands are found, at least
_BETTER: Final = 1.15  # factor of our log-odds from which on another glove is suggested
_MUCH_BETTER: Final = 2.0  # the same for another scale
_UNITS: Final = {"millimeters": 1e-3, "centimeters": 1e-2, "meters": 1.0, "inches": 0.0254, "feet": 0.3048}
_READ: Final = ("millimeters", "centimeters", "meters")  # units that files state
_WANDS: Final = (2.0, 0.5)  # scales of a system whose calibration wand had another length than it was told
_FAR_OFF: Final = 4.0  # times the distance between a glove's neighbors, on a flat hand, which no hand has
_LEAST_SPACING: Final = 1e-9  # [m] between points, so that nothing is divided by zero
_MOST_OWN: Final = 16  # gloves of the working folder that are tried


class SizeFit(NamedTuple):
    """Hands as measured."""

    hand: GloveFit  # the right one; a left hand is its mirror image
    rms: float  # median RMS distance of the markers from this hand [m]
    spread: float  # standard deviation of its length [m]

    def __str__(self) -> str:
        """Length and breadth [mm], and by how much the length may be off, with 95 %."""
        shape, unsure = self.hand.shape, _SURE * self.spread
        return f"{1e3 * shape.length:.0f} x {1e3 * shape.breadth:.0f} mm, unsure by {1e3 * unsure:.0f} mm"

    def hands(self, sides: Sequence[Side]) -> tuple[GloveFit, ...]:
        """The measured hands of these sides."""
        return tuple(self.hand.with_side(side) for side in sides)


def sample_frames(frames: Sequence[StreamedFrame]) -> list[StreamedFrame]:
    """Parts of a capture for `fit_size`, of consecutive frames each: beginning, end and six between."""
    if len(frames) <= _WINDOWS * _WINDOW:
        return list(frames)
    starts = np.linspace(0, len(frames) - _WINDOW, _WINDOWS).astype(int)
    return [frame for start in starts for frame in frames[start : start + _WINDOW]]


def fit_size(
    frames: Sequence[StreamedFrame],
    layout: MarkerLayout,
    sides: Sequence[Side],
    labeler: Labeler,
    *,
    is_quick: bool = False,
) -> SizeFit | None:
    """The size and proportions of the hands in some frames."""
    for config in (_LENIENT,) if is_quick else (_USUAL, _LENIENT):
        for length in _LENGTHS[:2] if is_quick else _LENGTHS:
            fit = _fit_from(length, frames, layout, sides, labeler, config)
            if fit is not None and (config is _USUAL or _is_found(fit, frames, sides, labeler)):
                return fit
    return None


def measured_user(
    frames: Sequence[StreamedFrame], user: User, labeler: Labeler, *, warns: bool = True
) -> User:
    """A user with the hands as measured in some frames; as they are, with a warning, if no hand is found."""
    size = fit_size(frames, user.layout, user.sides, labeler)
    if size is not None:
        return User(size.hands(user.sides), f"{MEASURED}{size}")
    if warns:
        none = f"no hand was found to measure its size; size {user.notes} is used, or name a size"
        warnings.warn(none, HandSimWarning, stacklevel=3)
    return user


def hand_between(one: GloveFit, other: GloveFit, share: float) -> GloveFit:
    """The hand at a share of the way from one size of a hand in its glove to another."""

    def mixed(first: Any, last: Any, *names: str) -> dict[str, Any]:
        return {name: (1.0 - share) * getattr(first, name) + share * getattr(last, name) for name in names}

    measures = [field.name for field in dataclasses.fields(HandShape) if field.name != "side"]
    shape = dataclasses.replace(other.shape, **mixed(one.shape, other.shape, *measures))
    worn = mixed(one.attachment, other.attachment, "points", "normals")
    worn["normals"] /= np.linalg.norm(worn["normals"], axis=1, keepdims=True)
    return GloveFit(HandModel(shape), dataclasses.replace(other.attachment, **worn))


def _fit_from(
    length: float,
    frames: Sequence[StreamedFrame],
    layout: MarkerLayout,
    sides: Sequence[Side],
    labeler: Labeler,
    config: TrackerConfig,
) -> SizeFit | None:
    """The hands that are found as hands of a length [m]."""
    markers: list[NDArray[np.float64]] = []
    for _ in range(2):  # the labels are better with hands of about their own size
        start = mean_hand(length, usual_breadth(length), layout)
        markers = _label(frames, start, sides, labeler, config) or markers
        if not markers:
            return None
        search, before = _Search(markers, start), length
        length = search.length(usual_breadth, _SHORTEST, _LONGEST)
        if abs(length - before) <= _FAR:
            break
    return _fit_proportions(np.concatenate(markers), mean_hand(*search.measures(length), layout))


def _is_found(fit: SizeFit, frames: Sequence[StreamedFrame], sides: Sequence[Side], labeler: Labeler) -> bool:
    """Whether measured hands are found in most frames, or in some where most markers fit well."""
    tracker, count = Tracker(fit.hands(sides), labeler), fit.hand.layout.num_markers
    enough = [frame for frame in frames if _are_enough(frame, count)]
    tracked = [tracker.step(frame.points, frame.ids, frame.time).hands for frame in enough]
    if sum(any(hand.has_pose for hand in hands) for hands in tracked) >= max(1.0, _MOST_FRAMES * len(enough)):
        return True
    shown = [[hand.rms for hand in hands if _is_shown(hand, count)] for hands in tracked]
    rms = [one for row in shown for one in row]
    some = sum(map(bool, shown)) >= max(1.0, _SOME_FRAMES * len(enough))
    return some and float(np.median(rms)) <= _FITS_WELL


def _are_enough(frame: StreamedFrame, count: int) -> bool:
    """Whether a frame has points for most of the markers of a hand."""
    return len(frame.points) >= (1.0 - _MISSING) * count


def _is_shown(hand: TrackedHand, count: int) -> bool:
    """Whether most of the markers of a hand are there."""
    return hand.status in _FITTED and len(hand.filled) <= _MISSING * count


def usual_breadth(length: float) -> float:
    """The breadth of hands of a length [m]: that of the five sizes, and in proportion beyond them."""
    lengths, breadths = 1e-3 * np.array(sorted(SIZES.values())).T
    inside = float(np.clip(length, lengths[0], lengths[-1]))
    return float(np.interp(inside, lengths, breadths)) * length / inside


def mean_hand(length: float, breadth: float, layout: MarkerLayout) -> GloveFit:
    """A right hand of mean proportions in a glove as designed; length and breadth in [m]."""
    return settle_glove(layout, HandModel(shape_from_measures(length, breadth, side="right")))


def _label(
    frames: Sequence[StreamedFrame],
    hand: GloveFit,
    sides: Sequence[Side],
    labeler: Labeler,
    config: TrackerConfig,
) -> list[Float[np.ndarray, "F M 3"]]:
    """Labeled markers [m] of each hand that enough frames show, as a right one's, NaN where missing."""
    tracker = Tracker([hand.with_side(side) for side in sides], labeler, config=config)
    count = hand.layout.num_markers
    found: list[list[NDArray[np.float64]]] = [[] for _ in sides]
    in_vain = 0
    for frame in frames:
        if in_vain == _PATIENCE and not any(found):
            break
        in_vain += _are_enough(frame, count)
        for seen, some in zip(tracker.step(frame.points, frame.ids, frame.time).hands, found, strict=True):
            if _is_shown(seen, count):
                markers = seen.markers.copy()
                markers[seen.filled] = np.nan
                some.append(markers)
    return [
        _spread_out(np.array(some), _PROPORTION_FRAMES) @ (MIRROR if side == "left" else np.eye(3))
        for side, some in zip(sides, found, strict=True)
        if len(some) >= _FEWEST
    ]


def _spread_out(markers: NDArray[np.float64], most: int) -> NDArray[np.float64]:
    """So many frames of markers (F, M, 3) at most, evenly spaced."""
    chosen: NDArray[np.float64] = markers[
        np.linspace(0, len(markers) - 1, min(most, len(markers))).astype(int)
    ]
    return chosen


class _Search:
    """The likeliest length and breadth of hands of mean proportions, as which some frames were labeled."""

    # Few markers fit hands of many sizes, so that the sizes of people count too.

    def __init__(self, markers: Sequence[Float[np.ndarray, "F M 3"]], start: GloveFit) -> None:
        few = [_spread_out(some, _FRAMES) for some in markers]
        seen = np.mean([np.isfinite(some[..., 0]).sum(axis=1).mean() for some in few])
        self._evidence = _INDEPENDENT * float(seen) / _MARKER_SPREAD**2  # [1/m^2]
        self._markers, self._layout = np.concatenate(few), start.layout
        self._poses = PoseSolver(start).solve(self._markers).qpos

    def length(self, breadth: Callable[[float], float], shortest: float, longest: float) -> float:
        """The likeliest length [m] between two; `breadth` gives the breadth [m] of each."""
        return _least(lambda tried: self._cost(tried, breadth(tried)), shortest, longest)

    def measures(self, length: float) -> tuple[float, float]:
        """Length and breadth [m]."""
        usual = usual_breadth(length)
        low, high = (factor * usual for factor in _BREADTHS)
        breadth = _least(lambda tried: self._cost(length, tried), low, high)
        return self.length(lambda tried: breadth, 0.95 * length, 1.05 * length), breadth

    def _cost(self, length: float, breadth: float) -> float:
        solver = PoseSolver(mean_hand(length, breadth, self._layout))
        beyond = (length - _USUAL_LENGTH) / _LENGTH_SPREAD
        broad = (breadth / usual_breadth(length) - 1.0) / _BREADTH_SPREAD
        square = float(np.median(solver.solve(self._markers, self._poses).rms)) ** 2
        return 0.5 * (self._evidence * square + beyond**2 + broad**2)


def _least(function: Callable[[float], float], low: float, high: float) -> float:
    """The argument between two bounds [m] with the least value of a function."""
    from scipy.optimize import minimize_scalar

    options = {"xatol": _PRECISION}
    return float(minimize_scalar(function, bounds=(low, high), method="bounded", options=options).x)


def _fit_proportions(seen: Float[np.ndarray, "F M 3"], start: GloveFit) -> SizeFit:
    """One shape for right hands in some frames, by a calibration without touches."""
    options = {"noise": _FIT_NOISE, "robust_scale": _ROBUST_SCALE, "relinearize": _RELINEARIZE}
    problem, estimate = first_estimate(start, seen, PoseSolver(start).solve(seen).qpos, **options)
    estimate, fit, _ = levenberg_marquardt(problem, estimate, 0, _FIT_STEPS, None, _SMALL_GAIN)
    hand = user_hand(start, problem, estimate)
    rms = float(np.median(PoseSolver(hand).solve(seen, estimate.qpos).rms))
    variance = shared_covariance(problem, estimate, fit)[0][LENGTH, LENGTH]
    return SizeFit(hand, rms, hand.shape.length * float(np.sqrt(variance)))


class _Fit(NamedTuple):
    """How well hands fit some frames."""

    log_odds: float = 0.0  # mean over the frames of the hands' log-odds, less penalties
    found: dict[Side, int] = {}  # noqa: RUF012
    """Number of frames in which each hand is found."""
    shown: int = 0  # number of frames in which any hand is found
    is_good: bool = False  # whether the hands fit well enough not to look for others
    is_whole: bool = False  # whether each marker is seen at times; if not, the glove may have fewer


class _Other(NamedTuple):
    """A glove or scale that may fit better."""

    name: str  # name of the glove, or path of its file
    layout: MarkerLayout
    scale: float  # factor that makes the points ones in meters
    fit: _Fit


class _AtOnce:
    """`labeler_at_once`, made when it is first asked: bodies alone have no points like a hand's."""

    def __init__(self, layout: MarkerLayout) -> None:
        self._layout, self.marker_names = layout, layout.names

    def label_frames(self, frames: Sequence[Float[np.ndarray, "N 3"]]) -> list[Labeling]:
        """See `train.labelers.protocol.Labeler`."""
        return labeler_at_once(self._layout).label_frames(frames)


def check_scale(frames: Sequence[StreamedFrame], hands: Sequence[GloveFit], labeler: Labeler) -> None:
    """Refuse points that fit hands at another scale, which distances between neighbors tell."""
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
    """Tell of hands that do not fit, where another side, glove or unit fits clearly better."""
    # That takes seconds, where something is wrong; gloves of .toml files in the working folder are tried too.
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
    half = max(_PART, len(shown) // (2 * _PART) * _PART)
    some = [*shown[:_PART], *shown[half : half + _PART]]
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
