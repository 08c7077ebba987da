"""`Bundle`: clock, lens and poses of a camera, adjusted to keypoints and outlines of hands in its video."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from gloves.takes.take import Take
from handsim.hand.shape import NUM_KEYPOINTS, SIDES
from handsim.space.camera import Camera, Lens, brown_lens, camera_matrix
from handsim.space.transforms import rigid
from render.frames import Doubles, Integers

if TYPE_CHECKING:
    from render.film.detector import FoundHand

_MAX_GAP: Final = 0.1  # [s] Poses are interpolated over gaps up to this length.
FEWEST_KEYPOINTS: Final = 8  # A hand in a frame is judged by this many keypoints.
_SURE: Final = 0.25  # Keypoints with a lower score are not used.
_MOST_BUNDLED: Final = 5000  # largest number of keypoints in a bundle
_ROBUST: Final = 2.0  # Residuals beyond this many standard deviations count less.
_BLOCK: Final = 0.5  # [s] Residuals within this time count as dependent.
_SHARED: Final = 2.0  # Errors of outlines have common causes: in drawn videos they were twice the deviations.
_NOTHING: Final = 1e-2  # prior information on free unknowns: a deviation of 10 s, m or rad
_REGION: Final = 0.0004  # [m] standard deviation of how much thicker a region of the hand is
_DEPENDENT: Final = 16.0  # This many samples count as one with an independent error.

# The unknowns, before six of the pose of each span, and the standard deviation that each has beforehand. The
# last is how much thicker than the tracked hands the filmed ones are [m]: cloth, or a measured hand's error.
OFFSET, DRIFT, READOUT, FOCAL, _CENTER, _LENS, THICKER, POSES = 0, 1, 2, 3, slice(4, 6), slice(6, 8), 8, 9
_PRIORS: Final = np.array([np.inf, 1e-4, 0.015, 0.7, 0.005, 0.005, 0.05, 0.05, 0.0007])


class FoundFrame(NamedTuple):
    """A frame of a video, and the hands that a detector found in it."""

    time: float  # in the video [s]
    hands: Sequence[FoundHand] | None  # None where it did not look


class Motion:
    """Keypoints of a take's hands at any time."""

    def __init__(self, take: Take) -> None:
        self.times = take.times
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

    times: Doubles  # (F,)
    looked: Integers  # (F,): the nearest frame in which hands were looked for
    frames: Integers  # (D,)
    sides: Integers  # (D,), as in `SIDES`
    pixels: Doubles  # (D, 21, 2)
    weights: Doubles  # (D, 21): 0 for keypoints that are not sure

    @classmethod
    def of(cls, found: Sequence[FoundFrame]) -> Detections:
        """The detections in the frames of a video."""
        looked = np.array([index for index, frame in enumerate(found) if frame.hands is not None])
        between = np.searchsorted(0.5 * (looked[1:] + looked[:-1]), np.arange(len(found)))
        hands = [(index, hand) for index, frame in enumerate(found) for hand in frame.hands or ()]
        scores = np.array([hand.scores for _, hand in hands], dtype=np.float64).reshape(-1, NUM_KEYPOINTS)
        return cls(
            np.array([frame.time for frame in found]),
            looked[between],
            np.array([index for index, _ in hands], dtype=np.int64),
            np.array([SIDES.index(hand.side) for _, hand in hands], dtype=np.int64),
            np.array([hand.keypoints for _, hand in hands], dtype=np.float64).reshape(-1, NUM_KEYPOINTS, 2),
            np.where(scores >= _SURE, np.sqrt(np.clip(scores, 0.0, 1.0)), 0.0),
        )


class State(NamedTuple):
    """What a bundle knows of a camera and its clock."""

    values: Doubles  # of the unknowns
    starts: tuple[int, ...] = (0,)  # first frame of each span in which the camera did not move

    def spans(self, frames: Integers) -> Integers:
        """Number of the span of each frame."""
        return np.searchsorted(self.starts, frames, side="right") - 1

    def pose(self, span: int) -> Doubles:
        """Rotation vector and translation (6,) from the world to the camera in a span."""
        return self.values[POSES + 6 * span :][:6]


