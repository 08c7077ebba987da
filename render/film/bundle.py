"""`Bundle`: clock, lens and poses of a camera, adjusted to keypoints and outlines of hands in its video."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gloves.takes.take import Take
from handsim.hand.shape import NUM_KEYPOINTS, SIDES
from handsim.space.camera import Camera, brown_lens, camera_matrix
from handsim.space.transforms import rigid
from render.frames import Doubles, Flags, Integers

if TYPE_CHECKING:
    from render.film.detector import FoundHand

_MAX_GAP: Final = 0.1  # [s] Poses are interpolated over gaps up to this length.
FEWEST_KEYPOINTS: Final = 8  # A hand in a frame is judged by this many keypoints.
_SURE: Final = 0.25  # Keypoints with a lower score are not used.
MOST_BUNDLED: Final = 5000  # largest number of keypoints in a bundle
_ROBUST: Final = 2.0  # Residuals beyond this many standard deviations count less.
_BLOCK: Final = 0.5  # [s] Residuals within this time count as dependent.
_SHARED: Final = 2.0  # Errors of outlines have common causes: in drawn videos they were twice the deviations.
_NOTHING: Final = 1e-2  # prior information on free unknowns: a deviation of 10 s, m or rad
_REGION: Final = 0.0004  # [m] standard deviation of how much thicker a region of the hand is
_DEPENDENT: Final = 16.0  # This many samples count as one with an independent error.

# The unknowns, before six of the pose of each span, and the standard deviation that each has beforehand. The
# last is how much thicker than the tracked hands the filmed ones are [m]: cloth, or a measured hand's error.
OFFSET, DRIFT, READOUT, FOCAL, _CENTER, _LENS, THICKER, POSES = 0, 1, 2, 3, 4, 6, 8, 9
_PRIORS: Final = np.array([np.inf, 1e-4, 0.015, 0.7, 0.005, 0.005, 0.05, 0.05, 0.0007])


class FoundFrame(NamedTuple):
    """The hands that a detector found in a frame of a video."""

    number: int
    time: float
    """In the video [s]."""
    hands: Sequence[FoundHand]


class Motion:
    """Keypoints of a take's hands at any time."""

    def __init__(self, take: Take) -> None:
        self.times, self.num_hands = take.times, len(take.hands)
        self._points = take.keypoints()
        self.sides = np.array([SIDES.index(side) for side in take.sides])

    def at(self, times: Doubles) -> tuple[Doubles, Doubles]:
        """Keypoints (N, H, 21, 3) [m] and their velocities [m/s]; NaN where the take has none."""
        before = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, max(len(self.times) - 2, 0))
        after = np.minimum(before + 1, len(self.times) - 1)
        step = self.times[after] - self.times[before]
        gap = (step > _MAX_GAP) | (times < self.times[0]) | (times > self.times[-1])
        step = np.where(gap | (step <= 0.0), np.nan, step)[:, None, None, None]
        first = self._points[before]
        velocities = (self._points[after] - first) / step
        return first + velocities * (times - self.times[before])[:, None, None, None], velocities


class Detections(NamedTuple):
    """All detections of a video: D hands in F frames."""

    times: Doubles
    """(F,)."""
    frames: Integers
    """(D,)."""
    sides: Integers
    """(D,), as in `SIDES`."""
    confidence: Doubles
    """(D,)."""
    pixels: Doubles
    """(D, 21, 2)."""
    weights: Doubles
    """(D, 21); 0 for keypoints that are not sure."""

    @classmethod
    def of(cls, found: Sequence[FoundFrame]) -> Detections:
        """The detections in the frames of a video."""
        hands = [(index, hand) for index, frame in enumerate(found) for hand in frame.hands]
        scores = np.array([hand.scores for _, hand in hands], dtype=np.float64).reshape(-1, NUM_KEYPOINTS)
        return cls(
            np.array([frame.time for frame in found]),
            np.array([index for index, _ in hands], dtype=np.int64),
            np.array([SIDES.index(hand.side) for _, hand in hands], dtype=np.int64),
            np.array([hand.confidence for _, hand in hands], dtype=np.float64),
            np.array([hand.keypoints for _, hand in hands], dtype=np.float64).reshape(-1, NUM_KEYPOINTS, 2),
            np.where(scores >= _SURE, np.sqrt(np.clip(scores, 0.0, 1.0)), 0.0),
        )


