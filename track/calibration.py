"""User calibration: marker places, hand shape and touches from a minute of labelled markers.

After Han et al. 2018, section 4.5: poses of some frames, marker places on the rest hand and contact points are
solved together. Beyond the paper the hand's shape is solved too, touches are found instead of annotated, and
the result says how sure it is and what the user should have moved more.

The paper leaves its lambdas open. Here they follow from spreads in millimetres: lambda_1 is
(noise / PLACE_SPREAD)^2 and lambda_2 (noise / CONTACT_SPREAD)^2, the noise being what the markers are left off
by; the spreads were chosen on simulated people (docs/calibration.md).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from gloves.attach import Attachment
from handsim._checks import check_array
from handsim.errors import ShapeError
from handsim.model import HandModel
from handsim.shape import HandShape
from handsim.topology import DIGITS, JOINT_NAMES, NUM_JOINTS
from handsim.transforms import MIRROR
from track._calibration_solve import Fit, Guess, Problem, eliminate, step
from track.contacts import Contacts, find_touches, place_contacts, trust
from track.hand_parameters import BONE_LENGTHS, LENGTH, NUM_PARAMETERS, shape_at, slopes_of
from track.inverse_kinematics import PoseSolver
from track.skin_walk import SkinPatch, nearest_places, place_points, place_weights
from track.user import UserHand

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy.typing import NDArray

Progress = Callable[[int, float, float], None]
"""Called after each step with its number, the RMS of the markers and of the touches' gaps [m] (NaN: none yet)."""
NUM_FRAMES: Final = 160
FEWEST_FRAMES: Final = 30
ENOUGH_RANGE: Final = 0.3
"""Share of a hinge's range that the user has to cover."""
_CONTACTS_FROM: Final = 10  # steps without contacts, as in the paper
_MOST_STEPS: Final = 30
_FIRST_NOISE, _FIRST_REACH = 0.001, 0.03  # [m]
_LEAST_NOISE, _MOST_NOISE = 0.0002, 0.003  # [m]
_REACH_IN_NOISES: Final = 8.0
_SMALL_GAIN: Final = 1e-4  # of the energy, after which steps end
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
        """Mean distance from touching [m], before and after, over the touches that counted; NaN without any."""
        chosen = [t for t in self.touches if t.trust > 0.25 and finger in {None, t.finger}]
        if not chosen:
            return np.full(2, np.nan)
        return np.abs([[t.gap_before, t.gap_after] for t in chosen]).mean(axis=0)

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
    """Poses of the frames that have enough markers."""

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
        ShapeError: `markers` do not fit the glove, `rate` is not positive, or too few frames have enough markers.
    """
    markers = _checked(markers, start, rate)
    mirror = MIRROR if start.side == "left" else np.eye(3)
    markers, right = markers @ mirror, _mirrored(start, "right")
    track = _follow(markers, right)
    digits = _digits(right.attachment)
    there = np.isfinite(markers).all(axis=2)
    chosen = _informative(track, there)
    problem, guess = _begin(markers, right, track, chosen)
    guess, fit, steps = _descend(problem, guess, 0, _CONTACTS_FROM, progress)
    rough = _user_hand(right, problem, guess, fit)
    rough_track = _follow(markers, rough)
    whole = np.stack([there[:, digits == d].all(axis=1) for d in range(len(DIGITS))], axis=1)
    touches = find_touches(rough.model, rough_track.qpos[:, 7:], whole[rough_track.frames], rate)
    noise = _noise(problem, fit)
    problem, guess = _with_touches(problem, guess, markers, rough_track, chosen, touches, noise)
    guess, fit, steps = _descend(problem, guess, steps, _MOST_STEPS, progress)
    done = _user_hand(right, problem, guess, fit)
    final = _follow(markers, done)
    place_errors, length_errors = _errors(problem, guess, fit, right.attachment)
    return Calibration(
        hand=_mirrored(done, start.side),
        start=start,
        rms_before=float(np.sqrt((track.rms**2).mean())),
        rms_after=float(np.sqrt((final.rms**2).mean())),
        shifts=np.linalg.norm(fit.off_design, axis=1),
        place_errors=place_errors,
        length_errors=length_errors,
        touches=_touches(problem, guess, fit, touches, rough_track, right, track, mirror),
        still_joints=_still_joints(final.qpos[:, 7:], whole[final.frames], done.model),
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


def _mirrored(hand: UserHand, side: str) -> UserHand:
    """The same hand in its glove on the other arm, if it is not on this one."""
    if hand.side == side:
        return hand
    worn = hand.attachment
    shape = dataclasses.replace(hand.model.shape, side=side)  # type: ignore[arg-type]
    turned = dataclasses.replace(worn, points=worn.points @ MIRROR, normals=worn.normals @ MIRROR)
    return UserHand(HandModel(shape), turned)


def _follow(markers: NDArray[np.float64], hand: UserHand) -> _Track:
    """Poses of all frames that have enough markers."""
    frames = np.flatnonzero(np.isfinite(markers[..., 0]).sum(axis=1) >= _needed(markers.shape[1]))
    found = PoseSolver(hand.model, hand.attachment).solve(markers[frames])
    return _Track(frames, found.qpos, found.rms)


def _digits(attachment: Attachment) -> NDArray[np.int64]:
    """Digit of each marker, -1 for the palm."""
    from handsim.topology import BONES

    bones = attachment.bone_indices[np.arange(len(attachment.points)), attachment.bone_weights.argmax(axis=1)]
    return np.array([BONES[bone].digit for bone in bones])


def _informative(track: _Track, there: Bool[np.ndarray, "T M"]) -> NDArray[np.int64]:
    """Places in a track of frames as unlike each other as can be, greedily, those that lack no marker first."""
    lacking = (~there[track.frames]).sum(axis=1)
    steady = track.rms < 3.0 * np.median(track.rms)
    for allowed in range(there.shape[1]):
        candidates = np.flatnonzero((lacking <= allowed) & steady)
        if len(candidates) >= min(3 * NUM_FRAMES, steady.sum()):
            break
    candidates = candidates[:: max(1, len(candidates) // _CANDIDATES)]
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


def _descend(
    problem: Problem, guess: Guess, steps: int, most: int, progress: Progress | None
) -> tuple[Guess, Fit, int]:
    """Steps until the energy hardly falls any more, or there have been `most`."""
    fit, damping, better = problem.fit(guess), 1e-3, True
    while better and steps < most:
        before = fit.cost
        guess, fit, damping, better = step(problem, guess, fit, damping)
        steps += 1
        if progress is not None:
            progress(steps, _rms(problem, fit), _gap(guess, fit))
        if abs(before - fit.cost) < _SMALL_GAIN * before:
            break
    return guess, fit, steps


def _rms(problem: Problem, fit: Fit) -> float:
    return float(np.sqrt((fit.misses**2).sum() / problem.there.sum()))


def _gap(guess: Guess, fit: Fit) -> float:
    if guess.contacts is None or fit.meeting is None:
        return float("nan")
    say = trust(fit.meeting.gaps, guess.contacts.fingers)
    return float(np.sqrt((say * fit.meeting.gaps**2).sum() / max(say.sum(), 1e-12)))


def _noise(problem: Problem, fit: Fit) -> float:
    """Standard deviation of a marker's coordinates, from the residuals and what was fitted to them."""
    squares = (fit.misses**2).sum(axis=2)[problem.there]
    typical = np.minimum(squares, 9.0 * np.median(squares))
    freedom = 3 * len(squares) - 26 * len(fit.misses) - NUM_PARAMETERS - 3 * fit.misses.shape[1]
    return float(np.clip(np.sqrt(typical.sum() / max(freedom, 1)), _LEAST_NOISE, _MOST_NOISE))


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
        noise=noise,
        reach=_REACH_IN_NOISES * noise,
    )
    guess = dataclasses.replace(guess, qpos=np.concatenate([guess.qpos, track.qpos[frames]]))
    if not touches:
        return larger, guess
    model = HandModel(shape_at(problem.shape, guess.parameters))
    contacts = place_contacts(model, touches, model.forward_kinematics(track.qpos[frames]))
    contacts = contacts._replace(frames=len(chosen) + np.arange(len(touches)))
    return larger, dataclasses.replace(guess, contacts=contacts)


