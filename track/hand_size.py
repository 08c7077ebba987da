"""Size and proportions of a user's hands from some frames, and a check whether hands fit these frames.

The module first searches length and breadth of hands of mean proportions; then it fits proportions and marker
positions as far as the frames determine them. `calibrate` fits the rest on a longer capture. Where hands fit
badly, other gloves, sides and scales are measured in the same frames, and one that is clearly likelier is
suggested.
"""

from __future__ import annotations

import contextlib
import dataclasses
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float

from gloves.captures.capture import spacing
from gloves.fit import GloveFit, check_layout, mean_hand
from gloves.layout import MarkerLayout, list_layouts, load_layout
from gloves.takes.points import Status, spread_out
from handsim.arrays import Doubles
from handsim.errors import ArgumentError, HandSimError, HandSimWarning
from handsim.hand.model import HandModel
from handsim.hand.shape import ADULT_LENGTH, DIGITS, SIZES, HandShape, Side
from track.association.hand_state import HandState
from track.association.initialization import HandInitializer, distances_to_nearest
from track.calibration.energy import (
    QUICK_GAIN,
    QUICK_OPTIONS,
    eliminate_poses,
    first_estimate,
    levenberg_marquardt,
    shared_covariance,
    user_hand,
)
from track.calibration.hand_parameters import LENGTH, NUM_PARAMETERS, mirror_to_right
from track.config import TrackerConfig
from track.frames import StreamedFrame, TrackedHand
from track.kinematics.pose_solver import FEWEST_MARKERS, PoseSolver
from track.tracker import Tracker
from track.user import MEASURED, User, designed_glove, size_words
from train.labelers.protocol import Labeler, Labeling
from train.labelers.storage import labeler_at_once

# [m] hand lengths of the first labels, likeliest first
_TRIED_LENGTHS: Final = (0.187, 0.205, 0.168, 0.150, 0.125)
_SHORTEST, _LONGEST = 0.125, 0.225  # [m] hand lengths: 0.6 of an adult's to beyond ANSUR II's longest
_BREADTH_RANGE: Final = (0.88, 1.12)  # bounds of breadth over usual breadth: three standard deviations
_RELABELED_CHANGE: Final = 0.012  # [m] A larger change of length requires new labels.
_SIZE_PRECISION: Final = 0.001  # [m] precision of length and breadth
_BREADTH_SPREAD: Final = 0.04  # standard deviation of the breadth over the usual one of a length
_MARKER_SPREAD: Final = 0.002  # [m] standard deviation of glued markers per axis
_INDEPENDENT_FRAMES: Final = 4.0  # All frames count as this many, because errors of glue and flesh repeat.
_SEARCH_FRAMES: Final = 8  # frames of each hand in the search of length and breadth
_PROPORTION_FRAMES: Final = 40  # frames of each hand in the fit of proportions
_FOUND_SHARE: Final = 0.5  # A measured size is kept if its hands are found in this share of the frames.
# A size whose hands fit well needs this share only, because touching hands are seldom initialized.
_LEAST_WELL_FITTED_SHARE: Final = 0.1
# [m] largest median RMS distance of hands that fit well; false hands exceed it
_WELL_FITTED_RMS: Final = 0.00175
_FEWEST_FRAMES: Final = 3  # A size needs this many frames.
_MISSING_SHARE: Final = 0.2  # A frame shows a hand if at most this share of its markers is missing.
_FITTED: Final = (Status.TRACKED, Status.INITIALIZED)
_PATIENCE: Final = 20  # After this many frames with enough points but no hand, another size is tried.
_NUM_WINDOWS: Final = 8  # parts of a capture that are used
_WINDOW_FRAMES: Final = 16  # frames of each part
_INTERVAL_95: Final = 2.0  # standard deviations of a 95 % interval
_USUAL_CONFIG: Final = TrackerConfig()
# finds hands of few markers before they are measured
_LENIENT_CONFIG: Final = TrackerConfig(least_evidence=2.0)
_FIT_STEPS, _FEW_STEPS = 15, 2  # steps to fit proportions, and to follow a slip from a tracked hand
_LEAST_PRECISION: Final = 1.0  # [1/m^2] lower bound of a shift's precision; avoids a division by zero
_COMPARED_PART: Final = 30  # Hands are compared in two parts of this many frames.
_FEWEST_COMPARED: Final = 10  # Hands are compared in at least this many frames.
AT_HAND: Final = 0.04
"""Distance from a hand's markers within which a point counts as its own [m]."""
_UNEXPLAINED_PENALTY: Final = 3.0  # log-odds lost per unlabeled point at a hand, and per missing marker
_GOOD_FOUND_SHARE: Final = 0.6  # share of the frames in which a good fit finds hands
_MOST_MISSING, _MOST_NEAR = 0.15, 0.2  # missing markers and nearby points of a good fit, per marker
_MOST_HIDDEN: Final = 0.35  # missing markers of a good fit, per marker, if every marker is seen at times
_FEW_NEAR_POINTS: Final = 2.5  # number of nearby points that may be ghosts
_MOST_RMS: Final = 0.004  # [m] median RMS distance of a good fit
_SUGGESTED_SHARE: Final = 0.5  # Suggested hands must be found in this share of the frames.
_GLOVE_RATIO: Final = 1.15  # Another glove is suggested if its log-odds are this many times ours.
_SCALE_RATIO: Final = 2.0  # Another scale is suggested if its log-odds are this many times ours.
_UNITS: Final = {"millimeters": 1e-3, "centimeters": 1e-2, "meters": 1.0, "inches": 0.0254, "feet": 0.3048}
_STATED_UNITS: Final = ("millimeters", "centimeters", "meters")  # units that files can state
_WAND_SCALES: Final = (2.0, 0.5)  # scales if the calibration wand's length was entered wrongly
_MOST_SPACING_RATIO: Final = 4.0  # ratio of spacings beyond which points cannot be a hand at this scale
_LEAST_SPACING: Final = 1e-9  # [m] avoids a division by zero
_MOST_FOLDER_GLOVES: Final = 16  # largest number of tried gloves of the working folder


