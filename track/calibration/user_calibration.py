"""User calibration: marker positions, hand shape and contacts from a minute of labeled markers.

The calibration follows Han et al. 2018, section 4.5: it solves the poses of some frames, the marker positions
on the rest hand and the contact points together. Unlike the paper it also solves the hand's shape, detects
touches instead of reading annotations, and reports standard errors and suggestions for a better capture.

The paper gives no values of its lambdas. Here lambda_1 is (noise / POSITION_SPREAD)^2 and lambda_2 is
(noise / CONTACT_SPREAD)^2, with the noise of the markers' residuals. Both standard deviations were chosen on
simulated people (docs/calibration.md).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from gloves.fit import Attachment, GloveFit
from gloves.takes.points import Status, far_apart
from handsim.arrays import Doubles, Flags, Integers
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
    mirror_to_right,
    shape_at,
    shape_jacobian,
    skin_points,
    skin_weights,
)
from track.frames import TrackedFrame
from track.kinematics.pose_solver import FEWEST_ON_PART, PoseFit, PoseSolver
from track.kinematics.pose_spread import MEDIAN_SQUARE, HandErrors, errors_of_motions

_WIDE_STEPS: Final = 6  # steps with the first robust scale, which includes distant markers
_STEPS_WITHOUT_CONTACTS: Final = 10  # last step without contacts, as in the paper
MOST_STEPS: Final = 30  # largest number of steps
_SPREAD_ROUNDS: Final = 4  # rounds of learning the spreads of marker places
_FIRST_NOISE, _FIRST_ROBUST_SCALE = 0.001, 0.03  # [m]
_ROBUST_SCALE_IN_NOISES: Final = 8.0  # robust scale, as multiple of the noise
_MOST_RESIDUAL_RATIO: Final = 0.98  # A better hand reduces the residual to less than this share.
_LEAST_TOUCH_WEIGHT: Final = 0.25  # A touch with a larger weight is significant.
NUM_FRAMES: Final = 240  # number of frames that a calibration uses
FEWEST_FRAMES: Final = 100  # A capture needs this many usable frames.
_INITIAL_FRAMES: Final = 800  # number of frames whose poses are solved with the first hand
_FEWEST_MARKERS_OF_FRAME: Final = 6  # A usable frame has this many markers.
_LEAST_MARKER_SHARE: Final = 0.75  # A usable frame has this share of the markers.
_MOST_RMS_RATIO: Final = 3.0  # A used frame has an RMS of at most this multiple of the median.
_EXAMINATION_PERIOD: Final = 1.0 / 30.0  # [s] between two poses that a guide examines
_REQUEST_PERIOD: Final = 1.0  # [s] least time between two requests of a guide
_LEAST_TRACKED_TIME: Final = 30.0  # [s] of tracked hands before a guide ends
_LEAST_RANGE_SHARE: Final = 0.3  # share of its range that each joint should cover
_LEAST_NOISE, _MOST_NOISE = 0.0001, 0.003  # [m]
_USUAL_SPREAD_COORDINATES: Final = 12.0  # The usual spread weighs as much as this many coordinates.
_KEPT_ERRORS: Final = 64  # A hand keeps its largest independent errors: 99.9 % of its variances.
# Motion of a fingertip per rotation [m/rad] and per log length [m], roughly; they rank errors by size.
_TURN_LEVER, _LENGTH_LEVER = 0.05, 0.03
_USUAL_ARCHES: Final = {"ring": (0.09, 0.06), "little": (0.25, 0.14)}
"""Flexion of the metacarpal over the sum of its flexion and the MCP joint's: mean and standard deviation of
four people (benchmarks/palm.py)."""
_INDEPENDENT_ARCH_FRAMES: Final = 4.0  # At most this many frames tell independently how the palm arches.
_KNUCKLE_WEIGHT: Final = 0.4  # Palm and first bone each have a larger skinning weight on a knuckle's marker.
_MOST_ARCH_SHARE: Final = 0.75  # upper bound of a metacarpal's share of its first bone's flexion
_LEAST_FLEXION_NOISE: Final = np.deg2rad(0.1)  # [rad] lower bound of the noise of a metacarpal's flexion
_INDEPENDENT_FLESH_FRAMES: Final = 14.0  # At most this many frames deform the flesh independently.


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
    """Median over frames of the markers' RMS distance from the calibrated hand [m]."""
    num_frames: int
    """Number of held-out frames."""
    other_labels: str = ""
    """Labels that fit the points better than those that were given, such as "RH1 and RH6 are exchanged"."""

    @property
    def is_better(self) -> bool:
        """Whether the calibrated hand fits better by more than chance, and no label is doubtful."""
        return not self.other_labels and self.after < _MOST_RESIDUAL_RATIO * self.before


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A calibrated hand and the diagnostics of its calibration."""

    hand: GloveFit
    start: GloveFit
    """The hand before calibration."""
    rms_before: float
    """Median over frames of the markers' RMS distance from the hand before [m]."""
    rms_after: float
    """Median over frames of the markers' RMS distance from the calibrated hand [m]."""
    shifts: Float[np.ndarray, "M"]
    """Distance of each marker from its designed position on this hand [m]."""
    position_errors: Float[np.ndarray, "M"]
    """Standard error of each marker's position on its bone; on the palm relative to the knuckles [m]."""
    length_errors: Float[np.ndarray, "5 3"]
    """Standard error of each bone's length [m]."""
    errors: HandErrors
    """Remaining errors of bones and marker places: independent ones, each equal in all frames."""
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
        """Residuals on held-out frames, error of marker places [mm] and the palm's arch, in a line."""
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
            line += f", metacarpals of ring and little finger flex {arch[0]:.2f} and {arch[1]:.2f} times as "
            line += "far as the MCP joints"
        return line

    @property
    def significant_touches(self) -> tuple[Touch, ...]:
        """Touches whose weight in the energy counts."""
        return tuple(touch for touch in self.touches if touch.weight > _LEAST_TOUCH_WEIGHT)

    def gaps(self) -> Float[np.ndarray, "2"]:
        """Mean absolute gap of the significant touches before and after [m]; NaN without any."""
        if not self.significant_touches:
            return np.full(2, np.nan)
        pairs = np.abs([[touch.gap_before, touch.gap_after] for touch in self.significant_touches])
        return np.asarray(pairs.mean(axis=0))

    def suggestions(self) -> tuple[str, ...]:
        """Sentences on what to do in a better capture; empty if nothing is missing."""
        sentences = list(_requests_to_move(self.still_joints))
        touched = {touch.finger for touch in self.significant_touches}
        missing = [finger for finger in DIGITS[1:] if finger not in touched]
        if missing:
            fingers = ", ".join(missing)
            sentences.append(f"touch the thumb to the tips of these fingers and hold still: {fingers}")
        return tuple(sentences)


