"""`Bundle`: clock, lens and poses of a camera, adjusted to keypoints and outlines of hands in its video."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gloves.takes.take import Take
from handsim.hand.shape import NUM_KEYPOINTS, SIDES
from handsim.space.camera import Camera, brown_lens, camera_matrix
from handsim.space.transforms import rigid
from render.frames import Doubles, Integers

if TYPE_CHECKING:
    from film.detector import FoundHand

_MAX_GAP: Final = 0.1  # [s] longest gap of a take over which poses are interpolated
FEWEST_KEYPOINTS: Final = 8  # least number of keypoints of a detected hand
_LEAST_SCORE: Final = 0.25  # least score of a keypoint that is used
_MOST_KEYPOINTS: Final = 5000  # largest number of keypoints in a bundle
_ROBUST_SCALE: Final = 2.0  # [standard deviations] scale of the Cauchy weights of residuals
_WEAK_INFORMATION: Final = 1e-2  # prior information on free unknowns
_JACKKNIFE_PARTS: Final = 8  # number of parts of a video, each of which is held out once
_DIFFERENCE_STEP: Final = 1e-6  # [s], [rad] step of the finite differences by time and by rotations
_SAMPLES_PER_ERROR: Final = 16.0  # number of samples that share one independent error

# Indices of the unknowns in a state's values. From POSES on, each span has six numbers for its camera's pose.
# _PRIORS holds the standard deviation of each unknown before any picture is seen. THICKNESS is how much
# thicker the filmed hands are than the tracked ones [m], because of cloth or an error of a measured hand, and
# SIZE is the share by which they are larger.
OFFSET, DRIFT, FOCAL, THICKNESS, SIZE, POSES = 0, 1, 2, 7, 8, 11
CENTER, _LENS, READOUT = slice(3, 5), slice(5, 7), slice(9, 11)
USUAL_CENTER: Final = 0.01  # [widths] standard deviation of lens centers from the middle of the picture
_PRIORS: Final = np.array(
    [np.inf, 1e-4, 0.7, USUAL_CENTER, USUAL_CENTER, 0.05, 0.05, 0.0007, 0.02, 0.015, 0.015]
)


class FoundFrame(NamedTuple):
    """A frame of a video, and the hands that a detector found in it."""

    time: float  # time in the video [s]
    hands: Sequence[FoundHand] | None  # None where the detector did not run


class Detections(NamedTuple):
    """The detections of a video that have enough keypoints: D hands in F frames."""

    times: Doubles  # times (F,) of the frames in the video [s]
    searched: Integers  # nearest frame (F,) that the detector searched
    frames: Integers  # frame (D,) of each hand
    sides: Integers  # side (D,) of each hand, an index of `SIDES`
    pixels: Doubles  # keypoints (D, 21, 2) [px]
    weights: Doubles  # weights (D, 21) of the keypoints; 0 where the score is low

    @classmethod
    def of(cls, searched_frames: Sequence[FoundFrame]) -> Detections:
        """Collect the detections in all frames of a video."""
        searched = np.array([index for index, frame in enumerate(searched_frames) if frame.hands is not None])
        between = np.searchsorted(0.5 * (searched[1:] + searched[:-1]), np.arange(len(searched_frames)))
        hands = [
            (index, hand)
            for index, frame in enumerate(searched_frames)
            for hand in frame.hands or ()
            if (hand.scores >= _LEAST_SCORE).sum() >= FEWEST_KEYPOINTS
        ]
        scores = np.array([hand.scores for _, hand in hands], dtype=np.float64).reshape(-1, NUM_KEYPOINTS)
        return cls(
            np.array([frame.time for frame in searched_frames]),
            searched[between],
            np.array([index for index, _ in hands], dtype=np.int64),
            np.array([SIDES.index(hand.side) for _, hand in hands], dtype=np.int64),
            np.array([hand.keypoints for _, hand in hands], dtype=np.float64).reshape(-1, NUM_KEYPOINTS, 2),
            np.where(scores >= _LEAST_SCORE, np.sqrt(np.clip(scores, 0.0, 1.0)), 0.0),
        )


class State(NamedTuple):
    """An estimate of a camera and its clock."""

    values: Doubles  # values of the unknowns
    starts: tuple[int, ...] = (0,)  # first frame of each span in which the camera did not move

    def spans(self, frames: Integers) -> Integers:
        """Number of the span of each frame."""
        return np.searchsorted(self.starts, frames, side="right") - 1

    def pose(self, span: int) -> Doubles:
        """The camera's rotation vector [rad] and position [m] in a span, (6,)."""
        return self.values[POSES + 6 * span :][:6]


