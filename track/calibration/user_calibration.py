"""User calibration: marker positions, hand shape and contacts from a minute of labeled markers.

After Han et al. 2018, section 4.5: poses of some frames, marker positions on the rest hand and contact points
are solved together. Beyond the paper the hand's shape is solved, too, touches are detected instead of
annotated, and the result has standard errors and suggestions for a better capture.

The paper gives no values of its lambdas. Here they follow from standard deviations: lambda_1 is
(noise / POSITION_SPREAD)^2 and lambda_2 is (noise / CONTACT_SPREAD)^2, with the noise of the markers'
residuals. The standard deviations were chosen on simulated people (docs/calibration.md).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from gloves.fit import Attachment, GloveFit
from gloves.takes.points import Status, far_apart
from handsim.errors import CalibrationError
from handsim.hand.model import HandModel, build_skeleton
from handsim.hand.shape import DIGITS, JOINT_NAMES, NUM_JOINTS, PALM, HandShape, Side, bones_of
from handsim.hand.skin import rest_vertices
from handsim.kernels import CARPUS
from handsim.space.transforms import MIRROR, euler_matrix, quaternion_matrix, rigid_fit
from track.calibration.energy import (
    GESTURES_OF_USER,
    HEIGHT_SPREAD,
    POSITION_SPREAD,
    Estimate,
    Fit,
    Problem,
    Progress,
    are_touches,
    contact_geometry,
    contact_weights,
    error_covariance,
    find_touches,
    first_estimate,
    initialize_contacts,
    levenberg_marquardt,
    shared_covariance,
    user_hand,
)
from track.calibration.hand_parameters import (
    BONE_LENGTHS,
    LENGTH,
    NUM_PARAMETERS,
    SkinPatch,
    shape_at,
    shape_jacobian,
    skin_points,
    skin_weights,
)
from track.frames import TrackedFrame
from track.kinematics.pose_solver import FEWEST_ON_PART, PoseFit, PoseSolver
from track.kinematics.pose_spread import HandErrors, errors_of_motions

_WIDE_STEPS: Final = 6  # steps with the first robust scale, which includes distant markers
_STEPS_WITHOUT_CONTACTS: Final = 10  # last step without contacts, as in the paper
MOST_STEPS: Final = 30  # largest number of steps
_SPREAD_ROUNDS: Final = 4  # rounds of learning the spreads of marker places
_FIRST_NOISE, _FIRST_SCALE = 0.001, 0.03  # [m]
_SCALE_IN_NOISES: Final = 8.0  # robust scale, as multiple of the noise
_BETTER_SHARE: Final = 0.98  # A better hand reduces the residual to less than this share.
_SIGNIFICANT_TOUCH: Final = 0.25  # A touch with a larger weight is significant.
NUM_FRAMES: Final = 240  # number of frames that a calibration uses
FEWEST_FRAMES: Final = 100  # A capture needs this many usable frames.
_INITIAL_FRAMES: Final = 800
_FEWEST_MARKERS_OF_FRAME: Final = 6  # A usable frame has this many markers.
_LEAST_MARKER_SHARE: Final = 0.75  # A usable frame has this share of the markers.
_MOST_RMS_RATIO: Final = 3.0  # A used frame has an RMS of at most this multiple of the median.
_LOOK_PERIOD: Final = 1.0 / 30.0  # [s] between two poses that a guide examines
_ASK_PERIOD: Final = 1.0  # [s] least time between two requests of a guide
_LEAST_HANDS_TIME: Final = 30.0  # [s] of tracked hands before a guide ends
_ENOUGH_RANGE: Final = 0.3  # share of its range that each joint should cover
_LEAST_NOISE, _MOST_NOISE = 0.0001, 0.003  # [m]
_CHI2_MEDIAN: Final = 2.366  # median of the chi-squared distribution with three degrees of freedom
_USUAL_SPREAD_COORDINATES: Final = 12.0  # coordinates of markers that the usual spread counts for
_MOST_ERRORS: Final = 64  # independent errors that are kept of a hand: 99.9 % of its variances
# How far a turn and a log length move a fingertip or its marker, roughly [m]: the largest errors are kept.
_ARM, _BONE = 0.05, 0.03
_ARCHES: Final = {"ring": (0.09, 0.06), "little": (0.25, 0.14)}
"""Share of the first bone's flexion by which the metacarpal flexes: mean and standard deviation among four
people (benchmarks/palm.py)."""
_INDEPENDENT_ARCHES: Final = 4.0  # number of frames whose palms leave the usual arch independently, at most
_ON_KNUCKLE: Final = 0.4  # Palm and first bone each carry more than this of a marker on a knuckle.
_MOST_SHARE: Final = 0.75  # of the flexion of a first bone that its metacarpal has
_LEAST_TURN: Final = np.deg2rad(0.1)  # [rad] lower bound of the noise of a metacarpal's flexion
_INDEPENDENT_POSES: Final = 14.0  # number of frames with independent deformation of the flesh, at most


@dataclass(frozen=True, slots=True, eq=False)
class Touch:
    """A contact of the thumb with a fingertip, detected in the data."""

    frame: int
    """Number of the frame in the capture."""
    finger: str
    gap_before: float
    """Gap between the compressed pads on the first hand [m]."""
    gap_after: float
    """Gap on the calibrated hand [m]."""
    weight: float
    """Weight of the touch in the energy, 0 to 1."""
    points: Float[np.ndarray, "2 3"]
    """Contact points of thumb and finger on the calibrated rest hand, in the wrist's frame [m]."""