class SizeFit(NamedTuple):
    """Measured hands."""

    worn: dict[Side, GloveFit]  # those that were seen, of one shape
    rms: float  # median RMS distance of the markers from their hands [m]
    spread: float  # standard deviation of the hands' length [m]

    @property
    def shape(self) -> HandShape:
        """The shape of a hand; that of the other is its mirror image."""
        return next(iter(self.worn.values())).shape

    def __str__(self) -> str:
        """Length and breadth, and the 95 % uncertainty of the length [mm]."""
        hand = next(iter(self.worn.values()))
        return f"{size_words(hand)}, unsure by {1e3 * _INTERVAL_95 * self.spread:.0f} mm"

    def hands(self, sides: Sequence[Side]) -> tuple[GloveFit, ...]:
        """The measured hands of the given sides; one that was not seen is the mirror image of the other."""
        some = next(iter(self.worn.values()))
        return tuple(self.worn.get(side, some).with_side(side) for side in sides)


def sample_frames(frames: Sequence[StreamedFrame]) -> list[StreamedFrame]:
    """Parts of a capture for `fit_size`, each of consecutive frames: beginning, end and six between."""
    if len(frames) <= _NUM_WINDOWS * _WINDOW_FRAMES:
        return list(frames)
    starts = np.linspace(0, len(frames) - _WINDOW_FRAMES, _NUM_WINDOWS).astype(int)
    return [frame for start in starts for frame in frames[start : start + _WINDOW_FRAMES]]


def fit_size(
    frames: Sequence[StreamedFrame],
    layout: MarkerLayout,
    sides: Sequence[Side],
    labeler: Labeler,
    *,
    is_quick: bool = False,
) -> SizeFit | None:
    """Measure size and proportions of the hands in some frames; None if no hand is found.

    A child's hand may pass for a larger hand, some markers of which then get no label or a wrong one. A hand
    is therefore compared with smaller ones if points beside it have no label, or if a marker is never seen.
    """
    some = [] if is_quick else _compared_frames(frames)
    for config in (_LENIENT_CONFIG,) if is_quick else (_USUAL_CONFIG, _LENIENT_CONFIG):
        rated: list[tuple[float, SizeFit]] = []
        for length in _TRIED_LENGTHS[:2] if is_quick else _TRIED_LENGTHS:
            if any(length > fit.shape.length for _, fit in rated):
                continue
            fit = _fit_from(length, frames, layout, sides, labeler, config)
            if fit is None or not (config is _USUAL_CONFIG or _is_found(fit, frames, sides, labeler)):
                continue
            if not some:
                return fit
            match = _rate(some, fit.hands(sides), labeler)
            if match.is_good and match.is_whole:
                return fit
            rated.append((match.log_odds, fit))
        if rated:
            return max(rated, key=lambda one: one[0])[1]
    return None


