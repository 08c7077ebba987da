"""User calibration: marker places, hand shape and touches from a minute of labeled markers.

After Han et al. 2018, section 4.5: poses of some frames, marker places on the rest hand and contact points
are solved together. Beyond the paper the hand's shape is solved too, touches are found instead of annotated,
and the result says how sure it is and what the user should have moved more.

The paper leaves its lambdas open. Here they follow from spreads in millimeters: lambda_1 is
(noise / PLACE_SPREAD)^2 and lambda_2 (noise / CONTACT_SPREAD)^2, the noise being what the markers are left
off by; the spreads were chosen on simulated people (docs/calibration.md).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from gloves.fit import GloveFit
from handsim.hand.model import HandModel
from handsim.hand.topology import DIGITS, Side
from handsim.space.transforms import MIRROR
from track.calibration.contacts import find_touches, place_contacts, trust
from track.calibration.energy import Fit, Guess, Problem
from track.calibration.frames import (
    CalibrationError,
    Track,
    check_markers,
    check_motion,
    first_look,
    follow,
    telling_frames,
    usable_frames,
    whole_digits,
)
from track.calibration.hand_parameters import NUM_PARAMETERS, shape_at
from track.calibration.report import gaps_on, marker_noise, standard_errors, still_joints, weighing_noise
from track.calibration.skin_walk import SkinPatch, nearest_places, place_points, wear_at
from track.calibration.solver import Progress, descend

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy.typing import NDArray

__all__ = ["Calibration", "CalibrationError", "Touch", "calibrate", "calibrate_hands"]

_WIDE_STEPS: Final = 6  # of which none gives up a marker that is far off
_CONTACTS_FROM: Final = 10  # steps at most without contacts, as in the paper
_MOST_STEPS: Final = 30
_FIRST_NOISE, _FIRST_REACH = 0.001, 0.03  # [m]
_REACH_IN_NOISES: Final = 8.0
_COUNTS: Final = 0.25  # trust from which a touch counts for one


@dataclass(frozen=True, slots=True, eq=False)
class Touch:
    """The thumb at another finger's tip, as found in the data."""

    frame: int
    finger: str
    gap_before: float
    """Between the pads of the hand that the calibration began with, each having given way a little [m]."""
    gap_after: float
    trust: float
    """How much it counted, 0 to 1."""
    points: Float[np.ndarray, "2 3"]
    """Where thumb and finger touch, on the calibrated rest hand [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A calibrated hand, and how far it may be trusted."""

    hand: GloveFit
    start: GloveFit
    """What the calibration began with."""
    rms_before: float
    """Median over frames of the markers' RMS distance from the tracked hand [m]."""
    rms_after: float
    shifts: Float[np.ndarray, "M"]
    """How far each marker sits from where the glove as designed has it on this hand [m]."""
    place_errors: Float[np.ndarray, "M"]
    """Standard error of each marker's place on its bone [m]."""
    length_errors: Float[np.ndarray, "5 3"]
    """Standard error of each bone's length [m]."""
    touches: tuple[Touch, ...]
    still_joints: tuple[str, ...]
    """Hinges that moved too little to tell what lies on either side of them."""

    @property
    def trusted_touches(self) -> tuple[Touch, ...]:
        """Those that counted for more than a little."""
        return tuple(touch for touch in self.touches if touch.trust > _COUNTS)

    def gaps(self) -> Float[np.ndarray, "2"]:
        """Mean distance from touching [m], before and after, of trusted touches; NaN without any."""
        if not self.trusted_touches:
            return np.full(2, np.nan)
        pairs = np.abs([[touch.gap_before, touch.gap_after] for touch in self.trusted_touches])
        means: NDArray[np.float64] = pairs.mean(axis=0)
        return means

    def advice(self) -> tuple[str, ...]:
        """What a better capture would have, in plain sentences; empty when nothing is missing."""
        sentences = []
        for digit in DIGITS:
            hinges = [name.removeprefix(f"{digit}_") for name in self.still_joints if name.startswith(digit)]
            if hinges:
                told = ", ".join(hinge.replace("_", " ") for hinge in hinges)
                sentences.append(f"move the {digit} more: {told} covered too little of its range")
        touched = {touch.finger for touch in self.trusted_touches}
        missing = [finger for finger in DIGITS[1:] if finger not in touched]
        if missing:
            sentences.append(f"touch the thumb to the tip of the {', '.join(missing)} finger and hold still")
        return tuple(sentences)


