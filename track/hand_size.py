"""Size and proportions of a user's hands from some frames, and a check whether hands fit these frames.

Length and breadth of hands of mean proportions are searched first; then proportions and marker positions are
fitted as far as the frames determine them. `calibrate` fits the rest on a longer capture. Where hands fit
badly, other gloves, sides and scales are measured in the same frames, and the likeliest of them is suggested
if it is clearly likelier.
"""

from __future__ import annotations

import contextlib
import dataclasses
import warnings
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from gloves.captures.capture import spacing
from gloves.fit import GloveFit, check_layout, mean_hand
from gloves.layout import MarkerLayout, list_layouts, load_layout
from gloves.takes.points import Status
from handsim.errors import ArgumentError, HandSimError, HandSimWarning
from handsim.hand.model import HandModel
from handsim.hand.shape import SIZES, HandShape, Side
from handsim.space.transforms import MIRROR
from track.association.hand_state import HandState
from track.association.initialization import HandInitializer, distances_to_nearest
from track.calibration.energy import (
    QUICK_GAIN,
    QUICK_OPTIONS,
    Estimate,
    Problem,
    eliminate_poses,
    first_estimate,
    levenberg_marquardt,
    shared_covariance,
    user_hand,
)
from track.calibration.hand_parameters import LENGTH, NUM_PARAMETERS
from track.config import TrackerConfig
from track.frames import StreamedFrame, TrackedHand
from track.kinematics.pose_solver import FEWEST_MARKERS, PoseSolver
from track.tracker import Tracker
from track.user import MEASURED, User, designed_glove
from train.labelers.protocol import Labeler, Labeling
from train.labelers.storage import labeler_at_once

_LENGTHS: Final = (0.187, 0.205, 0.168, 0.150, 0.125)  # [m] tried for the first labels, the likeliest first
_FAR: Final = 0.012  # [m] Hands are labeled again after a larger change of length.
_MOST_FRAMES: Final = 40  # frames of each hand that its size is fitted to
_FEWEST: Final = 3  # A size needs this many frames.
_MISSING: Final = 0.2  # A frame shows a hand if at most this share of its markers is missing.
_FITTED: Final = (Status.TRACKED, Status.INITIALIZED)
_WINDOWS: Final = 8  # parts of a capture that are used
_WINDOW: Final = 16  # frames of each part; after as many in vain another size is tried
_USUAL: Final = TrackerConfig()
_LENIENT: Final = TrackerConfig(least_evidence=2.0)  # for hands of few markers before they are measured
_FIT_STEPS, _FEW_STEPS = 15, 2
_PART: Final = 30  # Hands are compared in two parts of this many frames.
AT_HAND: Final = 0.04
"""Distance from a hand's markers within which a point counts as its own [m]."""
_PENALTY: Final = 3.0  # log-odds lost for such a point without a label, and for a missing marker
_GOOD: Final = 0.45  # evidence of a fit so good that no others are tried; moving skin leaves 0.5 to 0.7
_MOST_NEAR: Final = 0.25  # nearby points of such a fit, per marker; dense19 taken for sparse13 has 0.4
_LEAST: Final = 0.18  # evidence that hands of few markers need to be measured; touching ones have 0.5
_BETTER: Final = 1.15  # Suggest other hands only if their log-odds are 1.15 times ours.
_UNITS: Final = {"millimeters": 1e-3, "centimeters": 1e-2, "meters": 1.0, "inches": 0.0254, "feet": 0.3048}
_READ: Final = ("millimeters", "centimeters", "meters")  # units that files state
_WANDS: Final = (2.0, 0.5)  # scales if the calibration wand's length was entered wrongly
_MOST_OWN: Final = 16  # largest number of tried gloves of the working folder


class SizeFit(NamedTuple):
    """Measured hands."""

    hand: GloveFit  # the right one; a left hand is its mirror image
    rms: float  # median RMS distance of the markers from this hand [m]
    spread: float  # standard deviation of its length [m]

    def __str__(self) -> str:
        """Length and breadth, and the 95 % uncertainty of the length [mm]."""
        shape = self.hand.shape
        return (
            f"{1e3 * shape.length:.0f} x {1e3 * shape.breadth:.0f} mm, unsure by {2e3 * self.spread:.0f} mm"
        )

    def hands(self, sides: Sequence[Side]) -> tuple[GloveFit, ...]:
        """The measured hands of the given sides."""
        return tuple(self.hand.with_side(side) for side in sides)


