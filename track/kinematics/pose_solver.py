"""Pose from labeled markers: Levenberg-Marquardt on the paper's E_IK (Han et al. 2018, section 4.3).

Frames are solved one by one, each from its own start; a missing marker is NaN. Two terms decide what markers
leave open: a hinge beyond its range is pulled back, and a digit that lacks a marker, or never had three, is
drawn towards rest, weakly, and towards a predicted pose where one is given.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numba
import numpy as np

from gloves.fit import GloveFit
from handsim._checks import check_array
from handsim.errors import ArgumentError
from handsim.hand.topology import DIGITS, NUM_JOINTS, NUM_QPOS
from track.kinematics.joint_prior import HingeBelief
from track.kinematics.levenberg_marquardt import MARKER_NOISE, descend, find_misses
from track.kinematics.marker_kinematics import NUM_UNKNOWNS, HandArrays, hand_arrays, workspace
from track.kinematics.marker_prediction import Expectation, carry_markers, expect_markers, expectation
from track.kinematics.starting_poses import RESTING, StartingShapes, lay_shapes, starting_shapes

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy.typing import ArrayLike, NDArray

_REST_PULL: Final = np.deg2rad(90.0) ** -2  # [1/rad^2] of a hinge around rest
_WHISPER: Final = 1e-4  # what is left of it for a digit whose markers are all there
_FEWEST_ON_A_PART: Final = 3  # that tell a digit's four hinges also when it is straight, or a palm's place
FEWEST_MARKERS: Final = 4
"""Markers without which no pose is solved."""
_EASING: Final = (1 / 64, 1 / 8, 1.0)  # of the tightness of a robust loss, so that a start may be far off
_EASY_STEPS: Final = 8
_MOST_STEPS: Final = 30
_NO_WRIST: Final = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0])  # a pose, and no trust in it
_GOOD: Final = 0.0005  # [m] RMS, limits and prior included, from which on no further start is tried


@dataclass(frozen=True, slots=True, eq=False)
class PoseFit:
    """Poses and how well they fit."""

    qpos: Float[np.ndarray, "T 27"]
    rms: Float[np.ndarray, "T"]
    """3D RMS distance over the markers that are there [m]."""
    residuals: Float[np.ndarray, "T M 3"]
    """Model minus marker [m], NaN where a marker is missing."""
    iterations: Int[np.ndarray, "T"]
    """Steps tried, over all starts of a frame."""


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Where hinges are thought to be; it counts for digits that lack a marker or never had three."""

    angles: Float[np.ndarray, "*T 20"]
    """Angles [rad], for each frame or for all."""
    spread: ArrayLike
    """Their standard deviation [rad]: one number, or an array that goes with the angles."""