class Matches(NamedTuple):
    """Which detection shows each hand of the take in each frame."""

    numbers: Integers  # (F, H), -1 for none
    distances: Doubles  # (F, H): median distance of its keypoints from the take's [px]
    errors: Doubles  # (F, H, 21, 2): its keypoints less the take's [px]; NaN for those that are not sure


class Samples(NamedTuple):
    """Points of hands, and lines in pictures on which they are: two for a keypoint, one for an outline."""

    frames: Integers  # (N,)
    pixels: Doubles  # (N, 2): a point of the line
    normals: Doubles  # (N, 2): unit normal of the line
    weights: Doubles  # (N,)
    outward: Doubles  # (N, 3): the way in which a thicker hand moves the point
    regions: Integers  # (N,): part of the hand, all of which may be thicker than is known
    points_at: Callable[[Doubles], tuple[Doubles, Doubles]]
    """Points (N, 3) [m] and their velocities, at the times (F,) of the frames in the take."""


class Bundle:
    """Clock, lens and poses of a camera, from keypoints and outlines in its pictures."""

    def __init__(
        self, motion: Motion, found: Detections, size: tuple[int, int], given: Camera | None
    ) -> None:
        self.motion, self.size, self.given = motion, size, given
        self._middle = float(np.median(found.times))
        pixels, weights = found.pixels, found.weights
        if given is not None:  # They are as a pinhole camera with its matrix has them.
            rays = given.unproject(pixels)
            pixels = rays[..., :2] / rays[..., 2:] * given.K[[0, 1], [0, 1]] + given.K[:2, 2]
            weights = np.where(np.isfinite(pixels).all(axis=-1) & (rays[..., 2] > 0.0), weights, 0.0)
            pixels = np.where(weights[..., None] > 0.0, pixels, 0.0)
        told = (weights > 0.0).sum(axis=1) >= FEWEST_KEYPOINTS
        frames, sides = found.frames[told], found.sides[told]
        self.found = found._replace(frames=frames, sides=sides, pixels=pixels[told], weights=weights[told])

    def clock(self, state: State) -> tuple[float, float]:
        """Offset [s] and drift of the take's time over the video's."""
        offset, drift = state.values[[OFFSET, DRIFT]].tolist()
        return offset - drift * self._middle, drift

    def times(self, state: State) -> Doubles:
        """Times of the frames in the take [s]."""
        offset, drift = self.clock(state)
        return offset + (1.0 + drift) * self.found.times

    def matrix(self, values: Doubles) -> Doubles:
        """K."""
        if self.given is not None:
            return self.given.K
        focal = self.size[0] * np.exp(values[FOCAL])
        return camera_matrix(focal, focal, *(0.5 * np.array(self.size) + self.size[0] * values[_CENTER]))

    def cameras(self, state: State, *, flat: bool = False) -> list[Camera]:
        """The cameras of all spans, with the given lens, or `flat` without it."""
        lens, cameras = brown_lens(*state.values[_LENS], 0.0, 0.0, 0.0), []
        if self.given is not None:
            lens = Lens() if flat else self.given.lens
        for span in range(len(state.starts)):
            pose, name = state.pose(span), f"film{span + 1}" if span else "film"
            rotation = Rotation.from_rotvec(pose[:3]).as_matrix()
            place = rigid(rotation.T, -rotation.T @ pose[3:])
            cameras.append(Camera(name, self.size, self.matrix(state.values), place, lens))
        return cameras

    def pictured(self, state: State) -> Doubles:
        """Pixels (F, H, 21, 2) of the take's keypoints in each frame; NaN where there are none."""
        points = self.motion.at(self.times(state))[0]
        pixels, spans = np.empty((*points.shape[:-1], 2)), state.spans(np.arange(len(points)))
        for span, camera in enumerate(self.cameras(state, flat=True)):
            pixels[spans == span] = camera.project(points[spans == span])
        return pixels

    def match(self, state: State, gate: float) -> Matches:
        """The detections nearest to the hands of the take, within a median distance [px]."""
        found, pixels = self.found, self.pictured(state)
        errors = found.pixels[:, None] - pixels[found.frames]  # (D, H, 21, 2)
        away = np.nan_to_num(np.linalg.norm(errors, axis=-1), nan=np.inf)
        unsure = np.broadcast_to((found.weights == 0.0)[:, None], away.shape)
        errors[unsure] = away[unsure] = np.nan
        away = np.nanmedian(away, axis=-1)  # (D, H)
        hand, nearest = away.argmin(axis=1), away.min(axis=1)
        order = np.argsort(-nearest, kind="stable")
        order = order[nearest[order] < gate]
        at = found.frames[order], hand[order]  # where the nearest comes last
        matches = Matches(
            np.full(pixels.shape[:2], -1), np.full(pixels.shape[:2], np.nan), np.full(pixels.shape, np.nan)
        )
        matches.numbers[at], matches.distances[at] = order, nearest[order]
        matches.errors[at] = errors[order, hand[order]]
        return matches

    def samples(self, matches: Matches) -> Samples:
        """The keypoints of matched hands, thinned out to about `_MOST_BUNDLED`."""
        frames, hands, keypoints = np.nonzero(np.isfinite(matches.errors[..., 0]))
        kept = matches.numbers[frames, hands] % (1 + len(frames) // _MOST_BUNDLED) == 0
        frames, hands, keypoints = (np.repeat(one[kept], 2) for one in (frames, hands, keypoints))
        number, count = matches.numbers[frames, hands], len(frames)

        def points_at(times: Doubles) -> tuple[Doubles, Doubles]:
            points, velocities = (one[frames, hands, keypoints] for one in self.motion.at(times))
            return points, velocities

        return Samples(
            frames, self.found.pixels[number, keypoints], np.tile(np.eye(2), (count // 2, 1)),
            self.found.weights[number, keypoints], np.zeros((count, 3)), np.zeros(count, np.int64), points_at,
        )  # fmt: skip

    def solve(
        self, state: State, samples: Samples, noise: float, *, first: bool = False
    ) -> tuple[State, float, Doubles]:
        """The state, its cost per sample, and its covariance, where weight 1 is `noise` [px] off.

        What is far off at the start counts less. Lens and thickness are not looked for at `first`.
        """
        size, count = len(state.values), len(samples.frames)
        free = np.ones(size, dtype=bool)
        free[FOCAL:THICKER] = self.given is None
        if first:
            free[[DRIFT, READOUT]] = free[_CENTER] = free[_LENS] = free[THICKER] = False
        priors = np.concatenate([_PRIORS, np.full(size - POSES, np.inf)])
        held = np.sqrt(_DEPENDENT) * np.diag(1.0 / priors)
        far = self.rows(state, samples, noise)[:, :1]
        robust = 1.0 / np.sqrt(1.0 + (far / _ROBUST) ** 2)

        def widened(part: Doubles) -> State:
            values = state.values.copy()
            values[free] = part
            return state._replace(values=values)

        @functools.lru_cache(maxsize=1)  # SciPy asks for residuals and derivatives one after the other
        def rows(part: bytes) -> Doubles:
            now = widened(np.frombuffer(part))
            known = np.column_stack([held @ now.values, held])
            own = _without_regions(robust * self.rows(now, samples, noise), samples.regions)
            return np.concatenate([own, known])

        done = least_squares(
            lambda part: rows(part.tobytes())[:, 0],
            state.values[free],
            lambda part: rows(part.tobytes())[:, 1:][:, free],
            x_scale=np.where(np.isfinite(priors), priors, 0.1)[free],
            max_nfev=40, xtol=1e-6, ftol=1e-6,
        )  # fmt: skip
        residuals, jacobian = done.fun[:count], done.jac[:count]
        # Residuals within a block of time are dependent, those of others are not.
        blocks = np.floor(self.found.times[samples.frames] / _BLOCK).astype(np.int64)
        sums = csr_array((residuals, (blocks, np.arange(count)))) @ jacobian
        nothing = _NOTHING * np.eye(len(done.x))  # or what is not told at all would have no deviation
        inverse = np.linalg.inv(done.jac.T @ done.jac + nothing)
        scatter = sums.T @ sums + _DEPENDENT * done.jac[count:].T @ done.jac[count:] + nothing
        covariance = np.zeros((size, size))
        covariance[np.ix_(free, free)] = inverse @ scatter @ inverse
        if samples.outward.any():
            covariance *= _SHARED**2
        return widened(done.x), 2.0 * float(done.cost) / max(count, 1), covariance

    def rows(self, state: State, samples: Samples, noise: float) -> Doubles:
        """Distances from the lines, in units of the noise, and derivatives (N, 1 + U); 0 without a pose."""
        values, (points, velocities) = state.values, samples.points_at(self.times(state))
        late = samples.pixels[:, 1] / self.size[1] - 0.5
        points = points + velocities * (values[READOUT] * late)[:, None] + values[THICKER] * samples.outward
        there, spans = np.isfinite(points).all(axis=1), state.spans(samples.frames)
        rows, matrix, lens = np.zeros((len(points), 1 + len(values))), self.matrix(values), np.zeros(5)
        lens[:2] = values[_LENS] if self.given is None else 0.0
        for span in np.unique(spans[there]):
            mine = np.flatnonzero(there & (spans == span))
            pose, first = state.pose(span), POSES + 6 * span
            pixels, jacobian = cv2.projectPoints(points[mine, None], pose[:3], pose[3:], matrix, lens)
            lines = samples.normals[mine] * (samples.weights[mine] / noise)[:, None]
            # OpenCV's order: rotation, translation, focal lengths, center and lens.
            across = np.einsum("ni,nij->nj", lines, jacobian.reshape(len(mine), 2, -1))
            by_point = across[:, 3:6] @ Rotation.from_rotvec(pose[:3]).as_matrix()
            by_time = (by_point * velocities[mine]).sum(axis=1)
            own = np.zeros((len(mine), len(values)))
            own[:, OFFSET], own[:, READOUT] = by_time, by_time * late[mine]
            own[:, DRIFT] = by_time * (self.found.times[samples.frames[mine]] - self._middle)
            own[:, THICKER] = (by_point * samples.outward[mine]).sum(axis=1)
            if self.given is None:
                own[:, FOCAL] = across[:, 6:8].sum(axis=1) * matrix[0, 0]
                own[:, _CENTER], own[:, _LENS] = across[:, 8:10] * self.size[0], across[:, 10:12]
            own[:, first : first + 6] = across[:, :6]
            rows[mine, 0] = ((pixels[:, 0] - samples.pixels[mine]) * lines).sum(axis=1)
            rows[mine, 1:] = own
        return rows


def _without_regions(rows: Doubles, regions: Integers) -> Doubles:
    """Residuals and derivatives (N, 1 + U) without what regions that are thicker have in common.

    Their covariance is that of independent ones again, if thicknesses have the deviation `_REGION`.
    """
    groups = csr_array((_REGION * rows[:, 1 + THICKER], (regions, np.arange(len(rows)))))
    size = groups.power(2).sum(axis=1)
    kept = (1.0 - 1.0 / np.sqrt(1.0 + size)) / np.maximum(size, 1e-9)
    return np.asarray(rows - groups.T @ (kept[:, None] * (groups @ rows)))
