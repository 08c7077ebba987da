"""The size and proportions of a user's hands, measured in some frames of unlabeled points.

Length and breadth of hands of mean proportions are searched first; then the proportions and the positions of
the markers follow as far as the frames tell. `user_calibration` finds the rest from a longer capture.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from gloves.fit import GloveFit, attach
from gloves.layout import MarkerLayout
from gloves.takes.points import Status
from handsim.errors import HandSimWarning
from handsim.hand.model import HandModel
from handsim.hand.shape import SIZES, Side, shape_from_measures
from handsim.space.transforms import MIRROR
from track.calibration.energy import Estimate, Problem, levenberg_marquardt, shared_covariance, user_hand
from track.calibration.hand_parameters import LENGTH, NUM_PARAMETERS, nearest_coordinates
from track.config import TrackerConfig
from track.frames import TrackedHand
from track.kinematics.pose_solver import PoseSolver
from track.streams.frame_source import StreamedFrame
from track.tracker import Tracker
from track.user import MEASURED, User
from train.labelers.protocol import Labeler

_LENGTHS: Final = (0.187, 0.205, 0.168, 0.150)  # [m] hands to find the labels with, the likeliest first
_SHORTEST, _LONGEST = 0.125, 0.225  # [m], 0.6 of an adult's to beyond the longest in ANSUR II
_BREADTHS: Final = (0.88, 1.12)  # from the usual breadth of a length; three standard deviations
_FAR: Final = 0.012  # [m] from the length that the labels were found with
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
_FEWEST: Final = 3  # frames with which a size is trusted
_MISSING: Final = 0.2  # share of the markers at most in such a frame
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


class SizeFit(NamedTuple):
    """Hands as measured."""

    hand: GloveFit
    """The right one; a left hand is its mirror image."""
    rms: float
    """Median RMS distance of the markers from this hand [m]."""
    spread: float
    """Standard deviation of its length [m]."""

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
    """The size and proportions of the hands in some frames.

    Args:
        frames: Frames of unlabeled points, as `sample_frames` gives, or the beginning of a stream.
        is_quick: Whether hands are looked for as adults' and by the weaker evidence alone.

    Returns:
        The hands, both of one shape; None if no hand is found that shows most of its markers.
    """
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


def _fit_from(
    length: float,
    frames: Sequence[StreamedFrame],
    layout: MarkerLayout,
    sides: Sequence[Side],
    labeler: Labeler,
    config: TrackerConfig,
) -> SizeFit | None:
    """The hands that are found as hands of a length [m]."""
    start = _hand(length, usual_breadth(length), layout)
    markers = _label(frames, start, sides, labeler, config)
    if not markers:
        return None
    search = _Search(markers, start)
    found = search.length(usual_breadth, _SHORTEST, _LONGEST)
    if abs(found - length) > _FAR:  # the labels are better with its own size
        start = _hand(found, usual_breadth(found), layout)
        markers = _label(frames, start, sides, labeler, config) or markers
        search = _Search(markers, start)
        found = search.length(usual_breadth, _SHORTEST, _LONGEST)
    return _fit_proportions(_as_right(markers), _hand(*search.measures(found), layout))


def _is_found(fit: SizeFit, frames: Sequence[StreamedFrame], sides: Sequence[Side], labeler: Labeler) -> bool:
    """Whether hands that were measured by weak evidence are found by the usual one.

    In most frames; or in some of them, where most of their markers are there and fit well.
    """
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


def _hand(length: float, breadth: float, layout: MarkerLayout) -> GloveFit:
    """A right hand of mean proportions in a glove as designed; length and breadth in [m]."""
    return attach(layout, HandModel(shape_from_measures(length, breadth, side="right")))


def _label(
    frames: Sequence[StreamedFrame],
    hand: GloveFit,
    sides: Sequence[Side],
    labeler: Labeler,
    config: TrackerConfig,
) -> dict[Side, Float[np.ndarray, "F M 3"]]:
    """Labeled markers [m] of each hand, NaN where missing, in frames that show most of them.

    Hands that few frames show are left out.
    """
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
    return {
        side: _spread_out(np.array(some), _PROPORTION_FRAMES)
        for side, some in zip(sides, found, strict=True)
        if len(some) >= _FEWEST
    }


def _spread_out(markers: NDArray[np.float64], most: int) -> NDArray[np.float64]:
    """So many frames of markers (F, M, 3) at most, evenly spaced."""
    chosen: NDArray[np.float64] = markers[
        np.linspace(0, len(markers) - 1, min(most, len(markers))).astype(int)
    ]
    return chosen


def _as_right(markers: Mapping[Side, Float[np.ndarray, "F M 3"]]) -> Float[np.ndarray, "F M 3"]:
    """The markers of all hands as those of right hands [m]."""
    return np.concatenate([some @ MIRROR if side == "left" else some for side, some in markers.items()])


class _Search:
    """The likeliest length and breadth of hands of mean proportions.

    Few markers fit hands of many sizes, so that the sizes of people count too.

    Args:
        markers: Labeled markers of each hand [m]; NaN where missing.
        start: The right hand as which they were labeled.
    """

    def __init__(self, markers: Mapping[Side, Float[np.ndarray, "F M 3"]], start: GloveFit) -> None:
        few = {side: _spread_out(some, _FRAMES) for side, some in markers.items()}
        seen = np.mean([np.isfinite(some[..., 0]).sum(axis=1).mean() for some in few.values()])
        self._evidence = _INDEPENDENT * float(seen) / _MARKER_SPREAD**2  # [1/m^2]
        self._markers, self._layout = _as_right(few), start.layout
        self._poses = PoseSolver(start).solve(self._markers).qpos

    def length(self, breadth: Callable[[float], float], shortest: float, longest: float) -> float:
        """The likeliest length [m] between two; `breadth` gives the breadth [m] of each."""
        return _least(lambda tried: self._cost(tried, breadth(tried)), shortest, longest)

    def measures(self, length: float) -> tuple[float, float]:
        """Length and breadth [m].

        Args:
            length: The likeliest of hands of the usual breadth [m].
        """
        usual = usual_breadth(length)
        low, high = (factor * usual for factor in _BREADTHS)
        breadth = _least(lambda tried: self._cost(length, tried), low, high)
        return self.length(lambda tried: breadth, 0.95 * length, 1.05 * length), breadth

    def _cost(self, length: float, breadth: float) -> float:
        solver = PoseSolver(_hand(length, breadth, self._layout))
        beyond = (length - _USUAL_LENGTH) / _LENGTH_SPREAD
        broad = (breadth / usual_breadth(length) - 1.0) / _BREADTH_SPREAD
        square = float(np.median(solver.solve(self._markers, self._poses).rms)) ** 2
        return 0.5 * (self._evidence * square + beyond**2 + broad**2)


def _least(function: Callable[[float], float], low: float, high: float) -> float:
    """The argument between two bounds [m] with the least value of a function."""
    from scipy.optimize import (
        minimize_scalar,  # a quarter of a second, which a user's known hands do not need
    )

    found = minimize_scalar(function, bounds=(low, high), method="bounded", options={"xatol": _PRECISION})
    return float(found.x)


def _fit_proportions(seen: Float[np.ndarray, "F M 3"], start: GloveFit) -> SizeFit:
    """One shape for all hands of a user, by a calibration without touches.

    `seen` are labeled markers of right hands, at least four in every frame; `start` is a right hand of about
    the right size in the glove as designed. What the frames do not tell stays as it was.
    """
    worn, shape = start.attachment, start.model.shape
    coordinates = nearest_coordinates(worn.points, shape)
    problem = Problem(
        shape,
        coordinates,
        worn.layout.heights,
        seen,
        noise=_FIT_NOISE,
        robust_scale=_ROBUST_SCALE,
        relinearize=_RELINEARIZE,
    )
    poses = PoseSolver(start).solve(seen).qpos
    estimate = Estimate(np.zeros(NUM_PARAMETERS), worn.points, coordinates, poses)
    estimate, fit, _ = levenberg_marquardt(problem, estimate, 0, _FIT_STEPS, None, _SMALL_GAIN)
    hand = user_hand(start, problem, estimate)
    rms = float(np.median(PoseSolver(hand).solve(seen, estimate.qpos).rms))
    variance = shared_covariance(problem, estimate, fit)[LENGTH, LENGTH]
    return SizeFit(hand, rms, hand.shape.length * float(np.sqrt(variance)))