def calibrate(
    markers: Float[np.ndarray, "T M 3"],
    start: GloveFit,
    rate: float,
    *,
    progress: Progress | None = None,
) -> Calibration:
    """Fit a hand and its glove to one user's labeled markers.

    Args:
        markers: The markers of one hand in the glove's order [m]; NaN where missing. Half a minute or more in
            which every joint moves, and the thumb touches each fingertip, holding still for a moment.
        start: Where to begin: `nominal_fit` of the nearest size, or an earlier calibration.
        rate: Frames a second [Hz].
        progress: Called after each step.

    Raises:
        CalibrationError: Too few frames have enough markers, or the hand does not move.
        ArgumentError: `markers` do not fit the glove, or `rate` is not positive.
    """
    mirror = MIRROR if start.side == "left" else np.eye(3)
    markers, right = check_markers(markers, start, rate) @ mirror, start.with_side("right")
    usable = usable_frames(markers, start)
    whole = whole_digits(markers, right.attachment)
    track = first_look(markers, right, usable)
    check_motion(track, whole, start)
    problem, guess = _begin(markers, right, track)
    guess, fit, steps = _descend_without_touches(problem, guess, progress)
    rough = _user_hand(right, problem, guess)
    rough_track = follow(markers, rough, usable)
    touches = find_touches(rough.model, rough_track.qpos[:, 7:], whole[usable], rate)
    problem, guess = _with_touches(problem, guess, fit, markers, rough_track, touches)
    guess, fit, steps = descend(problem, guess, steps, _MOST_STEPS, progress)
    done = _user_hand(right, problem, guess)
    before = _gaps_before(right, markers, touches, usable)
    final = follow(markers, done, usable, rough_track.qpos)
    place_errors, length_errors = standard_errors(problem, guess, fit)
    return Calibration(
        hand=done.with_side(start.side),
        start=start,
        rms_before=float(np.median(track.rms)),
        rms_after=float(np.median(final.rms)),
        shifts=np.linalg.norm(fit.off_design, axis=1),
        place_errors=place_errors,
        length_errors=length_errors,
        touches=_touches(guess, fit, touches, rough_track.frames, before, mirror),
        still_joints=still_joints(final.qpos[:, 7:], whole[usable], done.model),
    )


def calibrate_hands(
    markers: Mapping[Side, Float[np.ndarray, "T M 3"]],
    start: Sequence[GloveFit],
    rate: float,
    *,
    progress: Callable[[Side, int, float, float], None] | None = None,
) -> tuple[Calibration, ...]:
    """Calibrate each of a user's hands that a capture shows.

    Args:
        markers: For each side the markers in the glove's order [m]; NaN where missing, everywhere for a hand
            that is not there.
        start: Where to begin, each side at most once; sides that `markers` lacks are left out.
        rate: Frames a second [Hz].
        progress: Called after each step with the side and what `calibrate` tells.

    Raises:
        CalibrationError: No hand is there, or one that is shows too little.
        ArgumentError: Markers do not fit a glove, or `rate` is not positive.
    """
    shown = [hand for hand in start if np.isfinite(markers.get(hand.side, np.nan)).any()]
    if not shown:
        wanted = " or ".join(hand.side for hand in start) or "any"
        raise CalibrationError(
            f"the capture has no marker of the {wanted} hand, expected half a minute of one"
        )
    return tuple(
        calibrate(
            markers[hand.side],
            hand,
            rate,
            progress=None if progress is None else partial(progress, hand.side),
        )
        for hand in shown
    )