def sample_frames(frames: Sequence[StreamedFrame]) -> list[StreamedFrame]:
    """Parts of a capture for `fit_size`, each of consecutive frames: beginning, end and six between."""
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
    """Measure size and proportions of the hands in some frames; None if no hand is found.

    A child's hand, some markers of which get no label or a wrong one, may pass for a larger hand. So a hand
    beside which points have no label, or of which a marker is never seen, is compared with smaller ones.
    """
    some = _compared(frames)
    for config in (_LENIENT,) if is_quick else (_USUAL, _LENIENT):
        rated: list[tuple[float, SizeFit]] = []
        for length in _LENGTHS[:2] if is_quick else _LENGTHS:
            if any(length > fit.hand.shape.length for _, fit in rated):
                continue
            fit = _fit_from(length, frames, layout, sides, labeler, config)
            if fit is None:
                continue
            if is_quick or not some:
                return fit
            match = _fit(some, fit.hands(sides), labeler)
            if match.is_good:
                return fit
            if config is _USUAL or match.evidence >= _LEAST:
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
        none = f"no hand was found to measure its size; size {user.notes} is used, or name a size"
        warnings.warn(none, HandSimWarning, stacklevel=3)
    return user


def hand_between(one: GloveFit, other: GloveFit, share: float) -> GloveFit:
    """Interpolate linearly between two sizes of a hand in its glove."""

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
    """Measure hands that are first labeled as hands of a given length [m]."""
    fit = None
    for _ in range(2):  # Labels improve with hands of about their own size.
        start = mean_hand(length, usual_breadth(length), layout)
        markers = _label(frames, start, sides, labeler, config)
        if markers:
            fit = _fit_proportions(np.concatenate(markers), start)
        if fit is None or abs(fit.hand.shape.length - length) <= _FAR:
            break
        length = fit.hand.shape.length
    return fit


def _are_enough(frame: StreamedFrame, count: int) -> bool:
    """Whether a frame has points for most of the markers of a hand."""
    return len(frame.points) >= (1.0 - _MISSING) * count


def _is_shown(hand: TrackedHand, count: int) -> bool:
    """Whether a hand is fitted with most of its markers."""
    return hand.status in _FITTED and len(hand.filled) <= _MISSING * count


def usual_breadth(length: float) -> float:
    """The usual breadth of a hand of some length [m]: interpolated in the five sizes, proportional beyond."""
    lengths, breadths = 1e-3 * np.array(sorted(SIZES.values())).T
    inside = float(np.clip(length, lengths[0], lengths[-1]))
    return float(np.interp(inside, lengths, breadths)) * length / inside


def _label(
    frames: Sequence[StreamedFrame],
    hand: GloveFit,
    sides: Sequence[Side],
    labeler: Labeler,
    config: TrackerConfig,
) -> list[Float[np.ndarray, "F M 3"]]:
    """Labeled markers [m] of each hand shown often enough, mirrored to a right hand, NaN where missing."""
    tracker = Tracker([hand.with_side(side) for side in sides], labeler, config=config)
    count = hand.layout.num_markers
    found: list[list[NDArray[np.float64]]] = [[] for _ in sides]
    in_vain = 0
    for frame in frames:
        if in_vain == _WINDOW and not any(found):
            break
        in_vain += _are_enough(frame, count)
        for seen, some in zip(tracker.step(frame.points, frame.ids, frame.time).hands, found, strict=True):
            if _is_shown(seen, count):
                markers = seen.markers.copy()
                markers[seen.filled] = np.nan
                some.append(markers)
    return [
        _spread_out(np.array(some)) @ (MIRROR if side == "left" else np.eye(3))
        for side, some in zip(sides, found, strict=True)
        if len(some) >= _FEWEST
    ]