def measured_user(
    frames: Sequence[StreamedFrame], user: User, labeler: Labeler, *, warns: bool = True
) -> User:
    """A user with hands measured in some frames; unchanged, with a warning, if no hand is found."""
    size = fit_size(frames, user.layout, user.sides, labeler)
    if size is not None:
        return User(size.hands(user.sides), f"{MEASURED}{size}")
    if warns:
        none = (
            f"no hand was found to measure its size, in {_FEWEST_FRAMES} frames with most of its markers; "
            f"size {user.notes} is used, or name a size"
        )
        warnings.warn(none, HandSimWarning, stacklevel=3)
    return user


def hand_between(one: GloveFit, other: GloveFit, share: float) -> GloveFit:
    """Interpolate linearly between two sizes of a hand in its glove."""

    def blend(first: Any, last: Any, *names: str) -> dict[str, Any]:
        return {name: (1.0 - share) * getattr(first, name) + share * getattr(last, name) for name in names}

    measures = [field.name for field in dataclasses.fields(HandShape) if field.name != "side"]
    shape = dataclasses.replace(other.shape, **blend(one.shape, other.shape, *measures))
    worn = blend(one.attachment, other.attachment, "points", "normals")
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
    """Measure hands that are first labeled as hands of a given length [m]."""
    markers: dict[Side, Doubles] = {}
    for _ in range(2):  # Labels improve once the hands are of about the right size.
        start = mean_hand(length, usual_breadth(length), layout)
        markers = _labeled_markers(frames, start, sides, labeler, config) or markers
        if not markers:
            return None
        search, before = _Search(list(markers.values()), start), length
        length = search.length(usual_breadth, _SHORTEST, _LONGEST)
        if abs(length - before) <= _RELABELED_CHANGE:
            break
    return _fit_proportions(markers, mean_hand(*search.measures(length), layout))


def _is_found(fit: SizeFit, frames: Sequence[StreamedFrame], sides: Sequence[Side], labeler: Labeler) -> bool:
    """Whether measured hands are found in most frames, or in some where most markers fit well."""
    hands = fit.hands(sides)
    tracker, count = Tracker(hands, labeler), hands[0].layout.num_markers
    enough = [frame for frame in frames if _are_enough(frame, count)]
    tracked = [tracker.step(frame.points, frame.ids, frame.time).hands for frame in enough]
    num_found = sum(any(hand.has_pose for hand in hands) for hands in tracked)
    if num_found >= max(1.0, _FOUND_SHARE * len(enough)):
        return True
    shown = [[hand.rms for hand in hands if _is_shown(hand, count)] for hands in tracked]
    rms = [one for row in shown for one in row]
    is_enough = sum(map(bool, shown)) >= max(1.0, _LEAST_WELL_FITTED_SHARE * len(enough))
    return is_enough and float(np.median(rms)) <= _WELL_FITTED_RMS


def _are_enough(frame: StreamedFrame, count: int) -> bool:
    """Whether a frame has points for most of the markers of a hand."""
    return len(frame.points) >= (1.0 - _MISSING_SHARE) * count


def _is_shown(hand: TrackedHand, count: int) -> bool:
    """Whether a hand is fitted with most of its markers."""
    return hand.status in _FITTED and len(hand.filled) <= _MISSING_SHARE * count


def usual_breadth(length: float) -> float:
    """The usual breadth of a hand of some length [m]: interpolated in the five sizes, proportional beyond."""
    lengths, breadths = np.array(sorted(SIZES.values())).T
    inside = float(np.clip(length, lengths[0], lengths[-1]))
    return float(np.interp(inside, lengths, breadths)) * length / inside


