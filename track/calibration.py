"""User calibration: marker places, hand shape and touches from a minute of labelled markers.

After Han et al. 2018, section 4.5: poses of some frames, marker places on the rest hand and contact points
are solved together. Beyond the paper the hand's shape is solved too, touches are found instead of annotated,
and the result says how sure it is and what the user should have moved more.

The paper leaves its lambdas open. Here they follow from spreads in millimetres: lambda_1 is
(noise / PLACE_SPREAD)^2 and lambda_2 (noise / CONTACT_SPREAD)^2, the noise being what the markers are left
off by; the spreads were chosen on simulated people (docs/calibration.md).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from gloves.attach import Attachment
from handsim.errors import ShapeError
from handsim.model import HandModel
from handsim.topology import BONES, DIGITS, Side
from handsim.transforms import MIRROR
from track._calibration_energy import Fit, Guess, Problem
from track._calibration_report import gaps_on, marker_noise, standard_errors, still_joints, weighing_noise
from track._calibration_solve import Progress, descend
from track.contacts import find_touches, place_contacts, trust
from track.hand_parameters import NUM_PARAMETERS, shape_at
from track.inverse_kinematics import PoseSolver
from track.skin_walk import SkinPatch, nearest_places, place_points, wear_at
from track.user import UserHand

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy.typing import NDArray

NUM_FRAMES: Final = 160
FEWEST_FRAMES: Final = 30
_CONTACTS_FROM: Final = 10  # steps without contacts, as in the paper
_MOST_STEPS: Final = 30
_FIRST_NOISE, _FIRST_REACH = 0.001, 0.03  # [m]
_REACH_IN_NOISES: Final = 8.0
_CANDIDATES: Final = 2000
_SOLVABLE: Final = 6  # markers at least


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

    hand: UserHand
    start: UserHand
    """What the calibration began with."""
    rms_before: float
    """RMS distance of markers from the tracked hand [m], over the capture, a frame at most every few."""
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

    def gaps(self, finger: str | None = None) -> Float[np.ndarray, "2"]:
        """Mean distance from touching [m], before and after, of touches that counted; NaN without any."""
        chosen = [t for t in self.touches if t.trust > 0.25 and finger in {None, t.finger}]
        if not chosen:
            return np.full(2, np.nan)
        means: NDArray[np.float64] = np.abs([[t.gap_before, t.gap_after] for t in chosen]).mean(axis=0)
        return means

    def advice(self) -> tuple[str, ...]:
        """What a better capture would have, in plain sentences; empty when nothing is missing."""
        sentences = []
        for digit in DIGITS:
            hinges = [name.removeprefix(f"{digit}_") for name in self.still_joints if name.startswith(digit)]
            if hinges:
                told = ", ".join(hinge.replace("_", " ") for hinge in hinges)
                sentences.append(f"move the {digit} more: {told} covered too little of its range")
        touched = {touch.finger for touch in self.touches if touch.trust > 0.25}
        missing = [finger for finger in DIGITS[1:] if finger not in touched]
        if missing:
            sentences.append(f"touch the thumb to the tip of the {', '.join(missing)} finger and hold still")
        return tuple(sentences)


class _Track(NamedTuple):
    """Poses of some frames."""

    frames: NDArray[np.int64]
    qpos: NDArray[np.float64]
    rms: NDArray[np.float64]


def calibrate(
    markers: Float[np.ndarray, "T M 3"],
    start: UserHand,
    rate: float,
    *,
    progress: Progress | None = None,
) -> Calibration:
    """Fit a hand and its glove to one user's labelled markers.

    Args:
        markers: The markers of one hand in the glove's order [m]; NaN where missing. Half a minute or more in
            which every joint moves, and the thumb touches each fingertip, holding still for a moment.
        start: Where to begin: `usual_hand` of the nearest size, or an earlier calibration.
        rate: Frames a second [Hz].
        progress: Called after each step.

    Raises:
        ShapeError: `markers` do not fit the glove, `rate` is not positive, or too few frames have enough
            markers.
    """
    markers = _checked(markers, start, rate)
    mirror = MIRROR if start.side == "left" else np.eye(3)
    markers, right = markers @ mirror, _mirrored(start, "right")
    usable = np.flatnonzero(np.isfinite(markers[..., 0]).sum(axis=1) >= _needed(markers.shape[1]))
    track = _follow(markers, right, usable[:: max(1, len(usable) // _CANDIDATES)])
    digits = _digits(right.attachment)
    there = np.isfinite(markers[..., 0])
    chosen = _informative(track, there)
    problem, guess = _begin(markers, right, track, chosen)
    guess, fit, steps = descend(problem, guess, 0, _CONTACTS_FROM, progress)
    rough = _user_hand(right, problem, guess)
    rough_track = _follow(markers, rough, usable)
    whole = np.stack([there[:, digits == d].all(axis=1) for d in range(len(DIGITS))], axis=1)
    touches = find_touches(rough.model, rough_track.qpos[:, 7:], whole[rough_track.frames], rate)
    noise = marker_noise(problem, fit)
    problem, guess = _with_touches(problem, guess, markers, rough_track, chosen, touches, noise)
    guess, fit, steps = descend(problem, guess, steps, _MOST_STEPS, progress)
    done = _user_hand(right, problem, guess)
    before = _gaps_before(right, markers, touches, usable)
    final = _follow(markers, done, usable, rough_track.qpos)
    place_errors, length_errors = standard_errors(problem, guess, fit)
    return Calibration(
        hand=_mirrored(done, start.side),
        start=start,
        rms_before=float(np.sqrt((track.rms**2).mean())),
        rms_after=float(np.sqrt((final.rms**2).mean())),
        shifts=np.linalg.norm(fit.off_design, axis=1),
        place_errors=place_errors,
        length_errors=length_errors,
        touches=_touches(guess, fit, touches, rough_track.frames, before, mirror),
        still_joints=still_joints(final.qpos[:, 7:], whole[final.frames], done.model),
    )


def _checked(markers: Float[np.ndarray, "T M 3"], start: UserHand, rate: float) -> NDArray[np.float64]:
    values = np.array(markers, dtype=np.float64)
    count = start.attachment.layout.num_markers
    if values.ndim != 3 or values.shape[1:] != (count, 3):
        raise ShapeError(f"markers have shape {values.shape}, wanted (T, {count}, 3) for this glove")
    if not 0.0 < rate < np.inf:
        raise ShapeError(f"rate is {rate:g} Hz, wanted a positive number")
    values[~np.isfinite(values).all(axis=2)] = np.nan
    enough = int((np.isfinite(values[..., 0]).sum(axis=1) >= _needed(count)).sum())
    if enough < FEWEST_FRAMES:
        raise ShapeError(
            f"{enough} of {len(values)} frames have {_needed(count)} or more of the {count} markers, "
            f"wanted at least {FEWEST_FRAMES} such frames"
        )
    return values


def _needed(count: int) -> int:
    """Markers that a frame must have to be looked at."""
    return max(_SOLVABLE, round(0.75 * count)) if count > _SOLVABLE else count


def _mirrored(hand: UserHand, side: Side) -> UserHand:
    """The same hand in its glove on the other arm, if it is not on this one."""
    if hand.side == side:
        return hand
    worn = hand.attachment
    shape = dataclasses.replace(hand.model.shape, side=side)
    turned = dataclasses.replace(worn, points=worn.points @ MIRROR, normals=worn.normals @ MIRROR)
    return UserHand(HandModel(shape), turned)


def _follow(
    markers: NDArray[np.float64],
    hand: UserHand,
    frames: NDArray[np.int64],
    initial: NDArray[np.float64] | None = None,
) -> _Track:
    """Poses of some frames."""
    found = PoseSolver(hand.model, hand.attachment).solve(markers[frames], initial)
    return _Track(frames, found.qpos, found.rms)


def _digits(attachment: Attachment) -> NDArray[np.int64]:
    """Digit of each marker, -1 for the palm."""
    bones = attachment.bone_indices[np.arange(len(attachment.points)), attachment.bone_weights.argmax(axis=1)]
    return np.array([BONES[bone].digit for bone in bones])


def _informative(track: _Track, there: Bool[np.ndarray, "T M"]) -> NDArray[np.int64]:
    """Places in a track of frames as unlike each other as can be, those that lack no marker first."""
    lacking = (~there[track.frames]).sum(axis=1)
    steady = track.rms < 3.0 * np.median(track.rms)
    for allowed in range(there.shape[1]):
        candidates = np.flatnonzero((lacking <= allowed) & steady)
        if len(candidates) >= min(3 * NUM_FRAMES, steady.sum()):
            break
    angles = track.qpos[candidates, 7:]
    distance = np.full(len(candidates), np.inf)
    chosen = [int(np.abs(angles - angles.mean(axis=0)).sum(axis=1).argmax())]
    while len(chosen) < min(NUM_FRAMES, len(candidates)):
        distance = np.minimum(distance, ((angles - angles[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(distance.argmax()))
    picked: NDArray[np.int64] = candidates[np.sort(chosen)]
    return picked


def _begin(
    markers: NDArray[np.float64], right: UserHand, track: _Track, chosen: NDArray[np.int64]
) -> tuple[Problem, Guess]:
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


def _with_touches(
    problem: Problem,
    guess: Guess,
    markers: NDArray[np.float64],
    track: _Track,
    chosen: NDArray[np.int64],
    touches: list[tuple[int, str]],
    noise: float,
) -> tuple[Problem, Guess]:
    """The problem with the touches' frames added, at its own noise."""
    frames = np.array([frame for frame, _ in touches], dtype=np.int64)
    targets = np.where(problem.there[..., None], problem.targets, np.nan)
    larger = Problem(
        problem.shape,
        problem.design,
        problem.radius,
        np.concatenate([targets, markers[track.frames[frames]]]),
        noise=weighing_noise(noise, len(chosen) + len(frames)),
        reach=_REACH_IN_NOISES * noise,
    )
    guess = dataclasses.replace(guess, qpos=np.concatenate([guess.qpos, track.qpos[frames]]))
    if not touches:
        return larger, guess
    model = HandModel(shape_at(problem.shape, guess.parameters))
    contacts = place_contacts(model, touches, model.forward_kinematics(track.qpos[frames]))
    contacts = contacts._replace(frames=len(chosen) + np.arange(len(touches)))
    return larger, dataclasses.replace(guess, contacts=contacts)


def _user_hand(right: UserHand, problem: Problem, guess: Guess) -> UserHand:
    shape = shape_at(problem.shape, guess.parameters)
    return UserHand(HandModel(shape), wear_at(right.attachment.layout, guess.places, shape))


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
        sides.append(place_points(places, SkinPatch(places.faces).corners(fit.model.shape))[0] @ mirror)
    points, after = np.stack(sides, axis=1), fit.meeting.gaps
    return tuple(
        Touch(int(frames[frame]), finger, float(before[k]), float(after[k]), float(say[k]), points[k])
        for k, (frame, finger) in enumerate(touches)
    )


def _gaps_before(
    right: UserHand, markers: NDArray[np.float64], touches: list[tuple[int, str]], frames: NDArray[np.int64]
) -> NDArray[np.float64]:
    """How far from touching the hand was that the calibration began with [m]."""
    if not touches:
        return np.empty(0)
    there = frames[[frame for frame, _ in touches]]
    return gaps_on(right.model, touches, _follow(markers, right, there).qpos)