def _requests_to_move(still: Sequence[str]) -> Iterator[str]:
    """Sentences on joints that moved too little, one per digit."""
    for digit in DIGITS:
        names = [name.removeprefix(f"{digit}_") for name in still if name.startswith(digit)]
        if names:
            yield f"move the {digit} more, through the whole range of {', '.join(names).replace('_', ' ')}"


class MotionGuide:
    """Tells users which joints of the tracked hands to move, so that a calibration finds them all."""

    def __init__(self, hands: Sequence[GloveFit]) -> None:
        self._hands = {hand.side: hand for hand in hands}
        self._angles: dict[Side, list[Doubles]] = {side: [] for side in self._hands}
        self._complete: dict[Side, list[Flags]] = {side: [] for side in self._hands}
        # [s] of the last pose, request
        self._examined_at, self._requested_at, self._request = -np.inf, -np.inf, ""
        self._num_examined = 0  # number of examined poses with a tracked hand

    def __call__(self, tracked: TrackedFrame) -> str | None:
        """The request after a frame; None once every joint has covered its range and 30 s have passed."""
        if tracked.time >= self._examined_at + _EXAMINATION_PERIOD:
            self._examined_at = tracked.time
            there = [hand for hand in tracked.hands if hand.status is Status.TRACKED]
            self._num_examined += bool(there)
            for hand in there:
                attachment = self._hands[hand.side].attachment
                self._angles[hand.side].append(hand.qpos[7:])
                self._complete[hand.side].append(complete_digits(hand.seen_markers[None], attachment)[0])
        if tracked.time >= self._requested_at + _REQUEST_PERIOD:
            self._requested_at, self._request = tracked.time, next(self._requests(), "")
        if not self._request and self._num_examined * _EXAMINATION_PERIOD >= _LEAST_TRACKED_TIME:
            return None
        return self._request or "touch the thumb to the tip of each finger and hold still"

    def _requests(self) -> Iterator[str]:
        """Requests for each hand."""
        for side, hand in self._hands.items():
            if not self._angles[side]:
                yield f"no {side} hand is tracked yet"
                continue
            angles, complete = np.array(self._angles[side]), np.array(self._complete[side])
            for request in _requests_to_move(still_joints(angles, complete, hand.model)):
                yield f"{side} hand: {request}"


