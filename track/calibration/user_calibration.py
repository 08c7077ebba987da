"""User calibration: marker positions, hand shape and contacts from a minute of labeled markers.

After Han et al. 2018, section 4.5: poses of some frames, marker positions on the rest hand and contact points
are solved together. In addition to the paper the hand's shape is solved, touches are detected instead of
annotated, and the result has standard errors and suggestions for a better capture.

The paper gives no values for its lambdas. Here they result from standard deviations: lambda_1 is
(noise / POSITION_SPREAD)^2 and lambda_2 is (noise / CONTACT_SPREAD)^2, where the noise is that of the
markers' residuals. The spreads were chosen on simulated people (docs/calibration.md).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from gloves.fit import GloveFit
from handsim.hand.model import HandModel
from handsim.hand.shape import DIGITS
from handsim.space.transforms import MIRROR
from track.calibration.contacts import contact_weights, find_touches, initialize_contacts
from track.calibration.energy import Estimate, Fit, Problem
from track.calibration.frames import (
    CalibrationError,
    PoseTrack,
    check_markers,
    complete_digits,
    informative_frames,
    initial_poses,
    solve_frames,
    usable_frames,
)
from track.calibration.hand_parameters import NUM_PARAMETERS, shape_at
from track.calibration.report import (
    contact_gaps,
    effective_noise,
    learn_spreads,
    marker_noise,
    repeated_share,
    standard_errors,
    still_joints,
)
from track.calibration.skin_coordinates import SkinPatch, nearest_coordinates, skin_points
from track.calibration.solver import Progress, levenberg_marquardt, user_hand

__all__ = ["Calibration", "CalibrationError", "Touch", "calibrate_hand"]

_WIDE_STEPS: Final = 6  # at the first robust scale, which keeps distant markers
_STEPS_WITHOUT_CONTACTS: Final = 10  # steps, as in the paper
MOST_STEPS: Final = 30
"""Steps in all, at most."""
_SPREAD_ROUNDS: Final = 4  # in which the spreads of marker places are learned
_FIRST_NOISE, _FIRST_SCALE = 0.001, 0.03  # [m]
_SCALE_IN_NOISES: Final = 8.0  # robust scale over the noise
_BETTER: Final = 0.98  # of the distance before; what is not better than that stays as it was
_SIGNIFICANT: Final = 0.25  # weight above which a touch is significant


@dataclass(frozen=True, slots=True, eq=False)
class Touch:
    """A contact of the thumb with a fingertip, detected in the data."""

    frame: int
    """Its number in the capture."""
    finger: str
    gap_before: float
    """Gap between the compressed pads of the hand that the calibration began with [m]."""
    gap_after: float
    """The same on the calibrated hand [m]."""
    weight: float
    """Its weight in the energy, 0 to 1."""
    points: Float[np.ndarray, "2 3"]
    """Contact points of thumb and finger on the calibrated rest hand, in the wrist's frame [m]."""