class Matches(NamedTuple):
    """Which detection shows each hand of the take in each frame."""

    numbers: Integers  # index (F, H) of the detection, -1 for none
    distances: Doubles  # median distance (F, H) of its keypoints from the take's [px]
    errors: Doubles  # its keypoints minus the take's (F, H, 21, 2) [px]; NaN where the score is low


class Samples(NamedTuple):
    """Points of hands, and the picture lines that show them: two lines for a keypoint, one for an outline."""

    frames: Integers  # frame (N,) of each line
    pixels: Doubles  # a point (N, 2) of each line [px]
    normals: Doubles  # normals (N, 2) of the lines, whose lengths are their weights
    outward: Doubles  # unit directions (N, 3) in which a thicker hand moves the points
    from_middle: Doubles  # offsets (N, 3) of the points from the hand's middle [m]
    points_at: Callable[[Doubles], Doubles]
    """Returns the points (N, 3) [m] at given times (N,) of the take [s]."""


class Bundle:
    """Bundle adjustment of a camera's clock, lens and poses to keypoints and outlines in its pictures.

    The lens is fixed if a camera with the lens of the video's is known.
    """

    def __init__(
        self, take: Take, detections: Detections, size: tuple[int, int], known_camera: Camera | None
    ) -> None:
        self.take, self.detections, self.size, self.known_camera = take, detections, size, known_camera
        self._points, self._middle = take.keypoints(), float(np.median(detections.times))

    def keypoints(self, times: Doubles, *which: Integers) -> Doubles:
        """Keypoints (N, H, 21, 3) [m] at times of the take; NaN where it has none.

        Given indices (N,) of hands and of keypoints, the result has only these keypoints: (N, 3).
        """
        known = self.take.times
        index = np.interp(times, known, np.arange(len(known)), np.nan, np.nan)
        before = np.nan_to_num(index).astype(np.int64)
        after = np.minimum(before + 1, len(known) - 1)
        share = np.where(known[after] - known[before] > _MAX_GAP, np.nan, index - before)
        first, second = self._points[before, *which], self._points[after, *which]
        return np.asarray(first + share.reshape(-1, *(first.ndim - 1) * [1]) * (second - first))

    def clock(self, state: State) -> tuple[float, float]:
        """Offset [s] and drift of the take's clock relative to the video's."""
        offset, drift = state.values[[OFFSET, DRIFT]].tolist()
        return offset - drift * self._middle, drift

    def times(self, state: State) -> Doubles:
        """Times (F,) of the frames by the take's clock [s]."""
        offset, drift = self.clock(state)
        return offset + (1.0 + drift) * self.detections.times

    def cameras(self, state: State) -> list[Camera]:
        """The camera of each span."""
        camera, cameras = self.known_camera, []
        if camera is None:
            focal = self.size[0] * np.exp(state.values[FOCAL])
            center = 0.5 * np.array(self.size) + self.size[0] * state.values[CENTER]
            lens = brown_lens(*state.values[_LENS], 0.0, 0.0, 0.0)
            camera = Camera("film", self.size, camera_matrix(focal, focal, *center), lens=lens)
        for span in range(len(state.starts)):
            vector, name = state.pose(span), f"film{span + 1}" if span else "film"
            pose = rigid(Rotation.from_rotvec(vector[:3]).as_matrix(), vector[3:])
            cameras.append(dataclasses.replace(camera, name=name, T_world_camera=pose))
        return cameras

    def project(self, state: State, frames: Integers, points: Doubles) -> Doubles:
        """Project points (N, ..., 3) [m] in frames (N,) to pixels (N, ..., 2); NaN stays NaN."""
        pixels, spans = np.empty((*points.shape[:-1], 2)), state.spans(frames)
        for span, camera in enumerate(self.cameras(state)):
            pixels[spans == span] = camera.project(points[spans == span])
        return pixels

    def projected_keypoints(self, state: State) -> Doubles:
        """Project the take's keypoints in each frame to pixels (F, H, 21, 2); NaN without a hand."""
        times = self.times(state)
        return self.project(state, np.arange(len(times)), self.keypoints(times))

    def match(self, state: State, gate: float) -> Matches:
        """Match each hand of the take to the nearest detection within a median distance [px]."""
        detections, pixels = self.detections, self.projected_keypoints(state)
        errors = detections.pixels[:, None] - pixels[detections.frames]  # (D, H, 21, 2)
        distances = np.nan_to_num(np.linalg.norm(errors, axis=-1), nan=np.inf)
        unsure = np.broadcast_to((detections.weights == 0.0)[:, None], distances.shape)
        errors[unsure] = distances[unsure] = np.nan
        distances = np.nanmedian(distances, axis=-1)  # (D, H)
        hand, nearest = distances.argmin(axis=1), distances.min(axis=1)
        order = np.argsort(-nearest, kind="stable")
        order = order[nearest[order] < gate]
        at = detections.frames[order], hand[order]  # the nearest comes last and overwrites the others
        matches = Matches(
            np.full(pixels.shape[:2], -1), np.full(pixels.shape[:2], np.nan), np.full(pixels.shape, np.nan)
        )
        matches.numbers[at], matches.distances[at] = order, nearest[order]
        matches.errors[at] = errors[order, hand[order]]
        return matches

    def samples(self, matches: Matches) -> Samples:
        """Sample the keypoints of matched hands, at most about `_MOST_KEYPOINTS` of them."""
        frames, hands, keypoints = np.nonzero(np.isfinite(matches.errors[..., 0]))
        kept = matches.numbers[frames, hands] % (1 + len(frames) // _MOST_KEYPOINTS) == 0
        frames, hands, keypoints = (np.repeat(one[kept], 2) for one in (frames, hands, keypoints))
        which = matches.numbers[frames, hands], keypoints
        normals = np.tile(np.eye(2), (len(frames) // 2, 1)) * self.detections.weights[which][:, None]
        zeros, pixels = np.zeros((len(frames), 3)), self.detections.pixels[which]
        return Samples(
            frames, pixels, normals, zeros, zeros, lambda times: self.keypoints(times, hands, keypoints)
        )

    def solve(
        self, state: State, samples: Samples, noise: float, *, first: bool = False
    ) -> tuple[State, float, Doubles]:
        """Adjust a state to samples; return it with its cost per sample and its covariance.

        Samples of weight 1 have the standard deviation `noise` [px]. Samples with large residuals at the
        start have less weight. If `first`, the lens and the size of the hands are kept.
        """
        size, count = len(state.values), len(samples.frames)
        free = np.ones(size, dtype=bool)
        free[FOCAL:THICKNESS] = self.known_camera is None
        if first:
            free[DRIFT] = free[CENTER] = free[_LENS] = free[THICKNESS] = free[SIZE] = free[READOUT] = False
        priors = np.concatenate([_PRIORS, np.full(size - POSES, np.inf)])
        robust = 1.0 / np.sqrt(1.0 + (self.residuals(state, samples, noise) / _ROBUST_SCALE) ** 2)

        def with_free(part: Doubles) -> State:
            values = state.values.copy()
            values[free] = part
            return state._replace(values=values)

        prior_weights = np.sqrt(_SAMPLES_PER_ERROR) / priors

        def weighted_residuals(part: Doubles) -> Doubles:
            now = with_free(part)
            return np.concatenate([robust * self.residuals(now, samples, noise), prior_weights * now.values])

        def weighted_jacobian(part: Doubles) -> Doubles:
            weighted = robust[:, None] * self.jacobian(with_free(part), samples, noise)
            return np.concatenate([weighted, np.diag(prior_weights)])[:, free]

        scales = np.where(np.isfinite(priors), priors, 0.1)[free]
        limits = {"max_nfev": 40, "xtol": 1e-6, "ftol": 1e-6}
        solved = least_squares(
            weighted_residuals, state.values[free], weighted_jacobian, x_scale=scales, **limits
        )
        covariance = np.zeros((size, size))
        # An unknown without any information gets a standard deviation of 40 s, m or rad.
        inverse = np.linalg.inv(solved.jac.T @ solved.jac + _WEAK_INFORMATION * np.eye(len(solved.x)))
        covariance[np.ix_(free, free)] = _SAMPLES_PER_ERROR * inverse
        return with_free(solved.x), 2.0 * float(solved.cost) / max(count, 1), covariance

    def jackknife(self, state: State, samples: Samples, noise: float) -> tuple[Doubles, float]:
        """Standard deviations of the unknowns from solutions that each leave out one part of the video.

        Unlike the covariance, this jackknife notices errors that are correlated over time. The second value
        is the largest median residual [px] of a part in the solution without it.
        """
        ends = np.quantile(samples.frames, np.linspace(0.0, 1.0, _JACKKNIFE_PARTS + 1)[1:-1])
        parts, worst_residual, solutions = np.searchsorted(ends, samples.frames), 0.0, []
        for part in range(_JACKKNIFE_PARTS):
            out = parts == part
            kept = samples._replace(normals=np.where(out[:, None], 0.0, samples.normals))
            solution = self.solve(state, kept, noise)[0]
            if out.any():
                residual = float(np.median(np.abs(self.residuals(solution, samples, 1.0)[out])))
                worst_residual = max(worst_residual, residual)
            solutions.append(solution.values)
        return np.std(solutions, axis=0) * np.sqrt(_JACKKNIFE_PARTS - 1), worst_residual

    def jacobian(self, state: State, samples: Samples, noise: float) -> Doubles:
        """Derivatives (N, U) of the residuals by all unknowns; those by a known lens are not used."""
        cameras, spans = self.cameras(state), state.spans(samples.frames)
        points, later = (self._points_of(state, samples, late) for late in (0.0, _DIFFERENCE_STEP))
        poses, lens = np.stack([one.T_world_camera for one in cameras])[spans], cameras[0].lens
        axes, offsets, across = poses[:, :3, :3], points - poses[:, :3, 3], samples.normals / noise
        local, focal = np.einsum("nij,ni->nj", axes, offsets), across * cameras[0].focal_lengths
        flat = local[:, :2] / local[:, 2:]
        by_aside = np.einsum("ni,nij->nj", focal, lens.jacobian(local)) / local[:, 2:]
        by_local = np.column_stack([by_aside, -(by_aside * flat).sum(axis=1)])
        by_point, by_pose = np.einsum("nij,nj->ni", axes, by_local), np.zeros((len(points), len(cameras), 6))
        for span in range(len(cameras)):
            vector, rows = state.pose(span)[:3], spans == span
            moved = Rotation.from_rotvec(vector + _DIFFERENCE_STEP * np.eye(3))
            rotated = (moved * Rotation.from_rotvec(vector).inv()).as_rotvec().T
            by_pose[rows, span, :3] = np.cross(by_point[rows], offsets[rows]) @ rotated / _DIFFERENCE_STEP
            by_pose[rows, span, 3:] = -by_point[rows]
        by_time, square = ((later - points) * by_point).sum(axis=1) / _DIFFERENCE_STEP, (flat**2).sum(axis=1)
        by_first_coefficient = (focal * flat).sum(axis=1) * square
        elapsed = self.detections.times[samples.frames] - self._middle
        derivatives = np.column_stack([
            by_time, by_time * elapsed, (focal * lens.distort(local)).sum(axis=1), self.size[0] * across,
            by_first_coefficient, by_first_coefficient * square, (by_point * samples.outward).sum(axis=1),
            (by_point * samples.from_middle).sum(axis=1),
            by_time[:, None] * (samples.pixels / self.size - 0.5),
            by_pose.reshape(len(points), 6 * len(cameras)),
        ])  # fmt: skip
        return np.where(np.isfinite(derivatives).all(axis=1, keepdims=True), derivatives, 0.0)

    def _points_of(self, state: State, samples: Samples, late: float = 0.0) -> Doubles:
        """The samples' points (N, 3) [m] at the times when the shutter reads them, plus `late` [s]."""
        times = self.times(state)[samples.frames] + (samples.pixels / self.size - 0.5) @ state.values[READOUT]
        shift = state.values[THICKNESS] * samples.outward + state.values[SIZE] * samples.from_middle
        return np.asarray(samples.points_at(times + late) + shift)

    def residuals(self, state: State, samples: Samples, noise: float) -> Doubles:
        """Distances (N,) of the points from their lines, over the noise; 0 where the take has no pose."""
        points = self._points_of(state, samples)
        pixels = self.project(state, samples.frames, points)
        residuals = ((pixels - samples.pixels) * samples.normals).sum(axis=1) / noise
        residuals = np.nan_to_num(residuals, nan=self.size[0] / noise)  # behind the camera
        return np.where(np.isfinite(points[:, 0]), residuals, 0.0)