class HeldOut(NamedTuple):
    """How well hands fit held-out frames, which the calibration did not use."""

    before: float
    """Median over frames of the markers' RMS distance from the hand before calibration [m]."""
    after: float
    """The same with the calibrated hand [m]."""
    num_frames: int
    """Number of frames."""
    other_labels: str = ""
    """Labels that fit the points better than those that were given, such as "RH1 and RH6 are exchanged"."""

    @property
    def is_better(self) -> bool:
        """Whether the calibrated hand fits better by more than chance, and no label is doubtful."""
        return not self.other_labels and self.after < _BETTER_SHARE * self.before


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A calibrated hand and the diagnostics of its calibration."""

    hand: GloveFit
    start: GloveFit
    """The hand before calibration."""
    rms_before: float
    """Median over frames of the markers' RMS distance from the hand before [m]."""
    rms_after: float
    """The same with the calibrated hand [m]."""
    shifts: Float[np.ndarray, "M"]
    """Distance of each marker from its designed position on this hand [m]."""
    position_errors: Float[np.ndarray, "M"]
    """Standard error of each marker's position on its bone; on the palm relative to the knuckles [m]."""
    length_errors: Float[np.ndarray, "5 3"]
    """Standard error of each bone's length [m]."""
    errors: HandErrors
    """Errors of bones and marker places that stay, as independent ones that are alike in all frames."""
    touches: tuple[Touch, ...]
    still_joints: tuple[str, ...]
    """Joints that moved too little to determine the bones on either side."""
    held_out: HeldOut | None = None
    """Residuals on held-out frames; None if they were not tested."""

    @property
    def is_better(self) -> bool:
        """Whether it was tested on held-out frames, and fits them better than the hand before."""
        return self.held_out is not None and self.held_out.is_better

    @property
    def place_error(self) -> float:
        """Standard error of the markers' places, as root mean square over markers [m]."""
        return float(np.sqrt((self.position_errors**2).mean()))

    def __str__(self) -> str:
        """Residuals on held-out frames and error of marker places [mm], and a found arch, in a line."""
        if self.held_out is None:
            return "too few frames to try a calibration on, so that it stays as it was"
        before, after, frames, other_labels = self.held_out
        line = f"markers {1e3 * before:.2f} mm off before and {1e3 * after:.2f} mm after calibration, "
        line += f"on {frames} frames held out"
        if other_labels:
            return f"{line}, but it is likelier that {other_labels}, so that it stays as it was"
        if not self.is_better:
            return f"{line}: no better, so that it stays as it was"
        line += f", their places known to {1e3 * self.place_error:.1f} mm"
        if (arch := self.hand.shape.arch).any():
            line += (
                f", metacarpals of ring and little finger flex {arch[0]:.2f} and {arch[1]:.2f} times as far"
            )
            line += " as the MCP joints"
        return line

    @property
    def significant_touches(self) -> tuple[Touch, ...]:
        """Touches with a weight above 0.25."""
        return tuple(touch for touch in self.touches if touch.weight > _SIGNIFICANT_TOUCH)

    def gaps(self) -> Float[np.ndarray, "2"]:
        """Mean absolute gap [m] before and after, of the significant touches; NaN without any."""
        if not self.significant_touches:
            return np.full(2, np.nan)
        pairs = np.abs([[touch.gap_before, touch.gap_after] for touch in self.significant_touches])
        return np.asarray(pairs.mean(axis=0))

    def suggestions(self) -> tuple[str, ...]:
        """Sentences on what to do in a better capture; empty if nothing is missing."""
        sentences = list(_motions(self.still_joints))
        touched = {touch.finger for touch in self.significant_touches}
        missing = [finger for finger in DIGITS[1:] if finger not in touched]
        if missing:
            fingers = ", ".join(missing)
            sentences.append(f"touch the thumb to the tips of these fingers and hold still: {fingers}")
        return tuple(sentences)