class HeldOut(NamedTuple):
    """How well hands fit frames of the capture that a calibration did not see."""

    before: float
    """Median over frames of the markers' RMS distance from the fitted hand without calibration [m]."""
    after: float
    """The same with calibration [m]."""
    num_frames: int
    """Number of frames."""
    hidden: str = ""
    """A rarely seen marker whose place the next finger's may have; empty where there is none."""

    @property
    def is_better(self) -> bool:
        """Whether the calibrated hand fits better, by more than chance and with labels that are certain."""
        return not self.hidden and self.after < _BETTER * self.before


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A calibrated hand and the diagnostics of its calibration."""

    hand: GloveFit
    start: GloveFit
    """What the calibration began with."""
    rms_before: float
    """Median over frames of the markers' RMS distance from the tracked hand [m]."""
    rms_after: float
    """The same with the calibrated hand [m]."""
    shifts: Float[np.ndarray, "M"]
    """Distance of each marker from its position by the glove's design on this hand [m]."""
    position_errors: Float[np.ndarray, "M"]
    """Standard error of each marker's position on its bone, or among the knuckles on the palm [m]."""
    length_errors: Float[np.ndarray, "5 3"]
    """Standard error of each bone's length [m]."""
    touches: tuple[Touch, ...]
    still_joints: tuple[str, ...]
    """Joints that moved too little to determine the bones on either side."""
    held_out: HeldOut | None = None
    """How it does on frames that it was not solved on; None if that was not measured."""

    @property
    def is_better(self) -> bool:
        """Whether it was tried on held-out frames, and fits them better than the hand before."""
        return self.held_out is not None and self.held_out.is_better

    @property
    def place_error(self) -> float:
        """What the capture leaves open of the markers' places, root of the mean square over markers [m]."""
        return float(np.sqrt((self.position_errors**2).mean()))

    def __str__(self) -> str:
        """The markers on held-out frames and their places, in a line [mm]."""
        if self.held_out is None:
            return "too few frames to try a calibration on, so that it stays as it was"
        before, after, frames, hidden = self.held_out
        line = f"markers {1e3 * before:.2f} mm off before, {1e3 * after:.2f} mm calibrated"
        line += f" on {frames} frames held out"
        if hidden:
            line += f", but {hidden} is rarely seen, and the next finger's fits in its place as well"
            return f"{line}, so that it stays as it was"
        if not self.is_better:
            return f"{line}: no better, so that it stays as it was"
        return f"{line}, their places known to {1e3 * self.place_error:.1f} mm"

    @property
    def significant_touches(self) -> tuple[Touch, ...]:
        """Touches with a weight above 0.25."""
        return tuple(touch for touch in self.touches if touch.weight > _SIGNIFICANT)

    def gaps(self) -> Float[np.ndarray, "2"]:
        """Mean distance from touching [m], before and after, of the significant touches; NaN without any."""
        if not self.significant_touches:
            return np.full(2, np.nan)
        pairs = np.abs([[touch.gap_before, touch.gap_after] for touch in self.significant_touches])
        means: NDArray[np.float64] = pairs.mean(axis=0)
        return means

    def suggestions(self) -> tuple[str, ...]:
        """What to do in a better capture, as sentences; empty when nothing is missing."""
        hidden = self.held_out.hidden if self.held_out is not None else ""
        sentences = [f"let {hidden} be seen most of the time"] if hidden else []
        for digit in DIGITS:
            still = [name.removeprefix(f"{digit}_") for name in self.still_joints if name.startswith(digit)]
            if still:
                joints = ", ".join(joint.replace("_", " ") for joint in still)
                sentences.append(f"move the {digit} more: {joints} covered too little of its range")
        touched = {touch.finger for touch in self.significant_touches}
        missing = [finger for finger in DIGITS[1:] if finger not in touched]
        if missing:
            sentences.append(f"touch the thumb to the tip of the {', '.join(missing)} finger and hold still")
        return tuple(sentences)


def calibrate_hand(
    markers: Float[np.ndarray, "T M 3"],
    start: GloveFit,
    rate: float,
    *,
    progress: Progress | None = None,
) -> Calibration:
    """Fit a hand and its glove to one user's labeled markers.

    Args:
        markers: The markers of one hand in the glove's order [m]; NaN where missing. Of joints that do not
            move and tips that do not touch, what is usual among people stays.
        start: Where to begin: `nominal_fit` of the nearest size, or an earlier calibration.

    Returns:
        The calibrated hand in its glove, residuals [m] before and after, and standard errors [m].

    Raises:
        CalibrationError: Too few frames have enough markers.
        ArgumentError: `markers` do not fit the glove, or `rate` is not positive.
    """
    mirror = MIRROR if start.side == "left" else np.eye(3)
    markers, right = check_markers(markers, start, rate) @ mirror, start.with_side("right")
    usable = usable_frames(markers, start)
    complete = complete_digits(markers, right.attachment)
    track = initial_poses(markers, right, usable)
    problem, estimate = _initial_problem(markers, right, track)
    estimate, fit, steps = _solve_without_touches(problem, estimate, progress)
    rough = user_hand(right, problem, estimate)
    rough_track = solve_frames(markers, rough, usable)
    touches = find_touches(rough.model, rough_track.qpos[:, 7:], complete[usable], rate)
    problem, estimate = _with_touches(problem, estimate, fit, markers, rough_track, touches)
    estimate, fit = _solve_with_spreads(problem, estimate, steps, progress)
    done = user_hand(right, problem, estimate)
    before = _gaps_before(right, markers, touches, usable)
    final = solve_frames(markers, done, usable, rough_track.qpos)
    position_errors, length_errors = standard_errors(problem, estimate, fit)
    return Calibration(
        hand=done.with_side(start.side),
        start=start,
        rms_before=float(np.median(track.rms)),
        rms_after=float(np.median(final.rms)),
        shifts=np.linalg.norm(fit.design_residuals, axis=1),
        position_errors=position_errors,
        length_errors=length_errors,
        touches=_touches(estimate, fit, touches, rough_track.frames, before, mirror),
        still_joints=still_joints(final.qpos[:, 7:], complete[usable], done.model),
    )