def calibrate_hand(
    markers: Float[np.ndarray, "T M 3"], start: GloveFit, rate: float, *, progress: Progress | None = None
) -> Calibration:
    """Fit a hand and its glove to labeled markers of one user."""
    mirror = mirror_to_right(start.side)
    markers, right = np.asarray(markers, dtype=np.float64) @ mirror, start.with_side("right")
    usable = usable_frames(markers, start)
    seen, complete = markers[usable], complete_digits(markers[usable], right.attachment)
    stride = max(1, len(usable) // _INITIAL_FRAMES)
    sparse = seen[::stride]
    track = PoseSolver(right).solve(sparse)
    chosen = informative_frames(track, sparse)
    options = {"noise": _FIRST_NOISE, "robust_scale": _FIRST_ROBUST_SCALE, "gestures": GESTURES_OF_USER}
    problem, estimate = first_estimate(right, sparse[chosen], track.qpos[chosen], **options)
    # Distant markers are down-weighted only after the hand nearly fits.
    estimate, fit, steps = levenberg_marquardt(problem, estimate, 0, _WIDE_STEPS, progress)
    problem.robust_scale = _ROBUST_SCALE_IN_NOISES * marker_noise(problem, fit)
    learn_arch(problem, estimate)
    estimate, fit, steps = levenberg_marquardt(problem, estimate, steps, _STEPS_WITHOUT_CONTACTS, progress)
    rough = user_hand(right, problem, estimate)
    rough_track = PoseSolver(rough).solve(seen, track.qpos[np.arange(len(seen)) // stride])
    touches = find_touches(rough.model, rough_track.qpos[:, 7:], complete, rate)
    problem, estimate, touches = _with_touches(problem, estimate, fit, seen, rough_track, touches)
    for last in np.linspace(steps, MOST_STEPS, 1 + _SPREAD_ROUNDS).astype(int)[1:]:
        learn_spreads(problem, estimate, problem.fit(estimate))
        learn_arch(problem, estimate)
        estimate, fit, steps = levenberg_marquardt(problem, estimate, steps, int(last), progress)
    calibrated = user_hand(right, problem, estimate)
    before = np.empty(0)
    if touches:
        touching = PoseSolver(right).solve(seen[[frame for frame, _ in touches]])
        before = contact_gaps(right.model, touches, touching.qpos)
    final = PoseSolver(calibrated).solve(seen, rough_track.qpos)
    covariance = error_covariance(problem, estimate, fit)
    position_errors, length_errors = standard_errors(problem, estimate, fit, covariance)
    return Calibration(
        hand=calibrated.with_side(start.side),
        start=start,
        rms_before=float(np.median(track.rms)),
        rms_after=float(np.median(final.rms)),
        shifts=np.linalg.norm(fit.design_residuals, axis=1),
        position_errors=position_errors,
        length_errors=length_errors,
        errors=remaining_errors(problem, estimate, covariance, calibrated.with_side(start.side)),
        touches=_compared_touches(estimate, fit, touches, usable, before, mirror),
        still_joints=still_joints(final.qpos[:, 7:], complete, calibrated.model),
    )


def _with_touches(
    problem: Problem,
    estimate: Estimate,
    fit: Fit,
    markers: Doubles,
    track: PoseFit,
    touches: list[tuple[int, str]],
) -> tuple[Problem, Estimate, list[tuple[int, str]]]:
    """Add the touches' frames to a problem, with the noise of its fit; return the likely touches, too."""
    # Select the other frames again, because a hand that nearly fits reveals wrong labels.
    noise = marker_noise(problem, fit)
    chosen = informative_frames(track, markers)
    touching = np.array([frame for frame, _ in touches], dtype=np.int64)
    frames = np.concatenate([chosen, touching])
    # Flesh moves alike in similar poses, so many frames carry no more information on it than a few.
    flesh = repeated_share(track.qpos, track.residuals) * noise**2
    repeats = len(frames) / min(independent_count(track.qpos[:, 7:]), _INDEPENDENT_FLESH_FRAMES)
    larger = Problem(
        problem.shape,
        problem.design,
        problem.heights,
        markers[frames],
        noise=float(np.sqrt(noise**2 + flesh * max(repeats - 1.0, 0.0))),
        robust_scale=_ROBUST_SCALE_IN_NOISES * noise,
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
    with_gaps = larger.fit(estimate)
    likely = are_touches(with_gaps.geometry.gaps, larger.gap_spreads(estimate, with_gaps))
    estimate = dataclasses.replace(estimate, contacts=contacts.part(likely))
    return larger, estimate, list(compress(touches, likely))


def _compared_touches(
    estimate: Estimate,
    fit: Fit,
    touches: list[tuple[int, str]],
    frames: Integers,
    before: Doubles,
    mirror: Doubles,
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


def usable_frames(markers: Float[np.ndarray, "T M 3"], hand: GloveFit) -> Integers:
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


def informative_frames(track: PoseFit, markers: Float[np.ndarray, "T M 3"]) -> Integers:
    """Indices of well-fitted frames that show many markers, in poses as different as possible."""
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
    usual = MEDIAN_SQUARE * (max(freedom, 1) / (3 * len(squares)))
    return float(np.clip(np.sqrt(np.median(squares) / usual), _LEAST_NOISE, _MOST_NOISE))


def repeated_share(qpos: Float[np.ndarray, "T 27"], residuals: Float[np.ndarray, "T M 3"]) -> float:
    """Share of the residuals' variance that repeats in similar poses, as flesh moves with the joints."""
    # The share is the correlation of residuals in the wrist's frame between each frame and the frame with the
    # nearest joint angles. Independent noise gives zero.
    from scipy.spatial import cKDTree

    local = np.einsum("tji,tmj->tmi", quaternion_matrix(qpos[:, 3:7]), residuals)
    nearest = cKDTree(qpos[:, 7:]).query(qpos[:, 7:], k=2)[1][:, 1]
    products, squares = local * local[nearest], 0.5 * (local**2 + local[nearest] ** 2)
    both = np.isfinite(products)
    return float(np.clip(products[both].sum() / max(squares[both].sum(), 1e-18), 0.0, 1.0))


def independent_count(values: Float[np.ndarray, "T J"]) -> float:
    """Effective number of independent samples of a sequence, by its autocorrelation up to its first zero."""
    off = values - values.mean(axis=0)
    spectrum = np.square(np.abs(np.fft.rfft(off, 2 * len(off), axis=0))).sum(axis=1)
    correlation = np.fft.irfft(spectrum)[: len(off)]
    ends = np.append(np.flatnonzero(correlation <= 0.0), len(off))[0]
    return float(len(off) / max(2.0 * correlation[:ends].sum() / max(correlation[0], 1e-18) - 1.0, 1.0))


def learn_spreads(problem: Problem, estimate: Estimate, fit: Fit) -> None:
    """Estimate the spreads of marker places and heights of this glove (evidence procedure, MacKay 1992)."""
    covariance, _ = shared_covariance(problem, estimate, fit)
    parts = [slice(first, first + 3) for first in range(NUM_PARAMETERS, len(covariance), 3)]
    blocks, normals = np.array([covariance[part, part] for part in parts]), fit.normals
    across = np.einsum("mi,mij,mj->m", normals, blocks, normals)
    along = np.trace(blocks, axis1=1, axis2=2) - across
    off = fit.design_residuals
    slips = (off**2).sum(axis=1) - (off * normals).sum(axis=1) ** 2
    lifts = (estimate.coordinates.heights - problem.heights) ** 2
    problem.position_spread = _learned_spread(slips, along, 2, problem.position_spread, POSITION_SPREAD)
    problem.height_spread = _learned_spread(lifts, across, 1, problem.height_spread, HEIGHT_SPREAD)


def learn_arch(problem: Problem, estimate: Estimate) -> None:
    """Estimate how far this user's metacarpals flex, from the paths of knuckle markers relative to the palm.

    The fit of all markers hardly determines the arch, because a sinking knuckle marker looks like one that
    lies further out on a bending finger. A finger keeps its arch if its knuckle or its first bone has no
    marker, or if the rest of the palm has fewer than three.
    """
    weights, arch = skin_weights(problem.design), problem.shape.arch.copy()
    arched = [bone for digit in _USUAL_ARCHES for bone in bones_of(digit)]
    back = (weights[:, PALM] > _KNUCKLE_WEIGHT) & (weights[:, arched].sum(axis=1) < _KNUCKLE_WEIGHT)
    if back.sum() < FEWEST_ON_PART:
        return
    on_back = np.broadcast_to(estimate.points[back], (len(estimate.qpos), int(back.sum()), 3))
    turns, shifts = rigid_fit(problem.targets[:, back], on_back)
    for number, (digit, (mean, spread)) in enumerate(_USUAL_ARCHES.items()):
        first, base = bones_of(digit)[0], CARPUS * problem.shape.knuckles[DIGITS.index(digit)]
        on_bone = weights[:, first].copy()
        knuckle = int(np.minimum(weights[:, PALM], on_bone).argmax())
        on_bone[knuckle] = 0.0
        outer = int(on_bone.argmax())
        seen = problem.present[:, [knuckle, outer]].all(axis=1) & problem.present[:, back].all(axis=1)
        if min(weights[knuckle, [PALM, first]]) <= _KNUCKLE_WEIGHT or on_bone[outer] < 0.5 or not seen.any():
            continue
        ends = np.einsum("tij,tmj->tmi", turns, problem.targets[:, [knuckle, outer]]) + shifts[:, None]
        links = ends[:, 0] - base, ends[:, 1] - ends[:, 0]
        flexions = [np.arctan2(-link[:, 2], link[:, 0])[seen] for link in links]
        metacarpal, bone = (flexion - flexion.mean() for flexion in flexions)
        slope = (bone @ metacarpal) / max(float(bone @ bone), 1e-12)
        scatter = (metacarpal - slope * bone).var() + _LEAST_FLEXION_NOISE**2
        precision = min(_INDEPENDENT_ARCH_FRAMES, len(bone)) * bone.var() / scatter
        share = (precision * slope + mean / spread**2) / (precision + spread**-2)
        share = np.clip(share, 0.0, _MOST_ARCH_SHARE)
        arch[number] = share / (1.0 - share)
    problem.shape = dataclasses.replace(problem.shape, arch=arch)


def _learned_spread(squares: Doubles, variances: Doubles, axes: int, spread: float, usual: float) -> float:
    """Estimate a spread [m] of offsets, given their squares and posterior variances, summed over axes."""
    determined = np.clip(axes - variances / spread**2, 0.0, None).sum()
    total, usual_count = squares.sum() + _USUAL_SPREAD_COORDINATES * usual**2, _USUAL_SPREAD_COORDINATES
    return float(np.sqrt(total / (determined + usual_count)))


def standard_errors(
    problem: Problem, estimate: Estimate, fit: Fit, covariance: Float[np.ndarray, "S S"]
) -> tuple[Doubles, Doubles]:
    """Standard errors of marker positions on their bones (M,) and of bone lengths (5, 3) [m]."""
    # The wrist's position in the palm is a convention, so errors of the palm's markers are relative to the
    # knuckles.
    weights = skin_weights(estimate.coordinates)
    bones, patch = weights.argmax(axis=1), SkinPatch(estimate.coordinates.faces)

    def on_bones(shapes: list[HandShape]) -> Doubles:
        local, knuckles = [], fit.model.skeleton.offsets[1::3]
        for shape, vertices in zip(shapes, rest_vertices(shapes), strict=True):
            skeleton = build_skeleton(shape)
            rest = skeleton.rest_transforms()[bones]
            points = skin_points(estimate.coordinates, patch.corners(vertices))[0]
            rotation, translation = rigid_fit(skeleton.offsets[1::3], knuckles)
            among_knuckles = points @ rotation.T + translation
            on_bone = np.einsum("mji,mj->mi", rest[:, :3, :3], points - rest[:, :3, 3])
            local.append(np.where((bones == PALM)[:, None], among_knuckles, on_bone))
        return np.array(local)

    count = len(bones)
    jacobian = np.zeros((count, 3, len(covariance)))
    jacobian[..., :NUM_PARAMETERS] = shape_jacobian(problem.shape, estimate.parameters, on_bones)
    by_place = jacobian[..., NUM_PARAMETERS:].reshape(count, 3, count, 3)
    by_place[range(count), :, range(count)] = fit.model.rest_transforms[bones, :3, :3].swapaxes(1, 2)
    positions = np.sqrt(np.einsum("mis,st,mit->m", jacobian, covariance, jacobian, optimize=True))
    variances = covariance[BONE_LENGTHS, BONE_LENGTHS].diagonal()
    variances = variances + covariance[LENGTH, LENGTH] + 2.0 * covariance[BONE_LENGTHS, LENGTH]
    return positions, fit.model.shape.bone_lengths * np.sqrt(variances).reshape(5, 3)


def remaining_errors(
    problem: Problem, estimate: Estimate, covariance: Float[np.ndarray, "S S"], hand: GloveFit
) -> HandErrors:
    """The largest independent errors of a calibrated hand, from the covariance of its shared unknowns."""
    patch = SkinPatch(estimate.coordinates.faces)
    before = euler_matrix(shape_at(problem.shape, estimate.parameters).base_angles).swapaxes(1, 2)

    def described(shapes: list[HandShape]) -> Doubles:
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
    scales = np.append(np.tile(np.repeat([1.0, _TURN_LEVER, _LENGTH_LEVER], 3), len(DIGITS)), np.ones(count))
    jacobian *= scales[:, None]
    variances, directions = np.linalg.eigh(jacobian @ covariance @ jacobian.T)
    kept = directions * np.sqrt(np.maximum(variances, 0.0)) / scales[:, None]
    kept = kept[:, : -_KEPT_ERRORS - 1 : -1]
    numbers = kept[:-count].reshape(len(DIGITS), 3, 3, -1)
    motions = kept[-count:].reshape(-1, 3, kept.shape[1])
    if hand.side == "left":  # A mirrored rotation has the opposite sense.
        mirror = np.diag(MIRROR)[:, None]
        numbers, motions = numbers * np.stack([mirror, -mirror, np.ones((3, 1))]), motions * mirror
    return errors_of_motions(hand, np.pad(numbers.reshape(-1, kept.shape[1]), ((0, 1), (0, 0))), motions)


def contact_gaps(model: HandModel, touches: list[tuple[int, str]], qpos: Doubles) -> Doubles:
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
        if covered < _LEAST_RANGE_SHARE * (ranges[joint, 1] - ranges[joint, 0]):
            still.append(JOINT_NAMES[joint])
    return tuple(still)