class PoseSolver:
    """Solves poses of one hand in one glove; what can be prepared is.

    Args:
        fit: The hand in its glove.
        outlier_distance: Distance [m] from which a marker loses its say (Geman and McClure 1987), so that a
            wrong label does not bend the hand; not given, every marker keeps its say. It wants a good start.

    Raises:
        ArgumentError: `outlier_distance` is not positive.
    """

    def __init__(self, fit: GloveFit, *, outlier_distance: float | None = None) -> None:
        if outlier_distance is not None and not outlier_distance > 0.0:
            raise ArgumentError(f"outlier_distance is {outlier_distance:g} m, expected a positive distance")
        self.hand: HandArrays = hand_arrays(fit)
        """What poses are solved with; whoever moves its markers finds them moved."""
        self._shapes: StartingShapes = starting_shapes(fit)
        self._tightness = 0.0 if outlier_distance is None else outlier_distance**-2
        parts = (*range(len(DIGITS)), -1)  # the palm last
        self._on_part = np.array([(self.hand.digits == number).sum() for number in parts])

    def solve(
        self,
        targets: Float[np.ndarray, "T M 3"],
        initial: Float[np.ndarray, "T 27"] | None = None,
        *,
        prediction: Prediction | None = None,
        iterations: int = _MOST_STEPS,
    ) -> PoseFit:
        """Poses whose markers come nearest to labeled ones, each frame by itself.

        Args:
            targets: Labeled markers in the glove's order [m]; NaN where missing.
            initial: Poses to start from; a hand put together from a few shapes when not given, and where that
                does not end within 0.5 mm RMS, each of those shapes, of which the best is kept.
            prediction: Where the hinges are thought to be.
            iterations: Steps at most from each start.

        Raises:
            ArgumentError: `targets`, `initial` or `prediction` do not fit the glove or each other, or a frame
                has fewer than 4 markers.
        """
        # Copies, because a kernel is compiled anew for arrays that are read-only or not contiguous.
        targets = np.array(targets, dtype=np.float64, order="C")
        if targets.ndim != 3 or targets.shape[1:] != self._shapes.markers.shape[1:]:
            raise ArgumentError(
                f"targets have shape {targets.shape}, expected (T, {self._shapes.markers.shape[1]}, 3)"
            )
        starts = np.empty((0, NUM_QPOS))
        if initial is not None:
            starts = np.array(check_array("initial", initial, (None, NUM_QPOS)), order="C")
            if starts.shape != (len(targets), NUM_QPOS):
                raise ArgumentError(
                    f"initial has shape {starts.shape}, expected ({len(targets)}, {NUM_QPOS})"
                )
        angles, trust = _rows(prediction, len(targets))
        wrong, fit = self._run(targets, starts, angles, trust, _NO_WRIST, iterations)
        if wrong >= 0:
            there = int(np.isfinite(targets[wrong]).all(axis=-1).sum())
            if there < FEWEST_MARKERS:
                raise ArgumentError(f"frame {wrong} has {there} markers, expected at least {FEWEST_MARKERS}")
            raise ArgumentError(
                f"initial has a quaternion of length zero in frame {wrong}, expected an orientation"
            )
        return fit

    def follow(
        self,
        target: Float[np.ndarray, "M 3"],
        start: Float[np.ndarray, "27"],
        angles: Float[np.ndarray, "20"],
        spread: Float[np.ndarray, "20"],
        wrist: Float[np.ndarray, "7"],
        wrist_spread: tuple[float, float],
    ) -> PoseFit:
        """`solve` for one frame from a start near by, with nothing checked: for loops that run all the time.

        Args:
            target: Labeled markers [m], four at least; NaN where missing.
            start: A pose near theirs.
            angles: See `Prediction`.
            spread: See `Prediction`.
            wrist: Where the wrist is thought to be, place [m] and orientation; that counts where the palm
                lacks a marker or never had three.
            wrist_spread: Standard deviations of its place [m] and orientation [rad].
        """
        trust = np.concatenate([wrist, np.array(wrist_spread) ** -2.0])
        return self._run(target[None], start[None], angles[None], spread[None] ** -2.0, trust, _MOST_STEPS)[1]

    def _run(
        self,
        targets: NDArray[np.float64],
        starts: NDArray[np.float64],
        angles: NDArray[np.float64],
        trust: NDArray[np.float64],
        wrist: NDArray[np.float64],
        iterations: int,
    ) -> tuple[int, PoseFit]:
        """First frame that cannot be solved (or -1), and the fits."""
        wrong, *arrays = _fit_frames(
            self.hand,
            self._shapes,
            self._on_part,
            targets,
            starts,
            angles,
            trust,
            wrist,
            self._tightness,
            iterations,
        )
        return wrong, PoseFit(*arrays)

    def place(self, qpos: Float[np.ndarray, "27"]) -> Float[np.ndarray, "M 3"]:
        """Where a pose has its markers [m]."""
        places = np.empty((len(self.hand.digits), 3))
        carry_markers(self.hand, np.array(qpos, dtype=np.float64), places)
        return places

    def expect(
        self,
        qpos: Float[np.ndarray, "27"],
        target: Float[np.ndarray, "M 3"],
        belief: HingeBelief,
        *,
        wrist_spread: tuple[float, float],
        variance: Float[np.ndarray, "M"],
        noise: float,
    ) -> Expectation:
        """Where a fitted pose has its markers, and how far they may be from there; see `expect_markers`."""
        expected = expectation(len(self.hand.digits))
        expect_markers(
            self.hand, self._on_part, qpos, target, belief, wrist_spread, variance, noise, expected
        )
        return expected


def solve_poses(
    fit: GloveFit,
    targets: Float[np.ndarray, "T M 3"],
    *,
    initial: Float[np.ndarray, "T 27"] | None = None,
    iterations: int = _MOST_STEPS,
) -> PoseFit:
    """`PoseSolver.solve` for one use of a hand and its glove."""
    return PoseSolver(fit).solve(targets, initial, iterations=iterations)