class Matches(NamedTuple):
    """Which detection shows each hand of the take in each frame, or -1."""

    numbers: Integers
    """(F, H)."""
    distances: Doubles
    """(F, H): median distance of its keypoints from the take's [px]."""


class Samples(NamedTuple):
    """Points of hands, and lines in pictures on which they are: two for a keypoint, one for an outline."""

    frames: Integers
    """(N,)."""
    pixels: Doubles
    """(N, 2): a point of all its lines."""
    normals: Doubles
    """(N, K, 2): unit normals of the lines."""
    weights: Doubles
    """(N,)."""
    outward: Doubles
    """(N, 3): the way in which a thicker hand moves the point."""
    regions: Integers
    """(N,): part of the hand, all of which may be thicker than is known."""
    points_at: Callable[[Doubles], tuple[Doubles, Doubles]]
    """Points (N, 3) [m] and their velocities, at the times (F,) of the frames in the take."""


class Bundle:
    """Clock, lens and poses of a camera, from keypoints in its pictures."""

    def __init__(
        self, motion: Motion, found: Detections, size: tuple[int, int], given: Camera | None
    ) -> None:
        self.motion, self.found, self.size = motion, found, size
        self.given, self._middle = given, float(np.median(found.times))
        pixels, seen = self.flat(found.pixels)
        self.found = found._replace(pixels=pixels, weights=np.where(seen, found.weights, 0.0))

    def flat(self, pixels: Doubles) -> tuple[Doubles, Flags]:
        """Pixels (..., 2) as a pinhole camera with the given one's matrix has them, and which it has."""
        if self.given is None:
            return pixels, np.ones(pixels.shape[:-1], dtype=bool)
        rays = self.given.unproject(pixels)
        found = rays[..., :2] / rays[..., 2:] * self.given.K[[0, 1], [0, 1]] + self.given.K[:2, 2]
        seen = np.isfinite(found).all(axis=-1) & (rays[..., 2] > 0.0)
        return np.where(seen[..., None], found, 0.0), seen

    def clock(self, unknowns: Doubles) -> tuple[float, float]:
        """Offset [s] and drift of the take's time over the video's."""
        return float(unknowns[OFFSET] - unknowns[DRIFT] * self._middle), float(unknowns[DRIFT])

    def times(self, unknowns: Doubles) -> Doubles:
        """Times of the frames in the take [s]."""
        offset, drift = self.clock(unknowns)
        return offset + (1.0 + drift) * self.found.times

    def matrix(self, unknowns: Doubles) -> Doubles:
        """K."""
        if self.given is not None:
            return self.given.K
        width, height = self.size
        focal = width * np.exp(unknowns[FOCAL])
        center = 0.5 * np.array([width, height]) + width * unknowns[_CENTER : _CENTER + 2]
        return camera_matrix(focal, focal, *center)

    def free(self, num_spans: int, *, first: bool = False) -> Flags:
        """The unknowns that are looked for; `first`, before the lens and the thickness."""
        free = np.ones(POSES + 6 * num_spans, dtype=bool)
        free[FOCAL:THICKER] = self.given is None
        if first:
            free[[DRIFT, READOUT]] = False
            free[_CENTER:POSES] = False
        return free

    def camera(self, unknowns: Doubles, span: int) -> Camera:
        """The camera of a span."""
        pose = unknowns[POSES + 6 * span :][:6]
        rotation = Rotation.from_rotvec(pose[:3]).as_matrix()
        place = rigid(rotation.T, -rotation.T @ pose[3:])
        name = "film" if span == 0 else f"film{span + 1}"
        if self.given is not None:
            return Camera(name, self.size, self.given.K, place, self.given.lens)
        k1, k2 = unknowns[_LENS : _LENS + 2]
        return Camera(name, self.size, self.matrix(unknowns), place, brown_lens(k1, k2, 0.0, 0.0, 0.0))

    def project(self, unknowns: Doubles, points: Doubles, span: int) -> tuple[Doubles, Doubles]:
        """Pixels (N, 2) of points (N, 3), and their derivatives (N, 2, 15) as OpenCV orders them."""
        pose = unknowns[POSES + 6 * span :][:6]
        lens = np.zeros(5)
        lens[:2] = unknowns[_LENS : _LENS + 2] if self.given is None else 0.0
        if not len(points):
            return np.empty((0, 2)), np.empty((0, 2, 15))
        pixels, jacobian = cv2.projectPoints(
            np.ascontiguousarray(points)[:, None], pose[:3], pose[3:], self.matrix(unknowns), lens
        )
        return pixels[:, 0], jacobian.reshape(-1, 2, 15)

    def match(self, unknowns: Doubles, starts: Sequence[int], gate: float) -> Matches:
        """The detections nearest to the hands of the take, within a median distance [px]."""
        found, points = self.found, self.motion.at(self.times(unknowns))[0]
        pixels = self.pictured(unknowns, points, starts)
        index = np.full(points.shape[:2], -1)
        distances = np.full(points.shape[:2], np.inf)
        for number, frame in enumerate(found.frames):
            sure = found.weights[number] > 0.0
            if sure.sum() < FEWEST_KEYPOINTS:
                continue
            away = np.linalg.norm(pixels[frame][:, sure] - found.pixels[number, sure], axis=-1)
            away = np.median(np.where(np.isfinite(away), away, np.inf), axis=1)
            hand = int(away.argmin())
            if away[hand] < min(gate, distances[frame, hand]):
                index[frame, hand], distances[frame, hand] = number, away[hand]
        return Matches(index, np.where(index >= 0, distances, np.nan))

    def pictured(self, unknowns: Doubles, points: Doubles, starts: Sequence[int]) -> Doubles:
        """Pixels of keypoints (F, H, 21, 3) by each frame's span; NaN where unknown or behind the camera."""
        pixels = np.full((*points.shape[:-1], 2), np.nan)
        spans = np.searchsorted(starts, np.arange(len(points)), side="right") - 1
        for span in range(len(starts)):
            pose = unknowns[POSES + 6 * span :][:6]
            ahead = (points @ Rotation.from_rotvec(pose[:3]).as_matrix()[2] + pose[5]) > 0.05
            mine = ahead & (spans == span)[:, None, None]
            pixels[mine] = self.project(unknowns, points[mine], span)[0]
        return pixels

    def samples(self, matches: Matches, most: int = MOST_BUNDLED) -> Samples:
        """The keypoints of matched hands, evenly thinned out over time to `most`."""
        frames, hands = np.nonzero(matches.numbers >= 0)
        number = matches.numbers[frames, hands]
        rows, keypoints = np.nonzero(self.found.weights[number] > 0.0)
        total = max(len(rows), 1)
        if total > most:  # whole hands
            kept = np.unique(np.linspace(0, len(frames) - 1, max(1, len(frames) * most // total)).astype(int))
            chosen = np.isin(rows, kept)
            rows, keypoints = rows[chosen], keypoints[chosen]
        frames, hands = frames[rows], hands[rows]

        def points_at(times: Doubles) -> tuple[Doubles, Doubles]:
            points, velocities = (one[frames, hands, keypoints] for one in self.motion.at(times))
            return points, velocities

        nothing = np.zeros((len(rows), 3))
        return Samples(
            frames, self.found.pixels[number[rows], keypoints], np.tile(np.eye(2), (len(rows), 1, 1)),
            self.found.weights[number[rows], keypoints], nothing, np.zeros(len(rows), np.int64), points_at,
        )  # fmt: skip

    def solve(
        self,
        start: Doubles,
        samples: Samples,
        starts: Sequence[int],
        noise: float,
        *,
        first: bool = False,
    ) -> tuple[Doubles, float, Doubles]:
        """Unknowns, their cost per sample, and their covariance, where weight 1 is `noise` [px] off."""
        spans = np.searchsorted(starts, samples.frames, side="right") - 1
        free = self.free(len(starts), first=first)
        priors = np.concatenate([_PRIORS, np.full(len(start) - POSES, np.inf)])
        center = np.zeros(len(start))
        center[FOCAL] = 0.1
        held = free & np.isfinite(priors)
        weights = np.where(held, np.sqrt(_DEPENDENT) / priors, 0.0)
        scale = np.where(np.isfinite(priors), priors, 0.1)

        far = self.residuals(start, samples, spans, noise)[0]
        inlying = None if first or not samples.outward.any() else 1.0 / np.sqrt(1.0 + (far / _ROBUST) ** 2)

        def linearized(part: Doubles) -> tuple[Doubles, Doubles]:
            unknowns = start.copy()
            unknowns[free] = part
            found = self.residuals(unknowns, samples, spans, noise)
            return found if inlying is None else _without_regions(*found, inlying, samples.regions)

        def residuals(part: Doubles) -> Doubles:
            prior = np.zeros(len(start))
            prior[free] = part
            prior = ((prior - center) * weights)[held]
            return np.concatenate([linearized(part)[0].ravel(), prior])

        def jacobian(part: Doubles) -> Doubles:
            prior = np.diag(weights)[held]
            rows = linearized(part)[1].reshape(-1, len(start))
            return np.concatenate([rows, prior])[:, free]

        def loss(squares: Doubles) -> Doubles:
            """Cauchy's, but for what is known beforehand, which no residual may outweigh."""
            beyond = 1.0 + squares
            rho = np.stack([np.log(beyond), 1.0 / beyond, -1.0 / beyond**2])
            known = slice(len(squares) - int(held.sum()), None)
            rho[:, known] = np.stack([squares, np.ones(len(squares)), np.zeros(len(squares))])[:, known]
            return rho

        done = least_squares(
            residuals,
            start[free],
            jacobian,
            loss=loss,
            f_scale=_ROBUST,
            x_scale=scale[free],
            max_nfev=40,
            xtol=1e-6,
            ftol=1e-6,
        )
        unknowns = start.copy()
        unknowns[free] = done.x
        covariance = np.zeros((len(start), len(start)))
        if not first:
            left, rows = linearized(done.x)
            told = self._covariance(left, rows, weights**2, samples)[np.ix_(free, free)]
            covariance[np.ix_(free, free)] = told
        return unknowns, 2.0 * float(done.cost) / max(len(samples.frames), 1), covariance

    def residuals(
        self, unknowns: Doubles, samples: Samples, spans: Integers, noise: float
    ) -> tuple[Doubles, Doubles]:
        """Distances (N, K) in units of the noise, and their derivatives (N, K, U); 0 without a pose."""
        points, velocities = samples.points_at(self.times(unknowns))
        row = samples.pixels[:, 1] / self.size[1] - 0.5
        points = (
            points + velocities * (unknowns[READOUT] * row)[:, None] + unknowns[THICKER] * samples.outward
        )
        residuals = np.zeros(samples.normals.shape[:2])
        jacobian = np.zeros((*residuals.shape, len(unknowns)))
        there = np.isfinite(points).all(axis=1)
        for span in np.unique(spans):
            mine = np.flatnonzero(there & (spans == span))
            pixels, derivatives = self.project(unknowns, points[mine], span)
            first = POSES + 6 * span
            rotation = Rotation.from_rotvec(unknowns[first : first + 3]).as_matrix()
            by_point = derivatives[:, :, 3:6] @ rotation
            by_time = np.einsum("nij,nj->ni", by_point, velocities[mine])
            part = np.zeros((len(mine), 2, len(unknowns)))
            part[:, :, OFFSET] = by_time
            part[:, :, DRIFT] = by_time * (self.found.times[samples.frames[mine]] - self._middle)[:, None]
            part[:, :, READOUT] = by_time * row[mine, None]
            if self.given is None:
                focal = self.matrix(unknowns)[0, 0]
                part[:, :, FOCAL] = derivatives[:, :, 6:8].sum(axis=2) * focal
                part[:, :, _CENTER:_LENS] = derivatives[:, :, 8:10] * self.size[0]
                part[:, :, _LENS:THICKER] = derivatives[:, :, 10:12]
            part[:, :, THICKER] = np.einsum("nij,nj->ni", by_point, samples.outward[mine])
            part[:, :, first : first + 6] = derivatives[:, :, :6]
            # Unequal weights make a plain sum of squares of the residuals.
            lines = samples.normals[mine] * (samples.weights[mine] / noise)[:, None, None]
            residuals[mine] = np.einsum("nki,ni->nk", lines, pixels - samples.pixels[mine])
            jacobian[mine] = lines @ part
        return residuals, jacobian

    def _covariance(
        self, residuals: Doubles, jacobian: Doubles, priors: Doubles, samples: Samples
    ) -> Doubles:
        """Covariance of the unknowns; residuals within a block of time are dependent, those of others not."""
        weights = 1.0 / (1.0 + (residuals / _ROBUST) ** 2)
        rows = jacobian.reshape(-1, jacobian.shape[-1])
        information = (rows * weights.reshape(-1, 1)).T @ rows + np.diag(priors)
        gradients = (jacobian * (weights * residuals)[..., None]).sum(axis=1)
        blocks = np.floor(self.found.times[samples.frames] / _BLOCK).astype(np.int64)
        sums = _sums(gradients, blocks)[0]
        nothing = _NOTHING * np.eye(len(priors))  # or what is not told at all would have no deviation
        inverse = np.linalg.inv(information + nothing)
        scatter = sums.T @ sums + _DEPENDENT * np.diag(priors) + nothing
        shared = _SHARED if samples.outward.any() else 1.0
        return np.asarray(shared**2 * (inverse @ scatter @ inverse))


def _sums(values: Doubles, groups: Integers) -> tuple[Doubles, Integers]:
    """Sums (G, ...) of the values (N, ...) of each group, and the row (N,) of each value's sum."""
    _, rows = np.unique(groups, return_inverse=True)
    order = np.argsort(rows, kind="stable")
    return np.add.reduceat(values[order], np.flatnonzero(np.diff(rows[order], prepend=-1)), axis=0), rows


def _without_regions(
    residuals: Doubles, jacobian: Doubles, inlying: Doubles, regions: Integers
) -> tuple[Doubles, Doubles]:
    """Residuals (N, 1) and derivatives, weighted, without what regions that are thicker have in common.

    Their covariance is that of independent ones again, if thicknesses have the deviation `_REGION`.
    """
    residuals, jacobian = residuals * inlying, jacobian * inlying[..., None]
    thicker = _REGION * jacobian[..., THICKER]
    rows = np.concatenate([residuals[..., None], jacobian], axis=2)
    size, group = _sums(thicker[:, 0] ** 2, regions)
    kept = (1.0 - 1.0 / np.sqrt(1.0 + size)) / np.maximum(size, 1e-9)
    common = kept[:, None] * _sums(thicker * rows[:, 0], regions)[0]
    rows = rows - (thicker * common[group])[:, None]
    return rows[..., 0], rows[..., 1:]