def _spread_out(markers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Some of these frames of markers (F, M, 3), evenly spaced."""
    rows = np.linspace(0, len(markers) - 1, min(_MOST_FRAMES, len(markers))).astype(int)
    return np.asarray(markers[rows])


def _fit_proportions(seen: Float[np.ndarray, "F M 3"], start: GloveFit) -> SizeFit:
    """Fit one shape to right hands in some frames, by a calibration without touches."""
    problem, estimate = _first_proportions(seen, start)
    estimate, fit, _ = levenberg_marquardt(problem, estimate, 0, _FIT_STEPS, None, QUICK_GAIN)
    hand = user_hand(start, problem, estimate)
    rms = float(np.median(PoseSolver(hand).solve(seen, estimate.qpos).rms))
    variance = shared_covariance(problem, estimate, fit)[0][LENGTH, LENGTH]
    return SizeFit(hand, rms, hand.shape.length * float(np.sqrt(variance)))


def _first_proportions(seen: Float[np.ndarray, "F M 3"], start: GloveFit) -> tuple[Problem, Estimate]:
    """The problem of one shape of right hands in some frames, and the start as first estimate."""
    return first_estimate(start, seen, PoseSolver(start).solve(seen).qpos, **QUICK_OPTIONS)


def glove_shifts(
    seen: Float[np.ndarray, "F M 3"], worn: GloveFit
) -> tuple[Float[np.ndarray, "F"], Float[np.ndarray, "F"]]:
    """How far a whole glove is along the bones from each frame on [m], and the same in standard deviations.

    Poses, proportions and places are fitted along with each shift, to first order: wrist and fingers follow a
    glove that slips, but not where joints turn.

    Args:
        seen: Markers in some frames [m], NaN where missing.
        worn: The hand as tracked.
    """
    right = worn.with_side("right")
    problem, estimate = _first_proportions(seen @ (MIRROR if worn.side == "left" else np.eye(3)), right)
    estimate, fit, _ = levenberg_marquardt(problem, estimate, 0, _FEW_STEPS, None, QUICK_GAIN)
    _, by_shared, residuals, _ = jacobians = problem.weighted_jacobians(estimate, fit)
    equations = problem.normal_equations(estimate, fit, jacobians)
    reduced, solved = eliminate_poses(equations, 0.0)
    along = right.model.rest_transforms[right.attachment.main_bones, :3, 0]
    way = np.concatenate([np.zeros(NUM_PARAMETERS), along.ravel()])
    of_frames = np.einsum("fr,frs->fs", by_shared @ way, np.dstack([by_shared, residuals]))
    of_frames -= np.einsum("fp,fps->fs", equations.mixed @ way, solved)
    late = of_frames[::-1].cumsum(axis=0)[::-1]
    left = late[:, :-1] @ np.linalg.inv(reduced[:, :-1])  # what the shared unknowns take of each shift
    precision = np.maximum(late[:, :-1] @ way - (left * late[:, :-1]).sum(axis=1), 1.0)  # [1/m^2], never zero
    shifts = (left @ reduced[:, -1] - late[:, -1]) / precision
    return shifts, shifts * np.sqrt(precision)


class _Fit(NamedTuple):
    """How well hands fit some frames."""

    log_odds: float = 0.0  # log-odds of the hands less penalties, mean over the frames
    evidence: float = 0.0  # the same for one hand, as share of that of a hand without noise and gaps
    found: dict[Side, int] = {}  # noqa: RUF012
    """Number of frames in which each hand is found."""
    shown: int = 0  # number of frames in which at least one hand is found
    is_good: bool = False  # whether the fit is so good that no others are tried


class _Other(NamedTuple):
    """A glove that may fit better."""

    name: str  # name of the glove, or path of its file
    layout: MarkerLayout
    fit: _Fit


class _AtOnce:
    """`labeler_at_once`, made at the first use: rigid bodies alone never need it."""

    def __init__(self, layout: MarkerLayout) -> None:
        self._layout, self.marker_names = layout, layout.names

    def label_frames(self, frames: Sequence[Float[np.ndarray, "N 3"]]) -> list[Labeling]:
        """See `train.labelers.protocol.Labeler`."""
        return labeler_at_once(self._layout).label_frames(frames)


def check_scale(frames: Sequence[StreamedFrame], hands: Sequence[GloveFit], labeler: Labeler) -> None:
    """Refuse points that are hands at the wrong scale that the distances between neighbors suggest."""
    some = _compared(frames)
    found = float(np.median([spacing(frame.points) for frame in some])) if some else 0.0
    if found == 0.0:
        return
    factor = spacing(hands[0].attachment.points) / found
    scale = min((1.0, *_scales()), key=lambda one: abs(np.log(one / factor)))
    if scale == 1.0:
        return
    scaled = [dataclasses.replace(frame, points=scale * frame.points) for frame in some]
    fit = _measured_fit(scaled, designed_glove(hands[0].layout), labeler)
    if fit.is_good and fit.log_odds > _BETTER * _fit(some, hands, labeler).log_odds:
        raise ArgumentError(_of_scale(1.0 / scale))


def check_hands(
    frames: Sequence[StreamedFrame],
    hands: Sequence[GloveFit],
    labeler: Labeler,
    *,
    options: Collection[str] = ("--hands", "--glove"),
) -> None:
    """Warn of hands that fit badly if those of the other side or of another glove fit clearly better."""
    # Takes seconds if the fit is bad. Gloves of .toml files in the working folder are tried, too.
    some = _compared(frames)
    asked = _fit(some, hands, labeler)
    if not some or asked.is_good:
        return
    glove = designed_glove(hands[0].layout)
    best = max(_others(some, glove, labeler), key=lambda other: other.fit.log_odds)
    fit = best.fit
    if not fit.is_good or fit.log_odds <= _BETTER * asked.log_odds:
        return
    there = [side for side, count in fit.found.items() if count >= 0.5 * fit.shown]
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


def _compared(frames: Sequence[StreamedFrame]) -> list[StreamedFrame]:
    """Frames in which hands are compared; none if there are too few."""
    shown = [frame for frame in frames if len(frame.points) >= FEWEST_MARKERS]
    half = max(_PART, len(shown) // (2 * _PART) * _PART)
    return [*shown[:_PART], *shown[half : half + _PART]] if len(shown) >= _FEWEST else []


def _others(frames: Sequence[StreamedFrame], glove: MarkerLayout, labeler: Labeler) -> Iterator[_Other]:
    """Fits of both hands in the given glove, then in other gloves until one fits well."""
    yield _Other(glove.name, glove, fit := _measured_fit(frames, glove, labeler))
    for name, layout in _gloves():
        if fit.is_good:
            return
        if layout != glove:
            yield _Other(name, layout, fit := _measured_fit(frames, layout, _AtOnce(layout)))


def _measured_fit(frames: Sequence[StreamedFrame], layout: MarkerLayout, labeler: Labeler) -> _Fit:
    """Measure the hands of a glove in some frames, and rate their fit."""
    size = fit_size(frames, layout, layout.sides, labeler, is_quick=True)
    return _Fit() if size is None else _fit(frames, size.hands(layout.sides), labeler)


def _fit(frames: Sequence[StreamedFrame], hands: Sequence[GloveFit], labeler: Labeler) -> _Fit:
    """Rate the fit of hands to some frames."""
    tracker, markers = Tracker(hands, labeler), hands[0].layout.num_markers
    score = HandInitializer([HandState(hands[0])], labeler).score
    found, shown, log_odds, beside = {hand.side: 0 for hand in hands}, 0, 0.0, 0
    for frame in frames:
        tracked = tracker.step(frame.points, frame.ids, frame.time)
        there = [one for one in tracked.hands if one.status in _FITTED]
        shown += bool(there)
        free = frame.points[tracked.labels < 0]
        for hand in there:
            found[hand.side] += 1
            missing = len(hand.filled)
            near = int((distances_to_nearest(free, hand.markers) < AT_HAND).sum())
            beside += near
            log_odds += max(0.0, score(markers - missing, hand.rms) - _PENALTY * (missing + near))
    times = max(1, sum(found.values()))
    evidence = log_odds / times / score(markers, _USUAL.marker_noise) * shown / max(1, len(frames))
    is_good = evidence >= _GOOD and beside <= _MOST_NEAR * markers * times
    return _Fit(log_odds / max(1, len(frames)), evidence, found, shown, is_good)


def _gloves() -> list[tuple[str, MarkerLayout]]:
    """Gloves of the working folder, then shipped ones, with their paths or names, most markers first."""
    own, shipped = list[tuple[str, MarkerLayout]](), [(name, load_layout(name)) for name in list_layouts()]
    for path in sorted(Path().glob("*.toml"))[:_MOST_OWN]:
        with contextlib.suppress(HandSimError):  # a file of another kind, or a glove that no hand wears
            layout = load_layout(path)
            check_layout(layout)
            own.append((str(path), layout))
    return [one for some in (own, shipped) for one in sorted(some, key=lambda one: -one[1].num_markers)]


def _scales() -> list[float]:
    """Factors that correct a mistaken unit of length or wand length."""
    pairs = {_UNITS[true] / _UNITS[read] for read in _READ for true in _UNITS if true != read}
    return [*sorted(pairs), *_WANDS]


def _of_scale(times: float) -> str:
    """The message that points fit hands at `times` their size."""
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