def _motions(still: Sequence[str]) -> Iterator[str]:
    """Sentences on joints that moved too little, one per digit."""
    for digit in DIGITS:
        own = [name.removeprefix(f"{digit}_").replace("_", " ") for name in still if name.startswith(digit)]
        if own:
            yield f"move the {digit} more, through the whole range of {', '.join(own)}"


class MotionGuide:
    """Tells users which joints of the tracked hands to move, so that a calibration finds them all."""

    def __init__(self, hands: Sequence[GloveFit]) -> None:
        self._hands = {hand.side: hand for hand in hands}
        self._angles: dict[Side, list[NDArray[np.float64]]] = {side: [] for side in self._hands}
        self._complete: dict[Side, list[NDArray[np.bool_]]] = {side: [] for side in self._hands}
        self._looked, self._asked, self._wish = -np.inf, -np.inf, ""  # [s] of last pose, request
        self._looks = 0  # number of examined poses with a tracked hand

    def __call__(self, tracked: TrackedFrame) -> str | None:
        """The request after a frame; None when every joint covered its range, and half a minute is over."""
        if tracked.time >= self._looked + _LOOK_PERIOD:
            self._looked = tracked.time
            there = [hand for hand in tracked.hands if hand.status is Status.TRACKED]
            self._looks += bool(there)
            for hand in there:
                seen = hand.markers.copy()
                seen[hand.filled] = np.nan
                self._angles[hand.side].append(hand.qpos[7:])
                self._complete[hand.side].append(
                    complete_digits(seen[None], self._hands[hand.side].attachment)[0]
                )
        if tracked.time >= self._asked + _ASK_PERIOD:
            self._asked, self._wish = tracked.time, next(self._wishes(), "")
        if not self._wish and self._looks * _LOOK_PERIOD >= _LEAST_HANDS_TIME:
            return None
        return self._wish or "touch the thumb to the tip of each finger and hold still"

    def _wishes(self) -> Iterator[str]:
        """Requests for each hand."""
        for side, hand in self._hands.items():
            if not self._angles[side]:
                yield f"no {side} hand is tracked yet"
                continue
            angles, complete = np.array(self._angles[side]), np.array(self._complete[side])
            for wish in _motions(still_joints(angles, complete, hand.model)):
                yield f"{side} hand: {wish}"