def _labeled_markers(
    frames: Sequence[StreamedFrame],
    hand: GloveFit,
    sides: Sequence[Side],
    labeler: Labeler,
    config: TrackerConfig,
) -> dict[Side, Float[np.ndarray, "F M 3"]]:
    """Labeled markers [m] of each hand shown often enough, mirrored to a right hand, NaN where missing."""
    tracker = Tracker([hand.with_side(side) for side in sides], labeler, config=config)
    count = hand.layout.num_markers
    found: list[list[Doubles]] = [[] for _ in sides]
    in_vain = 0
    for frame in frames:
        if in_vain == _PATIENCE and not any(found):
            break
        in_vain += _are_enough(frame, count)
        for seen, some in zip(tracker.step(frame.points, frame.ids, frame.time).hands, found, strict=True):
            if _is_shown(seen, count):
                some.append(seen.seen_markers)
    return {
        side: spread_out(np.array(some), _PROPORTION_FRAMES) @ mirror_to_right(side)
        for side, some in zip(sides, found, strict=True)
        if len(some) >= _FEWEST_FRAMES
    }


class _Search:
    """Search of the likeliest length and breadth of hands of mean proportions, given labeled markers."""

    # The distribution of people's sizes counts, too, because few markers fit hands of many sizes.

    def __init__(self, markers: Sequence[Float[np.ndarray, "F M 3"]], start: GloveFit) -> None:
        few = [spread_out(some, _SEARCH_FRAMES) for some in markers]
        seen = np.mean([np.isfinite(some[..., 0]).sum(axis=1).mean() for some in few])
        self._evidence = _INDEPENDENT_FRAMES * float(seen) / _MARKER_SPREAD**2  # [1/m^2]
        self._markers, self._layout = np.concatenate(few), start.layout
        self._poses = PoseSolver(start).solve(self._markers).qpos

    def length(self, breadth: Callable[[float], float], shortest: float, longest: float) -> float:
        """The likeliest length [m] in a range; `breadth` maps a length to a breadth [m]."""
        return _minimize(lambda tried: self._cost(tried, breadth(tried)), shortest, longest)

    def measures(self, length: float) -> tuple[float, float]:
        """The likeliest length and breadth [m]."""
        usual = usual_breadth(length)
        low, high = (factor * usual for factor in _BREADTH_RANGE)
        breadth = _minimize(lambda tried: self._cost(length, tried), low, high)
        return self.length(lambda tried: breadth, 0.95 * length, 1.05 * length), breadth

    def _cost(self, length: float, breadth: float) -> float:
        solver = PoseSolver(mean_hand(length, breadth, self._layout))
        beyond = (length - ADULT_LENGTH[0]) / ADULT_LENGTH[1]
        broad = (breadth / usual_breadth(length) - 1.0) / _BREADTH_SPREAD
        square = float(np.median(solver.solve(self._markers, self._poses).rms)) ** 2
        return 0.5 * (self._evidence * square + beyond**2 + broad**2)


def _minimize(function: Callable[[float], float], low: float, high: float) -> float:
    """The argument between two bounds [m] with the least value of a function."""
    from scipy.optimize import minimize_scalar

    options = {"xatol": _SIZE_PRECISION}
    return float(minimize_scalar(function, bounds=(low, high), method="bounded", options=options).x)


def _fit_proportions(markers: Mapping[Side, Float[np.ndarray, "F M 3"]], start: GloveFit) -> SizeFit:
    """Fit right hands of one shape, each with its own places of markers, by a calibration without touches."""
    count, ends = start.layout.num_markers, np.cumsum([len(seen) for seen in markers.values()])
    # One problem has the markers of all hands as columns, missing in the frames of other hands.
    columns = np.full((ends[-1], len(markers) * count, 3), np.nan)
    for hand, (stop, seen) in enumerate(zip(ends, markers.values(), strict=True)):
        columns[stop - len(seen) : stop, hand * count : (hand + 1) * count] = seen
    solved = PoseSolver(start).solve(np.concatenate(list(markers.values())))
    problem, estimate = first_estimate(start, columns, solved.qpos, **QUICK_OPTIONS)
    estimate, fit, _ = levenberg_marquardt(problem, estimate, 0, _FIT_STEPS, None, QUICK_GAIN)
    worn, rms = dict[Side, GloveFit](), list[Doubles]()
    for hand, (stop, (side, seen)) in enumerate(zip(ends, markers.items(), strict=True)):
        places = estimate.coordinates.part(hand * count, (hand + 1) * count)
        right = user_hand(start, problem, dataclasses.replace(estimate, coordinates=places))
        rms.append(PoseSolver(right).solve(seen, estimate.qpos[stop - len(seen) : stop]).rms)
        worn[side] = right.with_side(side)
    variance = shared_covariance(problem, estimate, fit)[0][LENGTH, LENGTH]
    length = next(iter(worn.values())).shape.length
    return SizeFit(worn, float(np.median(np.concatenate(rms))), length * float(np.sqrt(variance)))