def _initial_problem(
    markers: NDArray[np.float64], right: GloveFit, track: PoseTrack
) -> tuple[Problem, Estimate]:
    """The problem without contacts, and the estimate that the first poses give."""
    chosen = informative_frames(track, markers)
    shape, worn = right.model.shape, right.attachment
    coordinates = nearest_coordinates(worn.points, shape)
    problem = Problem(
        shape,
        coordinates,
        worn.layout.heights,
        markers[track.frames[chosen]],
        noise=_FIRST_NOISE,
        robust_scale=_FIRST_SCALE,
    )
    return problem, Estimate(np.zeros(NUM_PARAMETERS), worn.points, coordinates, track.qpos[chosen])


def _solve_without_touches(
    problem: Problem, estimate: Estimate, progress: Progress | None
) -> tuple[Estimate, Fit, int]:
    """The first steps; distant markers lose their weight only when the hand nearly fits."""
    estimate, fit, steps = levenberg_marquardt(problem, estimate, 0, _WIDE_STEPS, progress)
    problem.robust_scale = _SCALE_IN_NOISES * marker_noise(problem, fit)
    return levenberg_marquardt(problem, estimate, steps, _STEPS_WITHOUT_CONTACTS, progress)


def _solve_with_spreads(
    problem: Problem, estimate: Estimate, steps: int, progress: Progress | None
) -> tuple[Estimate, Fit]:
    """The last steps; how far the glove's markers are from their design is learned meanwhile."""
    for last in np.linspace(steps, MOST_STEPS, 1 + _SPREAD_ROUNDS).astype(int)[1:]:
        learn_spreads(problem, estimate, problem.fit(estimate))
        estimate, fit, steps = levenberg_marquardt(problem, estimate, steps, int(last), progress)
    return estimate, fit


def _with_touches(
    problem: Problem,
    estimate: Estimate,
    fit: Fit,
    markers: NDArray[np.float64],
    track: PoseTrack,
    touches: list[tuple[int, str]],
) -> tuple[Problem, Estimate]:
    """The problem with the frames of the touches, at the noise of the first fit.

    The other frames are selected again: on a hand that nearly fits, a wrong label gives a large RMS.
    """
    noise = marker_noise(problem, fit)
    chosen = informative_frames(track, markers)
    touching = np.array([frame for frame, _ in touches], dtype=np.int64)
    frames = np.concatenate([chosen, touching])
    larger = Problem(
        problem.shape,
        problem.design,
        problem.heights,
        markers[track.frames[frames]],
        noise=effective_noise(noise, repeated_share(track.qpos, track.residuals), len(frames)),
        robust_scale=_SCALE_IN_NOISES * noise,
    )
    estimate = dataclasses.replace(estimate, qpos=track.qpos[frames])
    if not touches:
        return larger, estimate
    model = HandModel(shape_at(problem.shape, estimate.parameters))
    contacts = initialize_contacts(model, touches, model.forward_kinematics(track.qpos[touching]))
    contacts = contacts._replace(frames=len(chosen) + np.arange(len(touches)))
    return larger, dataclasses.replace(estimate, contacts=contacts)


def _touches(
    estimate: Estimate,
    fit: Fit,
    touches: list[tuple[int, str]],
    frames: NDArray[np.int64],
    before: NDArray[np.float64],
    mirror: NDArray[np.float64],
) -> tuple[Touch, ...]:
    """The touches with their gaps on the first and on the calibrated hand."""
    if estimate.contacts is None or fit.geometry is None:
        return ()
    weights = contact_weights(fit.geometry, estimate.contacts.fingers)
    sides: list[NDArray[np.float64]] = []
    for coordinates in (estimate.contacts.thumb_coordinates, estimate.contacts.finger_coordinates):
        sides.append(
            skin_points(coordinates, SkinPatch(coordinates.faces).corners(fit.model.surface.vertices))[0]
            @ mirror
        )
    points, after = np.stack(sides, axis=1), fit.geometry.gaps
    return tuple(
        Touch(int(frames[frame]), finger, float(before[k]), float(after[k]), float(weights[k]), points[k])
        for k, (frame, finger) in enumerate(touches)
    )


def _gaps_before(
    right: GloveFit, markers: NDArray[np.float64], touches: list[tuple[int, str]], frames: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Gaps of the touches (K,) [m] on the hand that the calibration began with."""
    if not touches:
        return np.empty(0)
    touching = frames[[frame for frame, _ in touches]]
    return contact_gaps(right.model, touches, solve_frames(markers, right, touching).qpos)