def calibrate_hand(
    markers: Float[np.ndarray, "T M 3"],
    start: GloveFit,
    rate: float,
    *,
    progress: Progress | None = None,
) -> Calibration:
    """Fit a hand and its glove to labeled markers of one user."""
    mirror = MIRROR if start.side == "left" else np.eye(3)
    markers, right = np.asarray(markers, dtype=np.float64) @ mirror, start.with_side("right")
    usable = usable_frames(markers, start)
    seen, complete = markers[usable], complete_digits(markers[usable], right.attachment)
    # Solve poses of frames spread over the capture, with the first hand.
    every = max(1, len(usable) // _INITIAL_FRAMES)
    some = seen[::every]
    track = PoseSolver(right).solve(some)
    chosen, scales = informative_frames(track, some), {"noise": _FIRST_NOISE, "robust_scale": _FIRST_SCALE}
    problem, estimate = first_estimate(
        right, some[chosen], track.qpos[chosen], gestures=GESTURES_OF_USER, **scales
    )
    # Distant markers are down-weighted only after the hand nearly fits.
    estimate, fit, steps = levenberg_marquardt(problem, estimate, 0, _WIDE_STEPS, progress)
    problem.robust_scale = _SCALE_IN_NOISES * marker_noise(problem, fit)
    learn_arch(problem, estimate)
    estimate, fit, steps = levenberg_marquardt(problem, estimate, steps, _STEPS_WITHOUT_CONTACTS, progress)
    rough = user_hand(right, problem, estimate)
    rough_track = PoseSolver(rough).solve(seen, track.qpos[np.arange(len(seen)) // every])
    touches = find_touches(rough.model, rough_track.qpos[:, 7:], complete, rate)
    problem, estimate, touches = _with_touches(problem, estimate, fit, seen, rough_track, touches)
    for last in np.linspace(steps, MOST_STEPS, 1 + _SPREAD_ROUNDS).astype(int)[1:]:
        learn_spreads(problem, estimate, problem.fit(estimate))
        learn_arch(problem, estimate)
        estimate, fit, steps = levenberg_marquardt(problem, estimate, steps, int(last), progress)
    done = user_hand(right, problem, estimate)
    before = np.empty(0)
    if touches:
        touching = PoseSolver(right).solve(seen[[frame for frame, _ in touches]])
        before = contact_gaps(right.model, touches, touching.qpos)
    final = PoseSolver(done).solve(seen, rough_track.qpos)
    covariance = error_covariance(problem, estimate, fit)
    position_errors, length_errors = standard_errors(problem, estimate, fit, covariance)
    return Calibration(
        hand=done.with_side(start.side),
        start=start,
        rms_before=float(np.median(track.rms)),
        rms_after=float(np.median(final.rms)),
        shifts=np.linalg.norm(fit.design_residuals, axis=1),
        position_errors=position_errors,
        length_errors=length_errors,
        errors=remaining_errors(problem, estimate, covariance, done.with_side(start.side)),
        touches=_touches(estimate, fit, touches, usable, before, mirror),
        still_joints=still_joints(final.qpos[:, 7:], complete, done.model),
    )


def _with_touches(
    problem: Problem,
    estimate: Estimate,
    fit: Fit,
    markers: NDArray[np.float64],
    track: PoseFit,
    touches: list[tuple[int, str]],
) -> tuple[Problem, Estimate, list[tuple[int, str]]]:
    """The problem with the frames of the touches, and the noise of the first fit; and the likely touches."""
    # The other frames are selected again: wrong labels are recognized on a hand that nearly fits.
    noise = marker_noise(problem, fit)
    chosen = informative_frames(track, markers)
    touching = np.array([frame for frame, _ in touches], dtype=np.int64)
    frames = np.concatenate([chosen, touching])
    # Flesh moves alike in similar poses, so many frames tell no more about it than a few.
    flesh = repeated_share(track.qpos, track.residuals) * noise**2
    repeats = len(frames) / min(independent_count(track.qpos[:, 7:]), _INDEPENDENT_POSES)
    larger = Problem(
        problem.shape,
        problem.design,
        problem.heights,
        markers[frames],
        noise=float(np.sqrt(noise**2 + flesh * max(repeats - 1.0, 0.0))),
        robust_scale=_SCALE_IN_NOISES * noise,
        gestures=GESTURES_OF_USER,
    )
    larger.data_noise = noise
    estimate = dataclasses.replace(estimate, qpos=track.qpos[frames])
    if not touches:
        return larger, estimate, touches
    model = HandModel(shape_at(problem.shape, estimate.parameters))
    contacts = initialize_contacts(model, touches, model.forward_kinematics(track.qpos[touching]))
    contacts = contacts._replace(frames=len(chosen) + np.arange(len(touches)))
    estimate = dataclasses.replace(estimate, contacts=contacts)
    at = larger.fit(estimate)
    likely = are_touches(at.geometry.gaps, larger.gap_spreads(estimate, at))
    estimate = dataclasses.replace(estimate, contacts=contacts.part(likely))
    return larger, estimate, list(compress(touches, likely))


def _touches(
    estimate: Estimate,
    fit: Fit,
    touches: list[tuple[int, str]],
    frames: NDArray[np.int64],
    before: NDArray[np.float64],
    mirror: NDArray[np.float64],
) -> tuple[Touch, ...]:
    """The touches with their gaps on the first and on the calibrated hand."""
    weights = contact_weights(fit.geometry, estimate.contacts.fingers)
    pads, after = estimate.contacts.pads, fit.geometry.gaps
    ends, _ = skin_points(pads, SkinPatch(pads.faces).corners(fit.model.surface.vertices))
    points = (ends @ mirror).reshape(2, -1, 3).swapaxes(0, 1)
    return tuple(
        Touch(int(frames[frame]), finger, float(before[k]), float(after[k]), float(weights[k]), points[k])
        for k, (frame, finger) in enumerate(touches)
    )


def usable_frames(markers: Float[np.ndarray, "T M 3"], hand: GloveFit) -> NDArray[np.int64]:
    """Indices of the frames with enough markers for a pose."""
    count = markers.shape[1]
    needed = min(count, max(_FEWEST_MARKERS_OF_FRAME, round(_LEAST_MARKER_SHARE * count)))
    usable = np.flatnonzero(np.isfinite(markers[..., 0]).sum(axis=1) >= needed)
    if len(usable) < FEWEST_FRAMES:
        raise CalibrationError(
            f"{len(usable)} of {len(markers)} frames have {needed} or more of the {hand.side} hand's {count} "
            f"markers, expected at least {FEWEST_FRAMES} such frames"
        )
    return usable


def complete_digits(markers: Float[np.ndarray, "T M 3"], attachment: Attachment) -> Bool[np.ndarray, "T 5"]:
    """Whether all markers of each digit are seen."""
    present = np.isfinite(markers[..., 0])
    digits = attachment.digits
    return np.stack([present[:, digits == digit].all(axis=1) for digit in range(len(DIGITS))], axis=1)


def informative_frames(track: PoseFit, markers: Float[np.ndarray, "T M 3"]) -> NDArray[np.int64]:
    """Indices of well-fitted frames with poses as different, and as complete, as possible."""
    missing = np.isnan(markers[..., 0]).sum(axis=1)
    well_fitted = track.rms <= _MOST_RMS_RATIO * np.median(track.rms)
    for allowed in range(markers.shape[1]):
        candidates = np.flatnonzero((missing <= allowed) & well_fitted)
        if len(candidates) >= min(3 * NUM_FRAMES, well_fitted.sum()):
            break
    angles = track.qpos[candidates, 7:]
    first = int(np.abs(angles - angles.mean(axis=0)).sum(axis=1).argmax())
    chosen = far_apart(angles, first, NUM_FRAMES)
    return np.asarray(candidates[np.sort(chosen)])


def marker_noise(problem: Problem, fit: Fit) -> float:
    """Standard deviation of marker coordinates [m], from the median residual and the degrees of freedom."""
    squares = (fit.residuals**2).sum(axis=2)[problem.present]
    freedom = 3 * len(squares) - 26 * len(fit.residuals) - NUM_PARAMETERS - 3 * fit.residuals.shape[1]
    remaining = max(freedom, 1) / (3 * len(squares))
    return float(np.clip(np.sqrt(np.median(squares) / (_CHI2_MEDIAN * remaining)), _LEAST_NOISE, _MOST_NOISE))


def repeated_share(qpos: Float[np.ndarray, "T 27"], residuals: Float[np.ndarray, "T M 3"]) -> float:
    """Share of the residuals' variance that repeats in similar poses, as flesh moves with the joints."""
    # This is the correlation of residuals, in the wrist's frame, between each frame and the frame with the
    # nearest joint angles. Independent noise gives zero.
    from scipy.spatial import cKDTree

    local = np.einsum("tji,tmj->tmi", quaternion_matrix(qpos[:, 3:7]), residuals)
    nearest = cKDTree(qpos[:, 7:]).query(qpos[:, 7:], k=2)[1][:, 1]
    products, squares = local * local[nearest], 0.5 * (local**2 + local[nearest] ** 2)
    both = np.isfinite(products)
    return float(np.clip(products[both].sum() / max(squares[both].sum(), 1e-18), 0.0, 1.0))


def independent_count(values: Float[np.ndarray, "T J"]) -> float:
    """Number of samples as independent as a sequence, by its autocorrelation up to where it vanishes."""
    off = values - values.mean(axis=0)
    spectrum = np.square(np.abs(np.fft.rfft(off, 2 * len(off), axis=0))).sum(axis=1)
    correlation = np.fft.irfft(spectrum)[: len(off)]
    ends = np.append(np.flatnonzero(correlation <= 0.0), len(off))[0]
    return float(len(off) / max(2.0 * correlation[:ends].sum() / max(correlation[0], 1e-18) - 1.0, 1.0))


def learn_spreads(problem: Problem, estimate: Estimate, fit: Fit) -> None:
    """Estimate the spreads of marker places and heights of this glove (evidence procedure, MacKay 1992)."""
    covariance, _ = shared_covariance(problem, estimate, fit)
    own = [slice(first, first + 3) for first in range(NUM_PARAMETERS, len(covariance), 3)]
    blocks, normals = np.array([covariance[one, one] for one in own]), fit.normals
    across = np.einsum("mi,mij,mj->m", normals, blocks, normals)
    along = np.trace(blocks, axis1=1, axis2=2) - across
    off = fit.design_residuals
    slips = (off**2).sum(axis=1) - (off * normals).sum(axis=1) ** 2
    lifts = (estimate.coordinates.heights - problem.heights) ** 2
    problem.position_spread = _learned(slips, along, 2, problem.position_spread, POSITION_SPREAD)
    problem.height_spread = _learned(lifts, across, 1, problem.height_spread, HEIGHT_SPREAD)


def learn_arch(problem: Problem, estimate: Estimate) -> None:
    """Estimate how far this user's metacarpals flex, by the paths of markers on knuckles across the palm.

    The fit of all markers hardly tells, because a knuckle's marker that sinks may as well lie further out on
    a bending finger. The arch of a finger stays as it is without markers on its knuckle and its first bone,
    or with less than three on the rest of the palm.
    """
    weights, arch = skin_weights(problem.design), problem.shape.arch.copy()
    arched = [bone for digit in _ARCHES for bone in bones_of(digit)]
    back = (weights[:, PALM] > _ON_KNUCKLE) & (weights[:, arched].sum(axis=1) < _ON_KNUCKLE)
    if back.sum() < FEWEST_ON_PART:
        return
    on_back = np.broadcast_to(estimate.points[back], (len(estimate.qpos), int(back.sum()), 3))
    turns, shifts = rigid_fit(problem.targets[:, back], on_back)
    for number, (digit, (mean, spread)) in enumerate(_ARCHES.items()):
        first, base = bones_of(digit)[0], CARPUS * problem.shape.knuckles[DIGITS.index(digit)]
        on_bone = weights[:, first].copy()
        knuckle = int(np.minimum(weights[:, PALM], on_bone).argmax())
        on_bone[knuckle] = 0.0
        outer = int(on_bone.argmax())
        seen = problem.present[:, [knuckle, outer]].all(axis=1) & problem.present[:, back].all(axis=1)
        if min(weights[knuckle, [PALM, first]]) <= _ON_KNUCKLE or on_bone[outer] < 0.5 or not seen.any():
            continue
        ends = np.einsum("tij,tmj->tmi", turns, problem.targets[:, [knuckle, outer]]) + shifts[:, None]
        flexions = [
            np.arctan2(-way[:, 2], way[:, 0])[seen] for way in (ends[:, 0] - base, ends[:, 1] - ends[:, 0])
        ]
        metacarpal, bone = (one - one.mean() for one in flexions)
        slope = (bone @ metacarpal) / max(float(bone @ bone), 1e-12)
        scatter = (metacarpal - slope * bone).var() + _LEAST_TURN**2
        precision = min(_INDEPENDENT_ARCHES, len(bone)) * bone.var() / scatter
        share = np.clip((precision * slope + mean / spread**2) / (precision + spread**-2), 0.0, _MOST_SHARE)
        arch[number] = share / (1.0 - share)
    problem.shape = dataclasses.replace(problem.shape, arch=arch)


def _learned(
    squares: NDArray[np.float64], variances: NDArray[np.float64], axes: int, spread: float, usual: float
) -> float:
    """Estimate a spread [m] of offsets, given their squares and posterior variances, summed over axes."""
    determined = np.clip(axes - variances / spread**2, 0.0, None).sum()
    total, usual_count = squares.sum() + _USUAL_SPREAD_COORDINATES * usual**2, _USUAL_SPREAD_COORDINATES
    return float(np.sqrt(total / (determined + usual_count)))


def standard_errors(
    problem: Problem, estimate: Estimate, fit: Fit, covariance: Float[np.ndarray, "S S"]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Standard errors of marker positions on their bones (M,) and of bone lengths (5, 3) [m]."""
    # The place of the wrist in the palm is a convention, so errors of the palm's markers are relative to
    # the knuckles.
    weights = skin_weights(estimate.coordinates)
    bones, patch = weights.argmax(axis=1), SkinPatch(estimate.coordinates.faces)

    def on_bones(shapes: list[HandShape]) -> NDArray[np.float64]:
        local, knuckles = [], fit.model.skeleton.offsets[1::3]
        for shape, vertices in zip(shapes, rest_vertices(shapes), strict=True):
            skeleton = build_skeleton(shape)
            rest = skeleton.rest_transforms()[bones]
            points = skin_points(estimate.coordinates, patch.corners(vertices))[0]
            rotation, translation = rigid_fit(skeleton.offsets[1::3], knuckles)
            among_knuckles = points @ rotation.T + translation
            own = np.einsum("mji,mj->mi", rest[:, :3, :3], points - rest[:, :3, 3])
            local.append(np.where((bones == PALM)[:, None], among_knuckles, own))
        return np.array(local)

    count = len(bones)
    jacobian = np.zeros((count, 3, len(covariance)))
    jacobian[..., :NUM_PARAMETERS] = shape_jacobian(problem.shape, estimate.parameters, on_bones)
    by_place = jacobian[..., NUM_PARAMETERS:].reshape(count, 3, count, 3)
    by_place[range(count), :, range(count)] = fit.model.rest_transforms[bones, :3, :3].swapaxes(1, 2)
    positions = np.sqrt(np.einsum("mis,st,mit->m", jacobian, covariance, jacobian, optimize=True))
    own = covariance[BONE_LENGTHS, BONE_LENGTHS].diagonal()
    logs = own + covariance[LENGTH, LENGTH] + 2.0 * covariance[BONE_LENGTHS, LENGTH]
    return positions, fit.model.shape.bone_lengths * np.sqrt(logs).reshape(5, 3)


def remaining_errors(
    problem: Problem, estimate: Estimate, covariance: Float[np.ndarray, "S S"], hand: GloveFit
) -> HandErrors:
    """The largest independent errors of a calibrated hand, from the covariance of its shared unknowns."""
    patch = SkinPatch(estimate.coordinates.faces)
    before = euler_matrix(shape_at(problem.shape, estimate.parameters).base_angles).swapaxes(1, 2)

    def described(shapes: list[HandShape]) -> NDArray[np.float64]:
        rows = []
        for shape, vertices in zip(shapes, rest_vertices(shapes), strict=True):
            turned = euler_matrix(shape.base_angles) @ before
            turns = turned[:, [2, 0, 1], [1, 2, 0]]
            numbers = np.hstack([shape.knuckles, turns, np.log(shape.bone_lengths)])
            points, _ = skin_points(estimate.coordinates, patch.corners(vertices))
            rows.append(np.append(numbers, points))
        return np.array(rows)

    count = 3 * len(estimate.points)
    jacobian = np.pad(shape_jacobian(problem.shape, estimate.parameters, described), ((0, 0), (0, count)))
    jacobian[-count:, -count:] += np.eye(count)
    scales = np.append(np.tile(np.repeat([1.0, _ARM, _BONE], 3), len(DIGITS)), np.ones(count))
    jacobian *= scales[:, None]
    variances, ways = np.linalg.eigh(jacobian @ covariance @ jacobian.T)
    kept = ways * np.sqrt(np.maximum(variances, 0.0)) / scales[:, None]
    kept = kept[:, : -_MOST_ERRORS - 1 : -1]
    numbers, motions = (
        kept[:-count].reshape(len(DIGITS), 3, 3, -1),
        kept[-count:].reshape(-1, 3, kept.shape[1]),
    )
    if hand.side == "left":  # A mirrored turn has the opposite sense.
        mirror = np.diag(MIRROR)[:, None]
        numbers, motions = numbers * np.stack([mirror, -mirror, np.ones((3, 1))]), motions * mirror
    return errors_of_motions(hand, np.pad(numbers.reshape(-1, kept.shape[1]), ((0, 1), (0, 0))), motions)


def contact_gaps(
    model: HandModel, touches: list[tuple[int, str]], qpos: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Gaps between thumb and finger (K,) [m] in touches of a right hand, given the pose (K, 27) of each."""
    bones = model.forward_kinematics(qpos)
    contacts = initialize_contacts(model, touches, bones)
    corners = SkinPatch(contacts.pads.faces).corners(model.surface.vertices)
    return contact_geometry(contacts, corners, model, bones).gaps


def still_joints(
    angles: Float[np.ndarray, "T 20"], complete: Bool[np.ndarray, "T 5"], model: HandModel
) -> tuple[str, ...]:
    """Joints that covered too little of their range while all markers of their digit were seen."""
    ranges = model.skeleton.ranges
    still = []
    for joint in range(NUM_JOINTS):
        seen = angles[complete[:, joint // 4], joint]
        covered = np.ptp(np.quantile(seen, [0.02, 0.98])) if len(seen) else 0.0
        if covered < _ENOUGH_RANGE * (ranges[joint, 1] - ranges[joint, 0]):
            still.append(JOINT_NAMES[joint])
    return tuple(still)