def glove_shifts(
    seen: Float[np.ndarray, "F M 3"], worn: GloveFit
) -> tuple[Float[np.ndarray, "F"], Float[np.ndarray, "F"]]:
    """Shift of a whole glove along the bones from each frame on, in [m] and in standard deviations.

    Poses, proportions and marker places are fitted with each shift, to first order, because wrist and fingers
    follow a slipping glove except at their joints.

    Args:
        seen: Markers in some frames [m], NaN where missing.
        worn: The hand as tracked.
    """
    right = worn.with_side("right")
    seen = seen @ mirror_to_right(worn.side)
    problem, estimate = first_estimate(right, seen, PoseSolver(right).solve(seen).qpos, **QUICK_OPTIONS)
    estimate, fit, _ = levenberg_marquardt(problem, estimate, 0, _FEW_STEPS, None, QUICK_GAIN)
    _, by_shared, residuals, _ = jacobians = problem.weighted_jacobians(estimate, fit)
    equations = problem.normal_equations(estimate, fit, jacobians)
    reduced, solved = eliminate_poses(equations, 0.0)
    along = right.model.rest_transforms[right.attachment.main_bones, :3, 0]
    unit_shift = np.concatenate([np.zeros(NUM_PARAMETERS), along.ravel()])
    of_frames = np.einsum("fr,frs->fs", by_shared @ unit_shift, np.dstack([by_shared, residuals]))
    of_frames -= np.einsum("fp,fps->fs", equations.mixed @ unit_shift, solved)
    late = of_frames[::-1].cumsum(axis=0)[::-1]
    absorbed = late[:, :-1] @ np.linalg.inv(reduced[:, :-1])  # by the shared unknowns, of each shift
    precision = late[:, :-1] @ unit_shift - (absorbed * late[:, :-1]).sum(axis=1)
    precision = np.maximum(precision, _LEAST_PRECISION)
    shifts = (absorbed @ reduced[:, -1] - late[:, -1]) / precision
    return shifts, shifts * np.sqrt(precision)


class _Fit(NamedTuple):
    """How well hands fit some frames."""

    log_odds: float = 0.0  # log-odds of the hands less penalties, mean over the frames
    found: dict[Side, int] = {}  # noqa: RUF012
    """Number of frames in which each hand is found."""
    shown: int = 0  # number of frames in which at least one hand is found
    is_good: bool = False  # whether the fit is so good that no other glove is tried
    # whether every marker is seen at times; otherwise the glove may have fewer markers
    is_whole: bool = False


class _RatedGlove(NamedTuple):
    """A glove or scale that may fit better."""

    name: str  # name of the glove, or path of its file
    layout: MarkerLayout
    scale: float  # factor that converts the points to meters
    fit: _Fit


class _LazyLabeler:
    """`labeler_at_once`, built at its first use, because rigid bodies alone never need it."""

    def __init__(self, layout: MarkerLayout) -> None:
        self._layout, self.marker_names = layout, layout.names

    def label_frames(self, frames: Sequence[Float[np.ndarray, "N 3"]]) -> list[Labeling]:
        """See `train.labelers.protocol.Labeler`."""
        return labeler_at_once(self._layout).label_frames(frames)