def _user_hand(right: UserHand, problem: Problem, guess: Guess, fit: Fit) -> UserHand:
    """The guess as a hand in its glove; each marker keeps its four strongest bones."""
    weights = place_weights(guess.places)
    bones = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    shares = np.clip(np.take_along_axis(weights, bones, axis=1), 0.0, None)
    shares /= shares.sum(axis=1, keepdims=True)
    return UserHand(
        HandModel(shape_at(problem.shape, guess.parameters)),
        Attachment(right.attachment.layout, guess.points, fit.normals, bones, shares),
    )


def _errors(
    problem: Problem, guess: Guess, fit: Fit, worn: Attachment
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Standard errors [m] of marker places on their bones, and of bone lengths."""
    reduced, _ = eliminate(problem.equations(guess, fit), 0.0)
    covariance = np.linalg.inv(reduced[:, :-1])
    weights = place_weights(guess.places)
    bones, patch = weights.argmax(axis=1), SkinPatch(guess.places.faces)

    def on_bones(shape: HandShape) -> NDArray[np.float64]:
        rest = HandModel(shape).rest_transforms[bones]
        points = place_points(guess.places, patch.corners(shape))[0]
        local: NDArray[np.float64] = np.einsum("mji,mj->mi", rest[:, :3, :3], points - rest[:, :3, 3])
        return local

    count = len(bones)
    slopes = np.zeros((count, 3, len(covariance)))
    slopes[..., :NUM_PARAMETERS] = slopes_of(problem.shape, guess.parameters, on_bones)
    turns = fit.model.rest_transforms[bones][:, :3, :3].swapaxes(1, 2)
    for marker in range(count):
        first = NUM_PARAMETERS + 3 * marker
        slopes[marker, :, first : first + 3] = turns[marker]
    places = np.sqrt(np.einsum("mis,st,mit->m", slopes, covariance, slopes, optimize=True))
    own = covariance[BONE_LENGTHS, BONE_LENGTHS].diagonal()
    logs = own + covariance[LENGTH, LENGTH] + 2.0 * covariance[BONE_LENGTHS, LENGTH]
    return places, fit.model.shape.bone_lengths * np.sqrt(logs).reshape(5, 3)


def _touches(
    problem: Problem,
    guess: Guess,
    fit: Fit,
    touches: list[tuple[int, str]],
    rough: _Track,
    right: UserHand,
    track: _Track,
    mirror: NDArray[np.float64],
) -> tuple[Touch, ...]:
    """The touches with their gaps on the first and on the calibrated hand."""
    if guess.contacts is None or fit.meeting is None:
        return ()
    frames = [frame for frame, _ in touches]
    before = _gaps_on(right.model, touches, track.qpos[frames])
    say = trust(fit.meeting.gaps, guess.contacts.fingers)
    sides: list[NDArray[np.float64]] = []
    for places in (guess.contacts.thumb_places, guess.contacts.finger_places):
        sides.append(place_points(places, SkinPatch(places.faces).corners(fit.model.shape))[0] @ mirror)
    points = np.stack(sides, axis=1)
    return tuple(
        Touch(int(rough.frames[frame]), finger, float(before[k]), float(fit.meeting.gaps[k]), float(say[k]), points[k])
        for k, (frame, finger) in enumerate(touches)
    )


def _gaps_on(model: HandModel, touches: list[tuple[int, str]], qpos: NDArray[np.float64]) -> NDArray[np.float64]:
    from track.contacts import meet

    bones = model.forward_kinematics(qpos)
    contacts: Contacts = place_contacts(model, touches, bones)
    faces = np.concatenate([contacts.thumb_places.faces, contacts.finger_places.faces])
    return meet(contacts, SkinPatch(faces).corners(model.shape), model, bones).gaps


def _still_joints(
    angles: Float[np.ndarray, "T 20"], whole: Bool[np.ndarray, "T 5"], model: HandModel
) -> tuple[str, ...]:
    """Hinges that covered too little of their range, while their digit's markers were all there."""
    ranges = model.skeleton.ranges
    still = []
    for joint in range(NUM_JOINTS):
        seen = angles[whole[:, joint // 4], joint]
        covered = np.ptp(np.quantile(seen, [0.02, 0.98])) if len(seen) else 0.0
        if covered < ENOUGH_RANGE * (ranges[joint, 1] - ranges[joint, 0]):
            still.append(JOINT_NAMES[joint])
    return tuple(still)