def _begin(markers: NDArray[np.float64], right: GloveFit, track: Track) -> tuple[Problem, Guess]:
    chosen = telling_frames(track, markers)
    shape, worn = right.model.shape, right.attachment
    places = nearest_places(worn.points, shape)
    problem = Problem(
        shape,
        places,
        worn.layout.radius,
        markers[track.frames[chosen]],
        noise=_FIRST_NOISE,
        reach=_FIRST_REACH,
    )
    return problem, Guess(np.zeros(NUM_PARAMETERS), worn.points, places, track.qpos[chosen])


def _descend_without_touches(
    problem: Problem, guess: Guess, progress: Progress | None
) -> tuple[Guess, Fit, int]:
    """The first steps; markers that are far off are given up only when the hand nearly fits."""
    guess, fit, steps = descend(problem, guess, 0, _WIDE_STEPS, progress)
    problem.reach = _REACH_IN_NOISES * marker_noise(problem, fit)
    return descend(problem, guess, steps, _CONTACTS_FROM, progress)


def _with_touches(
    problem: Problem,
    guess: Guess,
    fit: Fit,
    markers: NDArray[np.float64],
    track: Track,
    touches: list[tuple[int, str]],
) -> tuple[Problem, Guess]:
    """The problem with the touches' frames, at its own noise.

    The other frames are chosen anew: on a hand that nearly fits, one with a wrong label stands out.
    """
    noise = marker_noise(problem, fit)
    chosen = telling_frames(track, markers)
    touching = np.array([frame for frame, _ in touches], dtype=np.int64)
    frames = np.concatenate([chosen, touching])
    larger = Problem(
        problem.shape,
        problem.design,
        problem.radius,
        markers[track.frames[frames]],
        noise=weighing_noise(noise, len(frames)),
        reach=_REACH_IN_NOISES * noise,
    )
    guess = dataclasses.replace(guess, qpos=track.qpos[frames])
    if not touches:
        return larger, guess
    model = HandModel(shape_at(problem.shape, guess.parameters))
    contacts = place_contacts(model, touches, model.forward_kinematics(track.qpos[touching]))
    contacts = contacts._replace(frames=len(chosen) + np.arange(len(touches)))
    return larger, dataclasses.replace(guess, contacts=contacts)


def _user_hand(right: GloveFit, problem: Problem, guess: Guess) -> GloveFit:
    shape = shape_at(problem.shape, guess.parameters)
    return GloveFit(HandModel(shape), wear_at(right.attachment.layout, guess.places, shape))


def _touches(
    guess: Guess,
    fit: Fit,
    touches: list[tuple[int, str]],
    frames: NDArray[np.int64],
    before: NDArray[np.float64],
    mirror: NDArray[np.float64],
) -> tuple[Touch, ...]:
    """The touches with their gaps on the first and on the calibrated hand."""
    if guess.contacts is None or fit.meeting is None:
        return ()
    say = trust(fit.meeting, guess.contacts.fingers)
    sides: list[NDArray[np.float64]] = []
    for places in (guess.contacts.thumb_places, guess.contacts.finger_places):
        sides.append(
            place_points(places, SkinPatch(places.faces).corners(fit.model.surface.vertices))[0] @ mirror
        )
    points, after = np.stack(sides, axis=1), fit.meeting.gaps
    return tuple(
        Touch(int(frames[frame]), finger, float(before[k]), float(after[k]), float(say[k]), points[k])
        for k, (frame, finger) in enumerate(touches)
    )


def _gaps_before(
    right: GloveFit, markers: NDArray[np.float64], touches: list[tuple[int, str]], frames: NDArray[np.int64]
) -> NDArray[np.float64]:
    """How far from touching the hand was that the calibration began with [m]."""
    if not touches:
        return np.empty(0)
    there = frames[[frame for frame, _ in touches]]
    return gaps_on(right.model, touches, follow(markers, right, there).qpos)