def check_scale(frames: Sequence[StreamedFrame], hands: Sequence[GloveFit], labeler: Labeler) -> None:
    """Refuse points at a wrong scale, recognized by the distances between neighbors."""
    some = _compared_frames(frames)
    if not some:
        return
    found = float(np.median([spacing(frame.points) for frame in some]))
    factor = spacing(hands[0].attachment.points) / max(found, _LEAST_SPACING)
    if 1.0 / _MOST_SPACING_RATIO < factor < _MOST_SPACING_RATIO:
        return
    scale = min(_scales(), key=lambda one: abs(np.log(one / factor)))
    scaled = [dataclasses.replace(frame, points=scale * frame.points) for frame in some]
    fit = _measured_fit(scaled, designed_glove(hands[0].layout), labeler)
    if fit.is_good and fit.log_odds > _SCALE_RATIO * _rate(some, hands, labeler).log_odds:
        raise ArgumentError(_scale_message(1.0 / scale))


def check_hands(
    frames: Sequence[StreamedFrame], hands: Sequence[GloveFit], labeler: Labeler, *, options: Collection[str]
) -> None:
    """Warn of hands that fit badly if other hands fit clearly better; refuse a wrong unit.

    The warning names those remedies that are among the command's `options`.
    """
    # A bad fit takes seconds. Gloves of .toml files in the working folder are tried, too.
    some = _compared_frames(frames)
    if not some:
        return
    asked = _rate(some, hands, labeler)
    if asked.is_good:
        return
    glove = designed_glove(hands[0].layout)
    others = _rate_gloves(some, glove, labeler)  # A glove of few markers fits anything somehow.
    likely = [other for other in others if other.layout == glove or other.fit.is_good]
    best = max(likely, key=lambda other: other.fit.log_odds)
    fit, factor = best.fit, _GLOVE_RATIO if best.scale == 1.0 else _SCALE_RATIO
    if fit.shown < _SUGGESTED_SHARE * len(some) or fit.log_odds <= factor * asked.log_odds:
        return
    if best.scale != 1.0:
        raise ArgumentError(_scale_message(1.0 / best.scale))
    there = [side for side, count in fit.found.items() if count >= _SUGGESTED_SHARE * fit.shown]
    remedy = [] if set(there) <= {hand.side for hand in hands} else [f"--hands {' '.join(there)}"]
    named = "two hands" if len(there) == 2 else f"a {there[0]} hand"
    if best.layout != glove:
        named += f" in glove '{best.name}'"
        remedy.append(f"--glove {best.name}")
    if remedy:
        fewer = f" instead of {asked.shown}" if asked.shown < fit.shown else ""
        shares = f"in {fit.shown} of {len(some)} frames{fewer}"
        known = [one for one in remedy if one.split()[0] in options]
        how = f"name it ({' '.join(known)})" if known else "calibrate these, or leave out the hands given"
        warnings.warn(f"the points fit {named} better ({shares}); {how}", HandSimWarning, stacklevel=3)