def _rows(prediction: Prediction | None, frames: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Predicted angles and the pull towards them, a row a frame or none."""
    if prediction is None:
        return np.empty((0, NUM_JOINTS)), np.empty((0, NUM_JOINTS))
    spread = np.asarray(prediction.spread, dtype=np.float64)
    if not (spread > 0.0).all():
        raise ArgumentError(f"prediction.spread is {spread.min():g} rad, expected positive angles")
    angles = check_array("prediction.angles", prediction.angles, (NUM_JOINTS,))
    try:
        return (
            np.array(np.broadcast_to(angles, (frames, NUM_JOINTS)), order="C"),
            np.array(np.broadcast_to(spread**-2, (frames, NUM_JOINTS)), order="C"),
        )
    except ValueError:
        raise ArgumentError(
            f"prediction has angles of shape {angles.shape} and spread of shape {spread.shape}, "
            f"expected what goes with ({frames}, {NUM_JOINTS})"
        ) from None


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _fit_frames(
    hand: Any,
    shapes: Any,
    on_part: Any,
    targets: Any,
    initial: Any,
    predicted: Any,
    trust: Any,
    wrist: Any,
    tightness: Any,
    iterations: Any,
) -> Any:
    """First frame that cannot be solved (or -1), poses, RMS, residuals, steps."""
    frames, count = targets.shape[:2]
    qpos, residuals = np.empty((frames, NUM_QPOS)), np.empty((frames, count, 3))
    rms, steps = np.zeros(frames), np.zeros(frames, dtype=np.int64)
    center, pull, seen = np.empty(NUM_QPOS), np.empty(NUM_UNKNOWNS), np.empty(len(on_part), dtype=np.int64)
    work, pose, target = workspace(count), np.empty(NUM_QPOS), np.empty((count, 3))
    for frame in range(frames):
        there = _read_markers(hand.digits, targets[frame], target, seen)
        if there < FEWEST_MARKERS:
            return frame, qpos, rms, residuals, steps
        _set_prior(seen, on_part, predicted[frame:], trust[frame:], wrist, center, pull)
        if len(initial) > 0:
            starts = initial[frame : frame + 1].copy()
            length = np.sqrt((starts[0, 3:7] ** 2).sum())
            if not length > 0.0:
                return frame, qpos, rms, residuals, steps
            starts[0, 3:7] /= length
        else:
            starts = lay_shapes(shapes, hand.digits, target)
        least = np.inf
        qpos[frame] = starts[0]
        for number in range(len(starts)):
            pose[:] = starts[number]
            cost = np.inf
            for part in _EASING:
                if tightness == 0.0 and part < 1.0:
                    continue
                most = iterations if part == 1.0 else min(iterations, _EASY_STEPS)
                cost, tried = descend(hand, target, pose, center, pull, part * tightness, most, work)
                steps[frame] += tried
            if cost < least:
                least = cost
                qpos[frame] = pose
            if least < there * (_GOOD / MARKER_NOISE) ** 2:
                break
        rms[frame] = _write_residuals(hand, target, qpos[frame], work, residuals[frame])
    return -1, qpos, rms, residuals, steps


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _read_markers(digits: Any, given: Any, target: Any, seen: Any) -> Any:
    """Copy one frame's markers, each whole or NaN; count them, and those on each digit and the palm."""
    seen[:] = 0
    there = 0
    for marker in range(len(given)):
        if np.isfinite(given[marker, 0] + given[marker, 1] + given[marker, 2]):
            target[marker] = given[marker]
            there += 1
            seen[digits[marker]] += 1
        else:
            target[marker] = np.nan
    return there


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _set_prior(
    seen: Any, on_part: Any, predicted: Any, trust: Any, wrist: Any, center: Any, pull: Any
) -> None:
    """Where this frame's pose is drawn to and how strongly; `predicted` and `trust` begin with its row."""
    center[:7] = wrist[:7]
    vague = seen[-1] < max(on_part[-1], _FEWEST_ON_A_PART)
    pull[NUM_JOINTS : NUM_JOINTS + 3] = wrist[7] if vague else 0.0
    pull[NUM_JOINTS + 3 :] = wrist[8] if vague else 0.0
    for hinge in range(NUM_JOINTS):
        digit = hinge // 4
        whole = seen[digit] == on_part[digit] and seen[digit] >= _FEWEST_ON_A_PART
        rest, weight = RESTING[hinge], _REST_PULL * (_WHISPER if whole else 1.0)
        if len(predicted) > 0 and not whole:
            both = weight + trust[0, hinge]
            rest += (predicted[0, hinge] - rest) * trust[0, hinge] / both
            weight = both
        center[7 + hinge], pull[hinge] = rest, weight


@numba.njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _write_residuals(hand: Any, target: Any, pose: Any, work: Any, residuals: Any) -> Any:
    """Misses as the world sees them; returns their RMS."""
    find_misses(hand, target, pose, work)
    w, x, y, z = pose[3:7]
    total, there = 0.0, 0
    for marker in range(len(target)):
        a, b, c = work.misses[marker]
        i, j, k = y * c - z * b, z * a - x * c, x * b - y * a
        residuals[marker, 0] = a + 2.0 * (w * i + y * k - z * j)
        residuals[marker, 1] = b + 2.0 * (w * j + z * i - x * k)
        residuals[marker, 2] = c + 2.0 * (w * k + x * j - y * i)
        if not np.isnan(a):
            there += 1
            total += a * a + b * b + c * c
    return np.sqrt(total / there)