def _compared_frames(frames: Sequence[StreamedFrame]) -> list[StreamedFrame]:
    """Frames in which hands are compared; none if there are too few."""
    shown = [frame for frame in frames if len(frame.points) >= FEWEST_MARKERS]
    half = max(_COMPARED_PART, len(shown) // (2 * _COMPARED_PART) * _COMPARED_PART)
    some = [*shown[:_COMPARED_PART], *shown[half : half + _COMPARED_PART]]
    return some if len(some) >= _FEWEST_COMPARED else []


def _rate_gloves(frames: Sequence[StreamedFrame], glove: MarkerLayout, labeler: Labeler) -> list[_RatedGlove]:
    """Fits of both hands in the given glove, in other gloves, and at other scales."""
    others = [_RatedGlove(glove.name, glove, 1.0, _measured_fit(frames, glove, labeler))]
    if others[0].fit.is_good:
        return others
    for name, layout in _known_gloves():
        if layout != glove:
            others.append(_RatedGlove(name, layout, 1.0, _measured_fit(frames, layout, _LazyLabeler(layout))))
        if others[-1].fit.is_good and others[-1].fit.is_whole:
            return others
    if max(other.fit.shown for other in others) < _SUGGESTED_SHARE * len(frames):
        for scale in _scales():
            scaled = [dataclasses.replace(frame, points=scale * frame.points) for frame in frames]
            others.append(_RatedGlove(glove.name, glove, scale, _measured_fit(scaled, glove, labeler)))
    return others


def _measured_fit(frames: Sequence[StreamedFrame], layout: MarkerLayout, labeler: Labeler) -> _Fit:
    """Measure the hands of a glove in some frames, and rate their fit."""
    size = fit_size(frames, layout, layout.sides, labeler, is_quick=True)
    return _Fit() if size is None else _rate(frames, size.hands(layout.sides), labeler)


def _rate(frames: Sequence[StreamedFrame], hands: Sequence[GloveFit], labeler: Labeler) -> _Fit:
    """Rate the fit of hands to some frames."""
    tracker, markers = Tracker(hands, labeler), hands[0].layout.num_markers
    score = HandInitializer([HandState(hands[0])], labeler).score
    found = {hand.side: 0 for hand in hands}
    rms, missing, near, count, log_odds = [], [], [], 0, 0.0
    unseen = {hand.side: set(range(markers)) for hand in hands}
    for frame in frames:
        tracked = tracker.step(frame.points, frame.ids, frame.time)
        there = [one for one in tracked.hands if one.status in _FITTED]
        count += bool(there)
        free = frame.points[tracked.labels < 0]
        for hand in there:
            found[hand.side] += 1
            rms.append(hand.rms)
            missing.append(len(hand.filled))
            unseen[hand.side] &= {int(marker) for marker in hand.filled}
            near.append(int((distances_to_nearest(free, hand.markers) < AT_HAND).sum()))
            odds = score(markers - missing[-1], hand.rms)
            log_odds += max(0.0, odds - _UNEXPLAINED_PENALTY * (missing[-1] + near[-1]))
    gone = [unseen[side] for side, times in found.items() if times]
    lost = max((_lost_digit(hands[0], one) for one in gone), key=len, default=set[int]())
    is_whole = not any(one - lost for one in gone)
    is_good = (
        count >= _GOOD_FOUND_SHARE * len(frames)
        and float(np.median(rms)) <= _MOST_RMS
        and float(np.mean(missing)) - len(lost) <= (_MOST_HIDDEN if is_whole else _MOST_MISSING) * markers
        and float(np.mean(near)) <= max(_MOST_NEAR * markers, _FEW_NEAR_POINTS)
    )
    return _Fit(log_odds / len(frames), found, count, is_good, is_whole)


def _lost_digit(hand: GloveFit, unseen: set[int]) -> set[int]:
    """The markers of a digit of which none is ever seen, as of a missing finger; empty if there is none."""
    digits = hand.attachment.digits
    own = [set(np.flatnonzero(digits == digit).tolist()) for digit in range(len(DIGITS))]
    lost = [markers for markers in own if markers and markers <= unseen]
    return lost[0] if len(lost) == 1 else set()


def _known_gloves() -> list[tuple[str, MarkerLayout]]:
    """Shipped gloves and those of the working folder with their names or paths, most markers first."""
    found = [(name, load_layout(name)) for name in list_layouts()]
    for path in sorted(Path().glob("*.toml"))[:_MOST_FOLDER_GLOVES]:
        with contextlib.suppress(HandSimError):  # a file of another kind, or a glove that no hand wears
            layout = load_layout(path)
            check_layout(layout)
            found.append((str(path), layout))
    return sorted(found, key=lambda one: -one[1].num_markers)


def _scales() -> list[float]:
    """Factors that correct a mistaken unit of length or wand length."""
    pairs = {_UNITS[true] / _UNITS[read] for read in _STATED_UNITS for true in _UNITS if true != read}
    return [*sorted(pairs), *_WAND_SCALES]


def _scale_message(times: float) -> str:
    """The message that points fit hands at `times` their size."""
    pairs = ((true, read) for read in _STATED_UNITS for true in _UNITS)
    units = [f"in {t}, read as {r}" for t, r in pairs if np.isclose(_UNITS[t] / _UNITS[r] * times, 1.0)]
    cause = f"the file is probably {' or '.join(units)}" if units else "had the calibration wand its length?"
    return (
        f"the points fit hands at {times:.3g} of their size: {cause}; correct the unit that the file states, "
        f"or multiply its positions by {1.0 / times:.4g}"
    )
